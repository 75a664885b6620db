import json
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerf.effects.appearance import AppearanceModel
from nerf.effects.exposure import ExposureModel
from nerf.fields.interface import Rendering
from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages import render
from stages.contract import run_stage
from stages.io.files import read_json, write_json
from stages.io.transforms_export import transforms
from stages.render.path import CameraPath, make_path, median_camera, path_from_file, path_rays, resized
from stages.render.video import STARTING_SECONDS
from tests.camera_layouts import ring, wall
from tests.refusals import refused
from tests.video_files import read_video

CAMERA = Camera("OPENCV", 160, 120, (150.0, 151.0, 82.0, 60.0, 0.05, 0.0, 0.0, 0.001))
RADIUS = 0.6


class Ball:
    """An opaque ball about the origin, red where x > 0 and green elsewhere, before the background."""

    chunk_rays = 64

    def density(self, points):
        return (points.norm(dim=-1) < RADIUS) * 1e3

    def density_and_colour(self, points, directions):
        return self.density(points), self.colour(points)

    def colour(self, points):
        return torch.where(points[..., :1] > 0, torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0]))

    def render(self, rays, background):
        middle = -(rays.origins * rays.directions).sum(-1)
        closest = rays.origins + middle[:, None] * rays.directions
        inside = RADIUS**2 - (closest**2).sum(-1)
        t = middle - inside.clamp(min=0).sqrt()
        colour = self.colour(rays.origins + t[:, None] * rays.directions)
        hit = inside > 0
        return Rendering(torch.where(hit[:, None], colour, background), torch.where(hit, t, rays.far), hit.to(t.dtype))


def scene_with(poses: np.ndarray, capture_type: CaptureType = "object-centric", camera: Camera = CAMERA) -> Scene:
    views = tuple(
        View(f"{i}.jpg", f"images/{i}.png", 0, pose, 1.0, 9.0, "train" if i else "test") for i, pose in enumerate(poses)
    )
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    similarity = Similarity(0.5, turn, np.array([0.1, 0.2, 0.3]))
    return Scene((camera,), views, similarity, False, False, capture_type, True)


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """A ring of photos around an analytic ball, trained for ten seconds and drawn at 30,000 rays a second."""
    folders = {name: tmp_path / name for name in ("normalise", "train", "render")}
    for folder in folders.values():
        folder.mkdir()
    write_json(folders["normalise"] / "scene.json", scene_with(ring(12, radius=2.5, height=0.8)).to_json())
    info = {"background": [0.0, 0.0, 1.0], "downscale": 1.0, "rays": 100_000, "effects": {}}
    write_json(folders["train"] / "field.json", info)
    write_json(folders["train"] / "curve.json", {"points": [{"step": 9, "seconds": 10.0}]})
    monkeypatch.setattr(
        "stages.render.renderer.Renderer.rays_per_second", lambda self, sample, largest, seconds: 30_000
    )
    monkeypatch.setattr("stages.render.renderer.load_field", lambda *_: (Ball(), info))
    return folders


def given_path(content: dict[str, object], scene: Scene, folder: Path) -> CameraPath:
    (folder / "t.json").write_text(json.dumps(content))
    return path_from_file(scene, folder / "t.json")


def run(inputs, progress, **config):
    return run_stage(render.STAGE, render.Config(**config), inputs, inputs["render"], progress)


def test_video_and_depth_show_the_field_from_the_path(inputs, progress) -> None:
    result = run(inputs, progress, frames=8, width=80)
    frames, fps = read_video(inputs["render"] / "video.mp4")
    depth, _ = read_video(inputs["render"] / "depth.mp4")
    assert frames.shape == depth.shape == (8, 60, 80, 3)
    assert fps == 2
    corner, centre = frames[:, 3, 3].astype(int), frames[:, 30, 40].astype(int)
    assert (corner[:, 2] > 200).all()  # the blue background
    assert (centre[:, :2].max(axis=1) > 150).all()  # the ball in the middle of every frame
    assert {int(c.argmax()) for c in centre} == {0, 1}  # seen from both of its sides
    assert (depth[:, 30, 40, 0].astype(int) > depth[:, 30, 40, 2] + 50).all()  # near is red
    assert (depth[:, 3, 3, 0] < 100).all()  # far is not
    assert result.line.startswith("orbit, 8 frames 80×60 · rendered at ")
    assert set(result.outputs) == {"video.mp4", "depth.mp4", "path.json"}
    assert result.records == ("speed.json",)
    assert sorted(file.name for file in inputs["render"].iterdir()) == sorted([*result.outputs, *result.records])


