"""The page as a reader meets it: words that explain the figures, commands that can be copied, paper, narrow screens."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.io.files import SMALL_COPY, write_json, write_tensors
from tests.stages.report.report_workspace import add_stereo_check, make_workspace, written
from tests.stages.viewer.browser import WAIT_SECONDS, chromium


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_workspace(tmp_path_factory.mktemp("report"))


@pytest.mark.parametrize(
    ("name", "word"), [("Oma & <Co> #1.nerf", "'Oma &amp; &lt;Co&gt; #1.nerf'"), ("plain.nerf", "plain.nerf")]
)
def test_commands_can_be_copied_into_a_shell(name: str, word: str, tmp_path: Path, progress: Any):
    made = make_workspace(tmp_path)
    root = (tmp_path / "fox.nerf").rename(tmp_path / name)
    html, _ = written({stage: root / stage / folder.name for stage, folder in made.items()}, tmp_path / "out", progress)
    word = word.replace("'", "&#39;")
    assert f"<code>pipeline train {word} --more 183s</code>" in html and f"<code>pipeline resume {word}</code>" in html
    del made["train"]
    html, _ = written({"ingest": root / "ingest" / made["ingest"].name}, tmp_path / "few", progress)
    assert f"Go on from here: <code>pipeline resume {word}</code>" in html and "--more" not in html


def test_the_order_of_three_pictures_is_told_where_they_are(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    story = ["<b>render</b><b>photo</b>", "; drag to compare.", "6 dB more is half the error", "Below: the photo"]
    places = [html.index(words) for words in (*story, '<span class="tag">best')]
    assert places == sorted(places)


def test_scored_and_shown_photos_may_be_some(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8")) | {"photos_test": 9}
    write_json(path, metrics)
    html, _ = written(inputs, tmp_path / "out", progress)
    assert (
        "All 6 test photos that are scored" in html
        and "<p>25% of each of 6 of 9 photos at 96 × 72 (trained at 48 × 36)</p>" in html
    )
    write_json(path, metrics | {"images": metrics["images"][:1], "photos_scored": 1})
    assert (
        "<p>25% of 1 of 9 photos at 96 × 72 (trained at 48 × 36)</p>" in written(inputs, tmp_path / "one", progress)[0]
    )


def test_files_beside_the_page_are_named(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    manifest = json.loads((inputs["mesh"] / "manifest.json").read_text("utf-8"))
    manifest["outputs"] = {name: {} for name in ("mesh.glb", "mesh.ply", "preview.png", SMALL_COPY)}
    manifest["facts"] |= {"voxel": 0.25, "surface_area": 3.5, "iso_level": 40.0, "texture_outliers": 0.0147}
    write_json(inputs["mesh"] / "manifest.json", manifest)
    html, _ = written(inputs, tmp_path / "out", progress, video_limit_mb=0.001)
    assert "In <code>output/</code>: mesh.glb, mesh.ply." in html
    assert '<a href="video.mp4">' in html and "pass on both" in html
    for fact in ("0.25 units of the files", "3.5 square units of the files", "40 per scene unit", "1.47%"):
        assert f"<td>{fact}</td>" in html
    assert "pass on both" not in written(inputs, tmp_path / "small", progress)[0]
    manifest["facts"]["grid_space"] = "ndc"
    write_json(inputs["mesh"] / "manifest.json", manifest)
    html, _ = written(inputs, tmp_path / "ndc", progress)
    assert "<td>40 per unit of normalised device coordinates</td>" in html


def test_long_photo_names_are_broken(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    assert ".names td { overflow-wrap: anywhere; }" in html
    for head in ("<th>photo</th><th>why</th>", "<th>file</th><th>why</th>"):
        assert f'<table class="names">\n<thead><tr>{head}' in html


def test_the_curve_names_its_pixels(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    words = "The curve is of 2,048 pixels of all test photos"
    assert words in written(inputs, tmp_path / "out", progress)[0]
    unmeasured = {stage: folder for stage, folder in inputs.items() if stage != "evaluate"}
    assert words not in written(unmeasured, tmp_path / "unmeasured", progress)[0]


def test_every_picture_has_words_for_who_cannot_see_it(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    pictures, plots = re.findall(r"<(?:img|video)[^>]*>", html), re.findall(r"<[^>]*>\s*<svg", html)
    assert len(pictures) > 10 and all(re.search(r' (alt|aria-label)="[^"]', tag) for tag in pictures)
    assert len(plots) == 3 and all('role="img" aria-label="' in tag for tag in plots)


def test_paper_shows_what_it_can(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    style = re.search(r"@media print \{.*?\n\}", html, re.DOTALL)
    assert style is not None and ".film, .compare," in style[0] and "zoom" in style[0]
    assert html.index('<section class="film half">') < html.index("<h2>A new camera path")


def with_mesh_and_viewer(root: Path) -> dict[str, Path]:
    """The workspace with a red triangle as its mesh, and a viewer."""
    inputs = make_workspace(root)
    inputs["viewer"] = inputs["mesh"].parents[1] / "viewer" / inputs["mesh"].name
    inputs["viewer"].mkdir(parents=True)
    manifest = json.loads((inputs["mesh"] / "manifest.json").read_text("utf-8"))
    facts = {"drawn": True, "bits": 8, "loss_db": 0.0, "bytes": 1}
    write_json(inputs["viewer"] / "manifest.json", manifest | {"stage": "viewer", "facts": facts, "line": "2 MB"})
    corners = np.array([[-20000, 0, -20000], [20000, 0, -20000], [0, 0, 20000]], np.int16)
    red = np.tile(np.array([220, 20, 20], np.uint8), (3, 1))
    parts = {"positions": corners, "faces": np.array([[0, 1, 2]], np.uint16), "colours": red}
    write_tensors(inputs["mesh"] / SMALL_COPY, parts | {"middle": np.zeros(3), "radius": np.ones(1)})
    return inputs


def test_the_page_opens_with_the_way_to_the_viewer(tmp_path: Path, progress: Any):
    inputs = with_mesh_and_viewer(tmp_path)
    html, _ = written(inputs, tmp_path / "out", progress)
    link = re.findall(r'<a class="opening" href="viewer.html".*?</a>', html, re.DOTALL)
    assert len(link) == 1 and link[0].count("<img") == 1 and html.index(link[0]) < html.index("<h1>")
    assert re.search(r"width: calc\(min\(62vh, 520px\) \* 1\.33", link[0]), "its height is bounded"
    del inputs["evaluate"]
    few, _ = written(inputs, tmp_path / "few", progress)
    assert "<img" not in re.findall(r"<a class=.opening.*?</a>", few, re.DOTALL)[0]
    del inputs["viewer"]
    assert 'href="viewer.html"' not in written(inputs, tmp_path / "none", progress)[0]


def test_the_mesh_turns(tmp_path: Path, progress: Any):
    written(with_mesh_and_viewer(tmp_path), tmp_path / "out", progress)
    with chromium() as browser:
        page, faults = browser.new_page(viewport={"width": 500, "height": 700}), []
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.set_default_timeout(1000 * WAIT_SECONDS)
        page.goto((tmp_path / "out/report.html").as_uri())
        canvas = page.locator("#turntable")
        canvas.scroll_into_view_if_needed()
        assert not page.locator("img.still").is_visible()
        pictures = [canvas.screenshot()]
        for key in ("ArrowRight", "ArrowUp", "+"):
            canvas.press(key)
            pictures.append(canvas.screenshot())
        box = canvas.bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 60, box["y"] + 60)
        page.mouse.down()
        page.mouse.move(box["x"] + 120, box["y"] + 60)
        page.mouse.up()
        pictures.append(canvas.screenshot())
        page.locator("#clay").click()
        pictures.append(canvas.screenshot())
        assert len(set(pictures)) == len(pictures) and faults == []


@pytest.mark.parametrize("width", [320, 800, 1400, 2560])
def test_no_screen_is_too_narrow_and_wide_ones_are_used(tmp_path: Path, progress: Any, width: int):
    written(with_mesh_and_viewer(tmp_path), tmp_path / "out", progress)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.set_default_timeout(1000 * WAIT_SECONDS)
        page.goto((tmp_path / "out/report.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        cut_off = """[...document.querySelectorAll(":is(.stages, .effects) :is(th, td)")]
          .filter((e) => e.getBoundingClientRect().right > innerWidth).map((e) => e.textContent)"""
        assert page.evaluate(cut_off) == []
        halves = page.evaluate("[...document.querySelectorAll('.half')].map((e) => e.getBoundingClientRect().left)")
        assert len(set(halves)) == (2 if width >= 1280 else 1)


@pytest.mark.parametrize("supervised", [False, True])
def test_depth_beside_stereo_is_shown_where_it_is_known(supervised: bool, tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    without, _ = written(inputs, tmp_path / "without", progress)
    add_stereo_check(inputs, 5, supervised)
    html, _ = written(inputs, tmp_path / "with", progress)
    title = "<h2>Depth beside stereo</h2>"
    assert title not in without and html.count(title) == 1
    section = html.partition(title)[2].partition("</section>")[0]
    for figure in ("At 8.31% of", "nearer at 5.14%", "farther at 3.17%", "is 0.93%", "8,192 random pixels of 5 of 18 "):
        assert figure in section
    assert section.count('src="data:image/jpeg;base64,') == 2
    assert section.count("<tr><td>") == 5 and '<td class="number">0</td><td class="number">–</td>' in section
    assert ("supervised" in section) == supervised


def test_depth_that_was_compared_nowhere_is_not_shown(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    add_stereo_check(inputs, 1, False)
    file = inputs["evaluate"] / "stereo_check.json"
    write_json(file, json.loads(file.read_text("utf-8")) | {"pixels": 0, "worst": []})
    assert "Depth beside stereo" not in written(inputs, tmp_path / "out", progress)[0]
