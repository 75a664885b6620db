"""viewer.html in a browser: its picture is the Python renderer's, its controls do what they say, it asks no network."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerf.effects.appearance import AppearanceModel
from nerf.rendering.srgb_arrays import linear_light, srgb_values
from stages import train, viewer
from stages.contract import run_stage
from stages.effects.image_effects import photo_effects
from stages.io.field_files import load_field, save_field
from stages.io.files import read_json, write_json
from stages.render.path import path_from_file
from stages.viewer.tables import quantised, with_table
from tests.conftest import RecordedProgress
from tests.stages.photo_scene import FOCAL, HEIGHT, WIDTH, ball_photo, photographed
from tests.stages.viewer.browser import Viewer, chromium, pinhole_rays, psnr, rendered, request_of
from tests.stages.viewer.made_fields import CUBE, NAMES, Made, gains, inside_pose, made, renamed, solid_cube

MIN_AGREEMENT = 45.0  # dB; 8 bits of a picture alone leave 59
LENS = [48, 36, 40.0, 41.0, 22.0, 19.0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


def written(folder: Path, space: str, config: viewer.Config | None = None, **info: Any) -> tuple[Made, Path]:
    """A made field and its page."""
    field = made(folder, space, **info)
    renamed(field)
    out = folder / "viewer"
    out.mkdir()
    run_stage(viewer.STAGE, config or viewer.Config(bits="8"), field.inputs, out, RecordedProgress())
    return field, out / "viewer.html"


@pytest.fixture(scope="module")
def ball(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """A page of a box, shared by tests that leave it as they find it."""
    page = Viewer(browser, written(tmp_path_factory.mktemp("box"), "box")[1])
    yield page
    page.close()


@pytest.mark.parametrize("space", ["box", "contraction", "ndc"])
def test_the_picture_is_that_of_the_python_renderer(browser: Any, tmp_path: Path, space: str):
    field, file = written(tmp_path, space)
    packed = with_table(field.field, quantised(field.field.layout, field.field.table, 8))
    page, background = Viewer(browser, file), [1.0, 1.0, 1.0] if space == "box" else [0.0, 0.0, 0.0]
    poses = [field.scene.views[0].scene_from_camera, field.scene.views[3].scene_from_camera, inside_pose()]
    opacities = []
    for pose in poses:
        near_far = (0.05, 30.0)
        drawn = page.picture(LENS[0], LENS[1], request_of(pose, LENS, near_far))
        colour, opacity = rendered(packed, pinhole_rays(pose, LENS, near_far), background)
        assert psnr(drawn[..., :3], colour) > MIN_AGREEMENT and psnr(drawn[..., 3], opacity) > MIN_AGREEMENT
        assert psnr(drawn[:, ::-1, :3], colour) < 30
        opacities.append(opacity)
    assert np.ptp(opacities[0]) > 0.5, "the pictures must show something and what lies behind it"
    assert page.faults == []
    page.close()


def test_16_bits_colours_without_directions_and_effects(browser: Any, tmp_path: Path):
    names = [f"{index}.png" for index in range(8)]
    field = made(tmp_path, "contraction", view_dependence=False, effects=gains(names))
    (tmp_path / "viewer").mkdir()
    run_stage(viewer.STAGE, viewer.Config(bits="16"), field.inputs, tmp_path / "viewer", RecordedProgress())
    page, view = Viewer(browser, tmp_path / "viewer/viewer.html"), field.scene.views[3]
    packed = with_table(field.field, quantised(field.field.layout, field.field.table, 16))
    info = read_json(field.inputs["train"] / "field.json")
    shown = AppearanceModel(packed, photo_effects(info, field.scene, view))
    lens = [WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    of_photo = page.run("() => (({log_gain, falloff}) => ({logGain: log_gain, falloff}))(viewer.contents.views[3])")
    drawn = page.picture(WIDTH, HEIGHT, request_of(view.scene_from_camera, lens, (2.0, 4.0), **of_photo))
    colour, _ = rendered(shown, pinhole_rays(view.scene_from_camera, lens, (2.0, 4.0)), [0.0, 0.0, 0.0])  # pyright: ignore
    assert psnr(drawn[..., :3], colour) > MIN_AGREEMENT
    assert not page.run("document.getElementById('exposure-row').hidden")
    page.close()


def test_the_exposure_slider_makes_a_stop_more_light(browser: Any, tmp_path: Path):
    """Twice the light in linear values, as by nerf/effects/exposure.py; what is clipped aside."""
    effects = {"exposure": gains([f"{index}.png" for index in range(8)])["exposure"]}
    field = made(tmp_path, "contraction", effects=effects)
    (tmp_path / "viewer").mkdir()
    run_stage(viewer.STAGE, viewer.Config(bits="8"), field.inputs, tmp_path / "viewer", RecordedProgress())
    page = Viewer(browser, tmp_path / "viewer/viewer.html", 60, 45)
    before = page.shown().reshape(-1, 4)[:, :3] / 255
    page.run("() => { const e = byId('exposure'); e.value = 1; e.dispatchEvent(new Event('input')); }")
    assert page.run("byId('exposure-value').textContent") == "+1 EV"
    after = page.shown().reshape(-1, 4)[:, :3] / 255
    expected = srgb_values(2 * linear_light(before))
    kept = (expected < 0.95) & (before > 0.1)
    assert kept.mean() > 0.2 and np.abs(after - expected)[kept].max() < 0.03
    page.close()


def test_a_path_is_played_back_from_key_to_key(ball: Viewer):
    keys = ball.run("viewer.contents.views.slice(0, 3).map((view) => view.pose)")
    ball.run("(keys) => { viewer.path.keys = keys; window.seen = []; }", keys)
    ball.run("window.draw = viewer.moved.bind(viewer)")
    ball.run("() => { viewer.moved = (kind) => { seen.push(viewer.navigation.pose.centre); draw(kind); }; }")
    ball.run("viewer.play(0.5)")
    seen = np.array(ball.run("seen"))
    assert len(seen) > 3 and np.allclose(seen[-1], keys[2]["centre"])
    away = np.linalg.norm(seen - keys[0]["centre"], axis=1)
    assert away[0] < 0.2 and (np.diff(away) > -1e-9).all(), "from the first key to the last, forwards"
    ball.run("() => { delete viewer.moved; viewer.path.keys = []; viewer.reset(); }")
    ball.until("!viewer.navigation.flight")


def test_a_playing_path_and_a_photo_exclude_each_other(ball: Viewer):
    ball.run("() => { viewer.path.keys = viewer.contents.views.slice(0, 3).map((view) => view.pose); }")
    ball.run("viewer.showPhoto(1)")
    ball.until("viewer.photo === 1")
    ball.run("() => { window.first = viewer.play(30), window.second = viewer.play(30); }")
    ball.run("first")  # it ends where the second begins
    assert ball.run("[viewer.photo, byId('compare').hidden, Boolean(viewer.playing)]") == [None, True, True]
    ball.run("viewer.showPhoto(5)")
    ball.until("viewer.photo === 5")
    assert ball.run("viewer.navigation.pose.centre") == ball.run("viewer.contents.views[5].pose.centre")
    ball.run("() => { viewer.play(30); viewer.reset(); }")
    ball.run("second")
    ball.until("!viewer.navigation.flight")
    assert ball.run("viewer.navigation.pose") == ball.run("viewer.home()")
    ball.run("() => { viewer.path.keys = []; viewer.changed(); }")


def test_a_levelled_view_shows_no_photo(ball: Viewer):
    ball.run("viewer.showPhoto(1)")
    ball.until("viewer.photo === 1")
    ball.run("() => { viewer.navigation.pose = turnedPose(viewer.navigation.pose, [0, 1, 0], 0.2, [0, 0, 0]); }")
    ball.page.locator("#level").evaluate("(button) => button.click()")
    ball.until("!viewer.navigation.flight")
    assert ball.run("[viewer.photo, byId('compare').hidden]") == [None, True]
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")


def test_of_the_fields_before_nothing_is_kept(ball: Viewer):
    replaced = """() => {
      const asked = [], { field, views } = viewer.contents, section = (n) => () => void asked.push(n);
      for (const n of [1, 2, 3]) viewer.replace({ field, gains: views.map(() => ({})), section: section(n) });
      asked.length = 0;
      viewer.contents.section("palette");
      return asked;
    }"""
    assert ball.run(replaced) == [3]


def test_a_photo_beside_its_render_scores_as_in_python(browser: Any, tmp_path: Path):
    inputs, scene = photographed(tmp_path, channels=4)
    for name in ("train", "scale", "viewer"):
        (tmp_path / name).mkdir()
        inputs[name] = tmp_path / name
    write_json(inputs["scale"] / "scale.json", {"metres_per_unit": None})
    grid: Any = {"num_levels": 3, "log2_hashmap_size": 12, "max_res": 32, "target_samples": 2048}
    run_stage(
        train.STAGE, train.Config(steps=150, downscale=1.0, grid=grid), inputs, inputs["train"], RecordedProgress()
    )
    run_stage(viewer.STAGE, viewer.Config(), inputs, inputs["viewer"], RecordedProgress())
    field, info = load_field(inputs["train"])
    page, index = Viewer(browser, inputs["viewer"] / "viewer.html", WIDTH, HEIGHT), 0
    ball, view = ball_photo(4) / 255, scene.views[index]
    photo = ball[..., :3] * ball[..., 3:] + np.array(info["background"]) * (1 - ball[..., 3:])
    page.run(f"viewer.showPhoto({index})")
    page.until(f"viewer.photo === {index}")
    shown = page.shown().reshape(HEIGHT, WIDTH, 4)[..., :3] / 255
    lens = [WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    rays = pinhole_rays(view.scene_from_camera, lens, (view.near, view.far))
    colour, _ = rendered(field, rays, info["background"])  # pyright: ignore[reportArgumentType]
    assert psnr(colour, photo) > 18 and abs(psnr(shown, photo) - psnr(colour, photo)) < 0.3
    page.close()


def test_drag_wheel_and_keys_move_the_camera(ball: Viewer):
    before, mouse = ball.run("viewer.navigation.pose"), ball.page.mouse
    mouse.move(20, 70)
    mouse.down()
    mouse.move(40, 70)
    mouse.up()
    turned = ball.run("viewer.navigation.pose")
    distance = ball.run("viewer.navigation.distance")
    assert np.linalg.norm(np.subtract(turned["centre"], before["centre"])) > 0.1
    mouse.wheel(0, -200)
    ball.until(f"viewer.navigation.distance < {0.9 * distance}")
    ball.page.keyboard.down("w")
    ball.until(f"norm(subtract(viewer.navigation.pose.centre, {turned['centre']})) > 0.3")
    ball.page.keyboard.up("w")
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")
    assert np.allclose(ball.run("viewer.navigation.pose.centre"), before["centre"])


def test_keys_work_wherever_they_are_not_typed(ball: Viewer):
    ball.run("byId('panel').hidden && byId('menu').click(); byId('path').open = true")
    seen = {}
    for place in ("#menu", "#layer-axes", "#views", "#path-seconds"):
        ball.page.locator(place).press("2")
        seen[place] = ball.run("viewer.view")
        ball.run("viewer.view = 'colour'; viewer.changed()")
    assert seen == {"#menu": "depth", "#layer-axes": "depth", "#views": "colour", "#path-seconds": "colour"}
    ball.run("byId('path').open = false; byId('path-seconds').value = 2; byId('menu').click(); viewer.photo = 0")
    ball.run("viewer.changed()")
    ball.page.keyboard.press("Escape")
    assert ball.run("viewer.photo === null && byId('compare').hidden")


def test_two_fingers_zoom(ball: Viewer):
    pinch = """() => {
      const finger = (type, id, x) => viewer.canvas.dispatchEvent(new PointerEvent(type, {
        pointerId: id, pointerType: "touch", clientX: x, clientY: 30, bubbles: true, buttons: 1 }));
      viewer.canvas.setPointerCapture = () => {};
      const before = viewer.navigation.distance;
      finger("pointerdown", 11, 30); finger("pointerdown", 12, 50);
      finger("pointermove", 12, 70); finger("pointermove", 11, 10);
      finger("pointerup", 11, 10); finger("pointerup", 12, 70);
      return before / viewer.navigation.distance; }"""
    assert ball.run(pinch) == pytest.approx(3.0, rel=1e-6)
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")


def test_a_finger_may_tremble_as_it_taps(ball: Viewer):
    tap = """([type, by]) => {
      const touch = (name, x) => viewer.canvas.dispatchEvent(new PointerEvent(name, {
        pointerId: 13, pointerType: type, clientX: x, clientY: 30, bubbles: true, buttons: 1 }));
      const [before, clicks] = [viewer.navigation.pose, []];
      viewer.clicked = (x) => clicks.push(x);
      touch("pointerdown", 30); touch("pointermove", 30 + by); touch("pointerup", 30 + by);
      delete viewer.clicked;
      return [clicks.length, before === viewer.navigation.pose]; }"""
    assert ball.run(tap, ["touch", 9]) == [1, True] and ball.run(tap, ["mouse", 9]) == [0, False]
    assert ball.run(tap, ["touch", 15]) == [0, False]
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")


LAYOUT = """() => {
  const seen = [...document.querySelectorAll("button, input, select, summary, output, code")]
    .filter((e) => e.offsetParent !== null && e.textContent + e.id), box = (id) => byId(id).getBoundingClientRect();
  const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const pairs = [["panel", "menu"], ["panel", "canvas"], ["panel", "compare"], ["compare", "menu"]];
  return {
    outside: seen.map((e) => [e.id || e.textContent, e.getBoundingClientRect()])
      .filter(([, { left, right }]) => left < 0 || right > innerWidth),
    overlap: pairs.filter(([a, b]) => meet(box(a), box(b))),
    scrolls: document.documentElement.scrollWidth > innerWidth || byId("panel").scrollWidth > byId("panel").clientWidth,
    scene: box("canvas").width * box("canvas").height > 0.5 * innerWidth * innerHeight,
    slider: byId("photo-share").offsetWidth >= 100,
    options: [...document.querySelectorAll(".option")].map((e) => e.getClientRects().length),
    gap: document.querySelector("#path > p").getBoundingClientRect().top - box("path-save").bottom >= 6,
  };
}"""


@pytest.mark.parametrize("size", [(320, 568), (568, 320), (768, 1024), (1280, 800), (2560, 1440)])
def test_controls_fit_screens_of_any_size(ball: Viewer, size: tuple[int, int]):
    """Menu open with all its parts, a photo compared: nothing is cut off or lies over another."""
    ball.page.set_viewport_size({"width": size[0], "height": size[1]})
    ball.run("() => { if (byId('panel').hidden) byId('menu').click(); }")
    ball.run("document.querySelectorAll('details').forEach((each) => (each.open = true))")
    ball.run("viewer.photo = 0; viewer.changed()")
    fits = {"outside": [], "overlap": [], "scrolls": False, "scene": True, "slider": True, "options": [1], "gap": True}
    assert ball.run(LAYOUT) == fits
    ball.run("document.querySelectorAll('details').forEach((each) => (each.open = false))")
    ball.run("viewer.leavePhoto(); byId('menu').click()")
    ball.page.set_viewport_size({"width": 120, "height": 90})


CONTRASTS = """() => {
  const channels = (colour) => colour.match(/[0-9.]+/g).slice(0, 3).map((x) => x / 255);
  const linear = (x) => (x > 0.04045 ? ((x + 0.055) / 1.055) ** 2.4 : x / 12.92);
  const light = (colour) => dot(channels(colour).map(linear), [0.2126, 0.7152, 0.0722]) + 0.05;
  const contrast = (a, b) => Math.max(light(a), light(b)) / Math.min(light(a), light(b));
  const card = getComputedStyle(byId("panel")).backgroundColor, of = (id) => getComputedStyle(byId(id));
  return [contrast(of("reset").color, card), contrast(of("path-seconds").borderColor, card)];
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_controls_can_be_told_from_what_is_behind(ball: Viewer, scheme: Any):
    """WCAG 2.2, 1.4.3 and 1.4.11: letters and outlines."""
    ball.page.emulate_media(color_scheme=scheme)
    text, outline = ball.run(CONTRASTS)
    ball.page.emulate_media(color_scheme="light")
    assert text >= 4.5 and outline >= 3


def test_on_a_phone_a_chosen_photo_closes_the_menu(ball: Viewer):
    ball.run("() => { if (byId('panel').hidden) byId('menu').click(); }")
    ball.page.locator("#views").select_option("1")
    assert ball.run("byId('panel').hidden && byId('menu').getAttribute('aria-expanded') === 'false'")
    ball.until("viewer.photo === 1")
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")


def test_views_differ_and_all_pixels_fill_in(ball: Viewer):
    pictures = {}
    for number, view in enumerate(("colour", "depth", "normals", "opacity"), 1):
        ball.page.locator("#canvas").press(str(number))
        assert ball.run("viewer.view") == view
        pictures[view] = ball.shown()
    assert len({picture.tobytes() for picture in pictures.values()}) == 4
    ball.page.locator("#canvas").press("1")


def test_a_click_on_a_camera_shows_its_photo(ball: Viewer):
    ball.run("document.getElementById('layer-cameras').click()")
    where = """() => { const { width, height } = viewer.canvas, lens = fitted(viewer.lens, width, height);
      const views = viewer.contents.views;
      const at = views.map((v) => projected(viewer.navigation.pose, lens, v.pose.centre));
      const index = at.findIndex((p) => p.depth > 0 && p.x > 2 && p.x < width - 2 && p.y > 2 && p.y < height - 2
        && (p.x < 50 || p.y > 48)); // beside the menu
      return [index, at[index].x, at[index].y]; }"""
    index, x, y = ball.run(where)
    ball.page.mouse.click(x, y)
    ball.until(f"viewer.photo === {index}")
    assert not ball.run("document.getElementById('photo').hidden")
    assert ball.run("document.getElementById('photo-name').textContent") == ball.run(
        f"viewer.contents.views[{index}].name"
    )
    for other, name in enumerate(NAMES):
        ball.run(f"viewer.photo = {other}; viewer.changed()")
        assert ball.run("document.getElementById('photo-name').textContent") == name
    assert ball.run("document.querySelectorAll('b, label img').length") == 0, "a name is text and no HTML"
    ball.run(f"viewer.photo = {index}; viewer.changed()")
    ball.run("document.getElementById('layer-cameras').click()")
    ball.page.locator("#photo-after").press("Enter")
    bar = "[byId('compare').hidden, document.activeElement.id, Number(byId('views').value)]"
    after = (index + 1) % ball.run("viewer.contents.views.length")
    assert ball.run(bar) == [False, "photo-after", after], "the focus stays while the camera flies"
    ball.until(f"viewer.photo === {after}")
    ball.run("viewer.showPhoto(0); viewer.leavePhoto()")
    ball.until("!viewer.navigation.flight")
    assert ball.run("viewer.photo") is None and ball.run("byId('compare').hidden"), "it was left on the way"
    ball.run("viewer.reset()")
    ball.until("!viewer.navigation.flight")
    assert ball.run("document.getElementById('photo').hidden")


def test_measured_lengths_are_right_to_1_percent(browser: Any, tmp_path: Path):
    """Between points of a solid cube that are clicked, in metres."""
    field = made(tmp_path, "box")
    write_json(field.inputs["scale"] / "scale.json", {"metres_per_unit": 0.25})
    save_field(field.inputs["train"], solid_cube(), {"background": [1.0] * 3, "downscale": 1.0, "effects": {}})
    (tmp_path / "viewer").mkdir()
    run_stage(viewer.STAGE, viewer.Config(bits="8", mesh="off"), field.inputs, tmp_path / "viewer", RecordedProgress())
    page = Viewer(browser, tmp_path / "viewer/viewer.html", 320, 240)
    page.run("document.querySelector('#measure > summary').click()")
    pose = page.run("viewer.navigation.pose")
    lens = page.run("Object.values(fitted(viewer.lens, 320, 240)).toSpliced(2, 1)")  # no scale
    rows = np.array([*np.reshape(pose["rotation"], (3, 3)), pose["centre"]]).T
    rays = pinhole_rays(rows, lens, (0.0, 9.0))
    entry = ((-CUBE * rays.directions.sign() - rays.origins) / rays.directions).amax(-1)
    surface = (rays.origins + entry[..., None] * rays.directions).numpy()
    clicks = [(x, y) for y in range(4, 240, 8) for x in range(4, 240, 8) if np.abs(surface[y, x]).max() < CUBE + 1e-3]
    ends, lengths = [(clicks[0], clicks[-1]), (clicks[len(clicks) // 3], clicks[len(clicks) // 2])], []
    for pair in ends:
        for x, y in pair:
            page.page.mouse.click(x + 0.5, y + 0.5)
        value, unit = page.run("byId('distance').textContent").split()
        lengths.append(np.linalg.norm(surface[pair[0][::-1]] - surface[pair[1][::-1]]))
        assert unit == "m" and float(value) == pytest.approx(0.25 * lengths[-1], rel=0.01)
    assert min(lengths) > 0.1 and max(lengths) > 0.8 and page.faults == []
    page.close()


def test_a_saved_path_is_read_back_by_render(ball: Viewer, tmp_path: Path):
    scene = made(tmp_path, "box").scene
    ball.run("viewer.path.keys = viewer.contents.views.slice(0, 3).map((view) => view.pose)")
    (tmp_path / "path.json").write_text(json.dumps(ball.run("viewer.pathJson(0.1)")), "utf-8")
    path = path_from_file(scene, tmp_path / "path.json")
    assert len(path.cameras) == 7 and (path.cameras[0].width, path.cameras[0].height) == (WIDTH, HEIGHT)
    for frame, view in ((0, 0), (3, 1), (6, 2)):
        assert np.abs(path.poses[frame] - scene.views[view].scene_from_camera).max() < 1e-6
    ball.run("viewer.path.keys = []")


def test_the_crop_box_leaves_nothing_outside(ball: Viewer):
    before = ball.shown()
    ball.run("viewer.crop = {low: [0.8, 0.8, 0.8], high: [0.9, 0.9, 0.9]}; viewer.changed()")
    assert np.ptp(before) > 50 and np.ptp(ball.shown().reshape(-1, 4)[:, :3]) == 0
    ball.run("viewer.crop = null; viewer.changed()")


LAYER = """([shares]) => {
  const { canvas, navigation: { pose }, overlay, renderer } = viewer, { gl } = renderer.graphics;
  const lens = fitted(viewer.lens, canvas.width, canvas.height), marks = [];
  for (let y = 33.5; y < 57; y += 2) for (let x = 48.5; x < 72; x += 2) {
    const surface = renderer.distanceAt(x, y), share = shares[marks.length % shares.length];
    const point = add(pose.centre, scaled(pixelDirection(pose, lens, x, y), share * (surface ?? 3)));
    marks.push({ x, y, share, solid: surface !== null, point });
  }
  overlay.points = overlay.vertices(new Float32Array(marks.flatMap(({ point }) => point)),
    new Float32Array(marks.flatMap(() => [1, 0, 1])));
  overlay.layers.points = true;
  renderer.showAgain();
  const pixel = new Uint8Array(4);
  for (const mark of marks) {
    gl.readPixels(mark.x - 0.5, canvas.height - mark.y - 0.5, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    mark.seen = pixel[0] === 255 && pixel[1] === 0 && pixel[2] === 255;
  }
  overlay.layers.points = false;
  overlay.points = null;
  renderer.showAgain();
  return marks;
}"""


def test_the_surface_hides_points_behind_it(ball: Viewer):
    """Some stand before what the pixel shows, some behind; in empty space nothing hides them."""
    ball.done()
    marks = ball.run(LAYER, [[0.9, 1.2]])
    seen = {(each["solid"], each["share"]): [] for each in marks}
    for each in marks:
        seen[each["solid"], each["share"]].append(each["seen"])
    assert all(len(flags) > 5 for flags in seen.values()) and len(seen) == 4
    assert all(seen[True, 0.9]) and not any(seen[True, 1.2])
    assert all(seen[False, 0.9]) and all(seen[False, 1.2])


def test_the_crop_box_applies_to_points(ball: Viewer):
    ball.done()
    points = np.array([each["point"] for each in ball.run(LAYER, [[0.9]])])
    axis, high = int(np.ptp(points, axis=0).argmax()), [9.0, 9.0, 9.0]
    high[axis] = float(np.median(points[:, axis]))
    ball.run("(high) => { viewer.crop = {low: [-9, -9, -9], high}; viewer.changed(); }", high)
    ball.done()
    marks = [(each["point"][axis] - high[axis], each["seen"]) for each in ball.run(LAYER, [[0.9]])]
    inside, outside = [seen for at, seen in marks if at < -0.02], [seen for at, seen in marks if at > 0.02]
    assert len(inside) > 5 and len(outside) > 5 and all(inside) and not any(outside)
    ball.run("viewer.crop = null; viewer.changed()")


PLANE = """(depth) => {
  const { canvas, contents, navigation: { pose }, overlay, renderer } = viewer, { gl } = renderer.graphics;
  const lens = fitted(viewer.lens, canvas.width, canvas.height), most = 32767, marks = [], before = contents.mesh;
  const corners = [[-1, -1], [1, -1], [-1, 1], [1, 1]].flatMap(([a, b]) =>
    add(scaled(right(pose), a * most), scaled(down(pose), b * most)).map((v) => v / 2));
  contents.mesh = { middle: add(pose.centre, scaled(forward(pose), depth)), radius: 20, faces: 2 };
  const colours = Uint8Array.from({ length: 12 }, (_, i) => (i % 3 === 1 ? 0 : 255)), pixel = new Uint8Array(4);
  overlay.mesh = overlay.vertices(new Int16Array(corners), colours, new Uint16Array([0, 1, 2, 2, 1, 3]));
  overlay.layers.mesh = true;
  renderer.showAgain();
  for (let y = 33.5; y < 57; y += 2) for (let x = 48.5; x < 72; x += 2) {
    gl.readPixels(x - 0.5, canvas.height - y - 0.5, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    marks.push({ x, y, seen: pixel[0] > 180 && pixel[1] === 0 && pixel[2] > 180 });
  }
  for (const mark of marks) {
    mark.surface = renderer.distanceAt(mark.x, mark.y);
    mark.plane = depth / dot(pixelDirection(pose, lens, mark.x, mark.y), forward(pose));
  }
  [contents.mesh, overlay.mesh, overlay.layers.mesh] = [before, null, false];
  renderer.showAgain();
  return marks;
}"""


def test_the_surface_hides_the_mesh_behind_it(ball: Viewer):
    """A plane through the scene, against the distances that the field's picture has."""
    ball.done()
    seen, hidden = [], []
    for each in ball.run(PLANE, 3.5):
        surface = each["surface"] or np.inf
        if each["plane"] < 0.99 * surface:
            seen.append(each["seen"])
        elif each["plane"] > 1.03 * surface:
            hidden.append(each["seen"])
    assert len(seen) > 5 and len(hidden) > 5 and all(seen) and not any(hidden)


def test_the_mesh_of_the_run_is_a_layer(ball: Viewer):
    read = """() => { const { gl } = viewer.renderer.graphics, c = viewer.canvas; viewer.renderer.showAgain();
      const bytes = new Uint8Array(4 * c.width * c.height);
      gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      let red = 0;
      for (let i = 0; i < bytes.length; i += 4) red += bytes[i] > 150 && bytes[i + 1] + bytes[i + 2] === 0;
      return red; }"""
    ball.run("(crop) => { viewer.crop = crop; viewer.changed(); }", {"low": [0.8] * 3, "high": [0.9] * 3})
    ball.page.locator("#canvas").press("m")
    ball.done()
    assert ball.run(read) == 0, "it lies outside of the box"
    ball.run("viewer.crop = null; viewer.changed()")
    ball.done()
    assert ball.run(read) > 100
    ball.page.locator("#canvas").press("m")
    assert ball.run(read) == 0


def test_a_saved_picture_is_what_is_shown_with_its_layers(ball: Viewer, tmp_path: Path):
    plain = ball.shown().reshape(90, 120, 4)[..., :3]
    pictures = []
    for _ in ("without the mesh", "with it"):
        with ball.page.expect_download() as download:
            ball.run("document.getElementById('screenshot').click()")
        download.value.save_as(tmp_path / "picture.png")
        with Image.open(tmp_path / "picture.png") as opened:
            pictures.append(np.asarray(opened.convert("RGB"), float))
        ball.page.locator("#canvas").press("m")
    assert np.abs(pictures[0] - plain).max() <= 1
    red = (pictures[1][..., 0] > 150) & (pictures[1][..., 1:].sum(axis=-1) == 0)
    assert 100 < red.sum() < 5000 and np.abs(pictures[1] - plain)[~red].max() <= 1


def test_the_camera_one_stands_in_is_not_drawn(ball: Viewer):
    lines = """(share) => { const { overlay, contents: { views } } = viewer, [view] = views;
      const aside = add(view.pose.centre, scaled(right(view.pose), share * overlay.frustumDepth));
      return overlay.cameraLines(null, aside).length - overlay.cameraLines(0, aside).length; }"""
    assert ball.run(lines, 0.1) == 0 and ball.run(lines, 1.0) == 8


def test_a_camera_behind_the_surface_is_not_clicked(ball: Viewer):
    """A camera that stands on the ray of a pixel, before the surface that this shows and behind it."""
    click = """(share) => {
      const { canvas, contents, navigation: { pose }, overlay } = viewer, { views } = contents;
      const lens = fitted(viewer.lens, canvas.width, canvas.height), y = 45.5;
      let x = 48.5;
      while (viewer.renderer.distanceAt(x, y) === null) ++x;
      const away = scaled(pixelDirection(pose, lens, x, y), share * viewer.renderer.distanceAt(x, y));
      contents.views = [{ ...views[0], pose: { ...views[0].pose, centre: add(pose.centre, away) } }];
      let clicked = null;
      const depth = overlay.frustumDepth;
      overlay.frustumDepth = 1e-3; // no corner looks out from behind
      viewer.showPhoto = (index) => (clicked = index);
      overlay.layers.cameras = true;
      viewer.clicked(x, y);
      overlay.layers.cameras = false;
      delete viewer.showPhoto;
      [contents.views, overlay.frustumDepth] = [views, depth];
      return clicked;
    }"""
    assert ball.run(click, 0.8) == 0 and ball.run(click, 1.3) is None


def test_a_lost_context_comes_back(ball: Viewer):
    before = ball.shown()
    ball.run("window.loss = viewer.renderer.graphics.gl.getExtension('WEBGL_lose_context'); loss.loseContext()")
    ball.until("viewer.renderer.graphics.gl.isContextLost()")
    ball.run("loss.restoreContext()")
    ball.until("!viewer.renderer.graphics.gl.isContextLost()")
    assert np.array_equal(ball.shown(), before)


def test_the_address_holds_the_view(browser: Any, ball: Viewer, tmp_path: Path):
    ball.run("viewer.navigation.orbit(0.3, 0.1); viewer.writeLink()")
    pose, link = ball.run("viewer.navigation.pose"), ball.run("location.hash")
    file = Path(ball.run("decodeURIComponent(location.pathname)"))
    other = Viewer(browser, file, fragment=link)
    assert np.allclose(other.run("viewer.navigation.pose.centre"), pose["centre"], atol=1e-5)
    assert np.allclose(other.run("viewer.navigation.pose.rotation"), pose["rotation"], atol=1e-5)
    other.close()
    ball.run("viewer.reset()")


@pytest.mark.parametrize("fragment", ["#c=1,2,&q=1,0,0,0&d=1", "#c=,,&q=,,,&d=", "#%E0%A4%A&v=depth"])
def test_an_address_cut_short_opens_the_first_view(browser: Any, ball: Viewer, fragment: str):
    page = Viewer(browser, ball.own, fragment=fragment)
    assert page.run("[viewer.navigation.pose, viewer.view]") == [ball.run("viewer.home()"), "colour"]
    assert page.faults == []
    page.close()


@pytest.mark.parametrize("view", ["cost", "toString", "", "Depth"])
def test_an_address_with_an_unknown_view_opens(browser: Any, ball: Viewer, view: str):
    page = Viewer(browser, ball.own, fragment=f"#c=0,0,-3&q=1,0,0,0&d=0.01&v={view}")
    assert page.run("[viewer.navigation.pose.centre, viewer.view]") == [[0, 0, -3], "colour"]
    assert page.faults == []
    page.run("viewer.reset()")
    assert page.run("viewer.navigation.distance") == ball.run("viewer.homeDistance"), "not the link's"
    page.close()


def test_controls_are_labelled_and_the_page_is_quiet(ball: Viewer):
    unnamed = """() => [...document.querySelectorAll("button, input, select, summary, canvas")]
      .filter((e) => !(e.labels?.length || e.textContent.trim() || e.getAttribute("aria-label"))).map((e) => e.id)"""
    assert ball.run(unnamed) == []
    assert ball.faults == []


def test_a_browser_without_webgl_2_is_told(browser: Any, tmp_path: Path):
    context = browser.new_context()
    page = context.new_page()
    page.add_init_script("delete window.WebGL2RenderingContext")
    page.goto(written(tmp_path, "box")[1].as_uri())
    assert "WebGL 2" in page.locator("#message").inner_text()
    context.close()