def test_equal_inputs_give_equal_bytes(inputs, progress) -> None:
    names = run(inputs, progress, frames=3, width=40).outputs
    first = {name: (inputs["render"] / name).read_bytes() for name in names}
    run(inputs, progress, frames=3, width=40)
    assert first == {name: (inputs["render"] / name).read_bytes() for name in names}


def test_progress_rises_to_the_end(inputs, progress) -> None:
    run(inputs, progress, frames=3, width=40)
    shares = [done for _, done in progress.updates]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert progress.updates[-1][0].startswith("frame 3 of 3")


def test_frames_are_kept_and_depth_left_out_on_request(inputs, progress) -> None:
    outputs = run(inputs, progress, frames=3, width=40, depth=False, save_frames=True).outputs
    assert set(outputs) == {"video.mp4", "path.json", "frames"}
    assert [file.name for file in sorted((inputs["render"] / "frames").iterdir())] == [f"{i:05d}.png" for i in range(3)]


@pytest.mark.parametrize("depth", [True, False])
def test_depth_waits_on_the_disk_only_where_it_is_shown(inputs, progress, monkeypatch, depth: bool) -> None:
    """It is 0.5 GB of 120 frames of 1920×1080."""

    @contextmanager
    def writer(path: Path, *_: int) -> Iterator[Callable[[np.ndarray], None]]:
        yield lambda frame: temporary.append((path.parent / "inverse_depth.tmp").exists())

    temporary = list[bool]()
    monkeypatch.setattr("stages.render.video.video_writer", writer)
    run(inputs, progress, frames=3, width=40, depth=depth)
    assert temporary == (6 * [True] if depth else 3 * [False])
    assert not (inputs["render"] / "inverse_depth.tmp").exists()


def test_odd_widths_are_rounded_whatever_else_is_given(inputs, progress, tmp_path: Path) -> None:
    write_json(tmp_path / "t.json", transforms(scene_with(ring(5))))
    for given in ({}, {"frames": 3}, {"cameras": tmp_path / "t.json"}):
        assert render.plan(render.Config.model_validate({"width": 41, **given}), inputs, progress).width == 40
    assert render.Config(width=17).width == 16 and render.Config(width=640).width == 640
    run(inputs, progress, frames=3, width=41)
    assert read_video(inputs["render"] / "video.mp4")[0].shape == (3, 30, 40, 3)


def test_plan_answers_every_open_question(inputs, progress) -> None:
    config = render.plan(render.Config(), inputs, progress)
    assert (config.path, config.frames, config.width, config.fps) == ("orbit", 6, 140, 2)
    assert progress.names("render.size", "30 k rays/s", "6 frames 140×104", "2.9 s", "10 s", "--render.frames")
    assert render.plan(config, inputs, progress) == config
    assert progress.codes == ["render.size"]


@pytest.mark.parametrize(("seconds", "frames"), [(0.02, 6), (10.0, 6), (60.0, 27), (1000.0, 120)])
def test_drawing_is_expected_to_take_a_share_of_the_training(inputs, progress, seconds: float, frames: int) -> None:
    write_json(inputs["train"] / "curve.json", {"points": [{"seconds": 0.01}, {"seconds": seconds}]})
    config = render.plan(render.Config(), inputs, progress)
    assert config.frames == frames
    assert config.width is not None
    expected = frames * config.width**2 * 0.75 / 30_000
    assert 0.22 * min(seconds, 60) < expected < 0.32 * seconds or (frames, config.width) == (6, 32)


def test_a_video_that_must_take_longer_than_training_says_so(inputs, progress) -> None:
    write_json(inputs["train"] / "curve.json", {"points": [{"seconds": 0.1}]})
    render.plan(render.Config(), inputs, progress)
    render.plan(render.Config(frames=50), inputs, progress)
    assert progress.codes == ["render.size"] * 2
    assert "no smaller video" in progress.notes[0] and "as requested" in progress.notes[1]


def test_nothing_is_timed_where_nothing_is_open(inputs, progress) -> None:
    (inputs["train"] / "curve.json").unlink()
    config = render.plan(render.Config(frames=8, width=80), inputs, progress)
    assert (config.frames, config.width, config.fps, progress.notes) == (8, 80, 2, [])


@pytest.mark.parametrize(
    ("poses", "capture_type", "up_known", "path"),
    [
        (ring(), "object-centric", True, "orbit"),
        (ring(), "object-centric", False, "interpolated"),  # about which axis?
        (wall(), "forward-facing", False, "spiral"),
        (wall(columns=40), "forward-facing", True, "interpolated"),  # 12 wide, from 4 away
        (wall(), "inside-out", True, "interpolated"),
    ],
)
def test_the_layout_chooses_the_path(
    inputs, progress, poses, capture_type: CaptureType, up_known: bool, path: str
) -> None:
    scene = replace(scene_with(poses, capture_type), up_known=up_known)
    write_json(inputs["normalise"] / "scene.json", scene.to_json())
    assert render.plan(render.Config(), inputs, progress).path == path


def test_along_photos_that_face_one_way_the_horizon_is_level() -> None:
    poses = wall(columns=40)
    poses[::2, :, :2] *= -1  # upside down
    path = make_path(scene_with(poses, "forward-facing"), "interpolated", 30).poses
    assert (path[:, 2, 1] < -0.99).all()


def test_a_written_path_can_be_given_back_as_cameras(inputs, progress, tmp_path: Path) -> None:
    run(inputs, progress, frames=5, width=40)
    first, written = (inputs["render"] / "video.mp4").read_bytes(), inputs["render"] / "path.json"
    given = tmp_path / "cameras.json"
    given.write_bytes(written.read_bytes())
    result = run(inputs, progress, cameras=given, width=40)
    assert result.line.startswith("cameras from a file, 5 frames 40×30")
    frames, _ = read_video(inputs["render"] / "video.mp4")
    (tmp_path / "first.mp4").write_bytes(first)
    assert np.abs(frames.astype(int) - read_video(tmp_path / "first.mp4")[0]).mean() < 1


@pytest.mark.parametrize(("told", "given", "fps"), [(24, None, 24), (29.97, None, 30), (24, 10, 10), (None, None, 1)])
def test_a_paths_fps_is_the_videos(inputs, progress, told: float | None, given: int | None, fps: int) -> None:
    run(inputs, progress, frames=5, width=40)
    content = read_json(inputs["render"] / "path.json") | {"fps": told}
    write_json(cameras := inputs["render"].parent / "cameras.json", content)
    run(inputs, progress, cameras=cameras, width=40, fps=given)
    assert read_video(inputs["render"] / "video.mp4")[1] == fps


@pytest.mark.parametrize("fps", [0, -1, 121, "30", [30]])
def test_an_impossible_fps_is_refused(fps: object, tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    with refused("render.unusable-fps", "t.json", repr(fps)):
        given_path({"frames": [frame], "fps": fps}, scene_with(ring(5)), tmp_path)


def test_ray_directions_are_made_per_frame_and_lens(monkeypatch) -> None:
    """500 lenses at full size would be 12 GB."""
    made = []

    def camera_rays(camera: Camera, width: int, height: int) -> np.ndarray:
        made.append((camera.params[0], weakref.ref(rays := np.zeros((height, width, 3), np.float32))))
        return rays

    monkeypatch.setattr("stages.render.path.camera_rays", camera_rays)
    lenses = [replace(CAMERA, params=(focal, *CAMERA.params[1:])) for focal in (150.0, 150.0, 151.0, 152.0)]
    frames = path_rays(CameraPath(tuple(lenses), ring(4)), scene_with(ring(5)))
    given = []
    for _ in frames:
        given.append([focal for focal, _ in made])
        assert sum(rays() is not None for _, rays in made) == 1
    assert given == [[150], [150], [150, 151], [150, 151, 152]]


def test_cameras_and_path_exclude_each_other(inputs, progress, tmp_path: Path) -> None:
    with refused("render.cameras-and-path"):
        run(inputs, progress, cameras=tmp_path / "x.json", frames=5)


def test_exported_cameras_come_back_as_the_photos_own(tmp_path: Path) -> None:
    poses = ring(5)
    scene = scene_with(poses)
    path = given_path(transforms(scene), scene, tmp_path)
    np.testing.assert_allclose(path.poses, poses, atol=1e-12)
    assert path.cameras == (CAMERA,) * 5


def test_a_fisheye_lens_and_a_third_radial_term_are_understood(tmp_path: Path) -> None:
    frame = {"file_path": "r_0", "transform_matrix": np.eye(4).tolist(), "fl_x": 80, "k3": 0.01}
    radial = given_path({"frames": [frame]}, scene_with(ring(5)), tmp_path).cameras[0]
    assert (radial.model, radial.params[4:]) == ("FULL_OPENCV", (0, 0, 0, 0, 0.01, 0, 0, 0))
    fisheye = given_path({"frames": [frame], "is_fisheye": True}, scene_with(ring(5)), tmp_path).cameras[0]
    assert (fisheye.model, fisheye.params[4:]) == ("OPENCV_FISHEYE", (0, 0, 0.01, 0))


def test_blender_angles_are_understood_without_sizes(tmp_path: Path) -> None:
    frame = {"file_path": "r_0", "transform_matrix": np.eye(4).tolist()}
    camera = given_path({"camera_angle_x": np.pi / 2, "frames": [frame]}, scene_with(ring(5)), tmp_path).cameras[0]
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 160, 120)
    assert camera.params == pytest.approx((80, 80, 80, 60))


@pytest.mark.parametrize(
    ("frame", "named"),
    [
        ({"transform_matrix": [[1, 2], [3, 4]]}, "4 × 4"),
        ({"transform_matrix": 7}, "4 × 4"),
        ({"transform_matrix": None}, "transform_matrix"),
        ({"transform_matrix": np.zeros((4, 4)).tolist()}, "singular"),
        ({"transform_matrix": np.eye(4).tolist(), "fl_x": -3}, "-3 × -3"),
    ],
)
def test_unusable_frames_are_named(frame, named: str, tmp_path: Path) -> None:
    with refused("render.unusable-frame", "frame 0 of t.json", named):
        given_path({"frames": [{"file_path": "a"} | frame]}, scene_with(ring(5)), tmp_path)


def test_frames_beyond_all_screens_are_refused(tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), "w": 10**6, "h": 10}
    with refused("render.large-frames", "t.json", 1000000):
        given_path({"frames": [frame]}, scene_with(ring(5)), tmp_path)


def test_frames_of_different_size_make_no_video(tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    with refused("render.frame-sizes", "t.json"):
        given_path({"frames": [frame, frame | {"w": 10, "h": 10}]}, scene_with(ring(5)), tmp_path)


def test_the_median_camera_keeps_the_angle_of_view() -> None:
    scene = scene_with(ring(5))
    camera = median_camera(scene)
    assert camera == Camera("PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))
    half = resized(camera, 80)
    assert (half.width, half.height, half.params) == (80, 60, (75.0, 75.0, 40.0, 30.0))
    assert make_path(scene, "orbit", 7).cameras == (camera,) * 7


@pytest.mark.parametrize(
    ("sizes", "size"),
    [
        ([(160, 120), (160, 120), (120, 160)], (160, 120)),
        ([(120, 160), (160, 120)], (160, 120)),
        ([(50, 40), (400, 301), (404, 300), (410, 300), (300, 402)], (400, 301)),  # each cut by hand
        ([(100, 80), (100, 80), (400, 301), (404, 300), (410, 300)], (100, 80)),
    ],
)
def test_the_median_camera_has_the_usual_size(sizes, size) -> None:
    cameras = [Camera("PINHOLE", w, h, (150.0, 150.0, w / 2, h / 2)) for w, h in sizes]
    scene = scene_with(ring(1 + len(sizes)))  # the first is a test photo
    views = [replace(view, camera=max(0, index - 1)) for index, view in enumerate(scene.views)]
    camera = median_camera(replace(scene, cameras=tuple(cameras), views=tuple(views)))
    assert (camera.width, camera.height) == size


def test_a_fisheye_is_shown_no_wider_than_a_right_angle() -> None:
    fisheye = Camera("OPENCV_FISHEYE", 160, 120, (40.0, 40.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0))
    assert median_camera(scene_with(ring(5), camera=fisheye)).params[0] == 80.0


def test_speed_is_a_record_and_path_an_output(inputs, progress) -> None:
    run(inputs, progress, frames=3, width=40)
    assert read_json(inputs["render"] / "speed.json")["frames_per_second"] > 0
    content = read_json(inputs["render"] / "path.json")
    assert len(content["frames"]) == 3
    assert (content["w"], content["h"], content["fps"]) == (40, 30, 1)


NEUTRAL = "reference exposure, +1.00 EV over the least exposed photo"


def with_exposure(inputs, monkeypatch) -> None:
    """The ball as a field with an exposure of its own, half of the photos a stop brighter and half a stop darker."""
    ev = [1, 1, 0, 0, 0, 0, 0, -1, 0, 1, 1]  # 0.jpg, the test photo, stands between the ends of the ring
    photos = {f"{number}.jpg": [np.log(2) * gain] * 3 for number, gain in enumerate(ev, 1)}
    info = read_json(inputs["train"] / "field.json") | {"effects": {"exposure": photos}}
    write_json(inputs["train"] / "field.json", info)
    shown = AppearanceModel(GreyBall(), (ExposureModel(torch.zeros(1, 3)),))
    monkeypatch.setattr("stages.render.renderer.load_field", lambda *_: (shown, info))


class GreyBall(Ball):
    def colour(self, points):
        return torch.full_like(points, 0.5)


@pytest.mark.parametrize(
    ("like", "level", "words"),
    [(None, 0.5, NEUTRAL), ("1.jpg", 0.6858, "exposed like 1.jpg"),
     ("8.jpg", 0.3608, "exposed like 8.jpg")],
)  # fmt: skip
def test_a_field_with_exposure_is_rendered_at_a_stated_one(
    inputs, progress, monkeypatch, like: str | None, level: float, words: str
) -> None:
    with_exposure(inputs, monkeypatch)
    result = run(inputs, progress, frames=2, width=40, match_exposure=like, save_frames=True)
    assert result.facts["appearance"] == words and f" · {words} · " in result.line
    frame = np.asarray(Image.open(inputs["render"] / "frames/00000.png"))
    assert np.abs(frame[15, 20] / 255 - level).max() < 0.004
    assert frame[1, 1].tolist() == [0, 0, 255]  # the background has no exposure


def test_a_field_without_exposure_says_nothing_of_it(inputs, progress) -> None:
    result = run(inputs, progress, frames=2, width=40)
    assert "appearance" not in result.facts and "expos" not in result.line
    progress.clear()
    assert "appearance" not in run(inputs, progress, frames=2, width=40, match_exposure="3.jpg").facts
    assert progress.codes == ["render.no-exposure"] and progress.names("render.no-exposure", "3.jpg")


@pytest.mark.parametrize(
    ("like", "level", "words", "note"),
    [
        ("0.jpg", 0.6858, "exposed as estimated for 0.jpg", ("render.expected-exposure", "0.jpg")),
        ("81.jpg", 0.5, NEUTRAL, ("render.no-such-photo", "81.jpg", NEUTRAL, " 8.jpg")),
    ],
)
def test_missing_exposure_is_no_error_after_training(
    inputs, progress, monkeypatch, like: str, level: float, words: str, note: tuple[str, ...]
) -> None:
    with_exposure(inputs, monkeypatch)
    result = run(inputs, progress, frames=2, width=40, match_exposure=like, save_frames=True)
    assert result.facts["appearance"] == words and progress.names(*note)
    frame = np.asarray(Image.open(inputs["render"] / "frames/00000.png"))
    assert np.abs(frame[15, 20] / 255 - level).max() < 0.004


@pytest.mark.parametrize("seconds", [3.0, 10.0, 60.0])
def test_seconds_given_bound_the_video_whatever_training_took(inputs, progress, seconds: float) -> None:
    config = render.plan(render.Config(seconds=seconds), inputs, progress)
    assert config.frames is not None and config.width is not None
    expected = config.frames * config.width**2 * 0.75 / 30_000
    assert 0.4 * (seconds - STARTING_SECONDS) < expected < seconds
    assert f"given {seconds:g} s" in progress.notes[0].replace("1 min", "60 s")
