"""The page: complete, escaped, self-contained, the same twice, and readable with stages missing."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import report
from stages.io.files import read_json, write_json
from stages.report import page
from stages.tradeoff.pareto_front import recommend, table
from tests.refusals import refused
from tests.stages.report.report_workspace import LINES, SPANS, make_workspace, written
from tests.stages.tradeoff.test_pareto_front import point


class _Links(HTMLParser):
    """Collects everything that a browser would load, and the tags."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "poster")]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_workspace(tmp_path_factory.mktemp("report"))


def test_training_that_another_one_went_on_from_counts_in_all(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    manifest = read_json(inputs["train"] / "manifest.json")
    more = {"facts": manifest["facts"] | {"train_seconds": 483.3, "earlier_seconds": 310.5}}
    before = written(inputs, tmp_path / "before", progress)[1]["total_seconds"]
    write_json(inputs["train"] / "manifest.json", manifest | more)
    html, summary = written(inputs, tmp_path / "out", progress)
    assert summary["total_seconds"] == pytest.approx(before + 310.5) and summary["total_seconds"] > 483.3
    assert summary["stage_seconds"]["train"] == 181.7
    assert "in all 10 min" in html


def test_near_duplicates_do_not_count_as_unregistered(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    registration = read_json(inputs["sfm"] / "registration.json")
    counts = {"photos": 24, "registered": 24, "near_duplicates": 1}
    write_json(inputs["sfm"] / "registration.json", registration | counts)
    html, summary = written(inputs, tmp_path / "out", progress)
    assert {count: summary[count] for count in counts} == counts
    assert "24 of 24 photos are registered, 1 near-duplicate left out;" in html
    assert "Photos without a camera: 1, of which 1 near-duplicate<" in html
    photos = read_json(inputs["ingest"] / "photos.json")
    photos["photos"][-1]["near_duplicate_of"] = photos["photos"][0]["name"]
    write_json(inputs["ingest"] / "photos.json", photos)
    _, before_sfm = written({"ingest": inputs["ingest"]}, tmp_path / "ingest-alone", progress)
    assert before_sfm["photos"] == counts["photos"]


def test_summary_has_exactly_the_promised_keys(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    _, summary = written(inputs, tmp_path / "out", progress)
    assert summary == {
        "photos": 25,
        "registered": 24,
        "near_duplicates": 0,
        "camera_model": "OPENCV",
        "reprojection_px": 0.61,
        "cameras_verdict": None,
        "cameras_doubtful": False,
        "field": "vanilla",
        "train_seconds": 183.3,
        "total_seconds": pytest.approx(58.2 + 181.7 + 60.1 + 5 * 2.5),
        "stage_seconds": {"ingest": 2.5, "sfm": 58.2, "normalise": 2.5, "scale": 2.5, "train": 181.7}
        | {"evaluate": 2.5, "render": 60.1, "mesh": 2.5},
        "expected_seconds": {},
        "training_profile": SPANS,
        "psnr": 21.5,
        "ssim": 0.62,
        "psnr_mean_image": 12.9,
        "psnr_nearest_view": 14.2,
        "metres_per_unit": 0.5,
        "scored_fraction": 0.25,
        "mesh": {"vertices": 105_900, "faces": 211_817, "watertight": False},
        "verdict": "Better than the nearest training view by 7.3 dB but soft.",
        "budget": None,
    }


def test_a_budget_is_shown_promised_beside_spent_and_in_all(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    account = {"seconds": 300.0, "allocated": {"sfm": 50.0, "train": 170.0}, "spent": {"train": 166.0, "mesh": 12.0}}
    html, summary = written(inputs, tmp_path / "out", progress, budget=account)
    assert summary["budget"] == account
    text = " ".join(re.sub("<[^>]+>", " ", html).split())
    assert "The budget was 5 min; 2 min 58 s " in text
    rows = {row[0]: row[2:4] for row in ([re.sub("<[^>]+>", "", c) for c in re.findall("<td.*?</td>", line)]
            for line in re.findall("<tr>.*</tr>", html.split("How it was made")[1])) if len(row) == 6}  # fmt: skip
    assert rows["sfm"] == ["50 s", "–"] and rows["train"] == ["2 min 50 s", "2 min 46 s"] and rows["mesh"][1] == "12 s"
    assert "The budget was" not in written(inputs, tmp_path / "without", progress)[0]


def test_without_a_budget_expected_stands_beside_spent(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    for stage, seconds in (("sfm", 50.0), ("train", 184.0), ("mesh", None)):
        manifest = read_json(inputs[stage] / "manifest.json")
        write_json(inputs[stage] / "manifest.json", manifest | {"expected": seconds})
    html, summary = written(inputs, tmp_path / "out", progress)
    assert summary["expected_seconds"] == {"sfm": 50.0, "train": 184.0}
    made = html.split("How it was made")[1]
    assert '<th class="number">expected</th>' in made
    rows = {row[0]: row[2:4] for row in ([re.sub("<[^>]+>", "", c) for c in re.findall("<td.*?</td>", line)]
            for line in re.findall("<tr>.*</tr>", made)) if len(row) == 5}  # fmt: skip
    assert rows["sfm"] == ["50 s", "58 s"] and rows["train"] == ["3 min 4 s", "3 min 2 s"] and rows["mesh"][0] == "–"
    account = {"seconds": 300.0, "allocated": {}, "spent": {}}
    assert '<th class="number">expected</th>' not in written(inputs, tmp_path / "budget", progress, budget=account)[0]


def test_page_loads_nothing_from_elsewhere(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    parser = _Links()
    parser.feed(html)
    assert len(parser.links) > 15
    assert all(link.startswith(("data:", "#")) for link in parser.links)
    assert not re.search(r"url\((?!#)", html)
    assert "link" not in parser.tags and "script" not in parser.tags


def test_names_of_photos_are_escaped(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "<script" not in html and "&lt;script&gt;alert(1)&lt;/script&gt;.jpg" in html
    assert "blurred &lt;b&gt;.jpg" in html and "notes &amp; sums.jpg" in html


def test_the_name_of_a_workspace_need_not_be_unicode(tmp_path: Path, progress: Any):
    made = make_workspace(tmp_path)
    root = (tmp_path / "fox.nerf").rename(tmp_path / "caf\udce9.nerf")
    html, _ = written({stage: root / stage / folder.name for stage, folder in made.items()}, tmp_path / "out", progress)
    assert "<title>caf\\udce9.nerf" in html


def test_page_is_the_same_twice_and_gives_no_folder_away(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    assert html == written(inputs, tmp_path / "again", progress)[0]
    assert str(inputs["train"].parents[2]) not in html and "/home/someone" not in html
    assert "pipeline resume fox.nerf" in html


def test_page_answers_questions_in_order(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    story = [
        "Better than the nearest training view by 7.3 dB but soft.",
        "21.5 <span>dB ± 0.4</span>",
        "<video",
        "gained +0.5 dB on test pixels",
        "diverged or met non-finite values 2 times.",
        '<span class="tag">best</span> IMG_0020.jpg',
        '<span class="tag">median</span> &lt;script&gt;alert(1)',
        '<span class="tag">worst</span> IMG_0000.jpg',
        "All 6 test photos",
        "<td>211,817",
        "from above",
        "only 12 matches with any other photo",
        "not an image: text",
        "3 min 2 s",
        "--evaluate.background",
        "2.13.0",
    ]
    places = [html.find(words) for words in story[2:]]
    assert all(words in html for words in story)
    assert places == sorted(places)


def test_page_shows_the_evidence_for_the_camera_model(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "<summary>Camera model: OPENCV, principal point refined</summary>" in html
    assert "by at most 3 times the noise of the difference" in html
    for cells in ('0.6912</td><td class="number">0.0812 ± 0.0101</td><td></td>', "<td>chosen</td>"):
        assert cells in html
    assert "–</td><td>its distortion has no inverse at 2.0% of the pixels</td>" in html
    assert "pose of the median photo is known to 0.26 px" in html
    assert "the least certain one (IMG_0023.jpg) to 0.48 px" in html
    path = inputs["sfm"] / "registration.json"
    registration = json.loads(path.read_text("utf-8"))
    unknown = [image | {"uncertainty_px": None} for image in registration["images"]]
    write_json(path, registration | {"camera_models": [], "images": unknown})  # as with given cameras
    html, _ = written(inputs, tmp_path / "given", progress)
    assert "Camera model:" not in html and "pose is known" not in html


STRATEGIES = [
    dict(zip(("strategy", "registered", "points", "reprojection_px", "kept", "skipped"), row, strict=True))
    for row in [
        ("default", 20, 7000, 0.6, False, None),
        ("fisheye", None, None, None, False, "starting over is not worth it for 4 of 24 photos"),
        ("relaxed ratio test", 23, 8123, 0.61, True, None),
        ("weaker initial pair", 0, 0, None, False, None),
        ("other seed", 23, 8100, 0.6, False, None),
        ("global mapping", 23, 8123, 0.75, False, None),
    ]
]


def test_page_shows_what_was_tried_to_find_the_cameras(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    path = inputs["sfm"] / "registration.json"
    registration = json.loads(path.read_text("utf-8"))
    write_json(path, registration | {"strategies": STRATEGIES})
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "<summary>Strategies tried to find the cameras: 5</summary>" in html
    row = re.compile(r"<tr><td>([^<]*)</td><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td><td>([^<]*)<")
    table = html[html.index("Strategies tried") :].partition("</table>")[0]
    assert row.findall(table) == [
        ("default", "20", "7,000", "0.60", "fewer photos"),
        ("fisheye", "–", "–", "–", "skipped: starting over is not worth it for 4 of 24 photos"),
        ("relaxed ratio test", "23", "8,123", "0.61", "kept"),
        ("weaker initial pair", "0", "0", "–", "no model"),
        ("other seed", "23", "8,100", "0.60", "fewer points"),
        ("global mapping", "23", "8,123", "0.75", "a larger error"),
    ]
    write_json(path, registration | {"strategies": STRATEGIES[2:3]})  # the default was enough
    html, _ = written(inputs, tmp_path / "one", progress)
    assert "Strategies tried" not in html


def test_page_shows_the_study_and_leaves_its_time_out(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    before, summary_before = written(inputs, tmp_path / "before", progress)
    inputs["tradeoff"] = tmp_path / "fox.nerf" / "tradeoff" / "0123456789abcdef"
    inputs["tradeoff"].mkdir(parents=True)
    points = [
        point(10.0, 20.0),
        point(20.0, 23.0, seeds=2, psnr_std=0.2),
        point(15.0, 18.0, variant="no view dependence"),
    ]
    points = sorted(points, key=lambda p: p.train_seconds)
    study = {"headline": "", "recommendation": recommend(points).words, "recommended": 3, "points": table(points)}
    study |= {"descriptions": "grid: 5 grids of features"}
    study |= {"command": "pipeline train fox.nerf --train.seconds 20", "ablation": "Against the complete one: −2 dB."}
    study |= {
        "workspace_field": None,
        "scored": "6 crops of 2 held-out photos",
        "left_out": ["vanilla, published: 5 steps"],
    }
    write_json(inputs["tradeoff"] / "tradeoff.json", study)
    (inputs["tradeoff"] / "manifest.json").write_text('{"seconds": 1800}')
    assert "What quality costs here" not in before
    text, summary = written(inputs, tmp_path / "out", progress)
    assert "What quality costs here" in text and study["recommendation"] in text
    for words in ("All 3 settings", "<b>23.00 ± 0.20</b>", ">18.00<", "6 crops of 2", "vanilla, published: 5 steps"):
        assert words in text, words
    assert "reduced, a part left out" in text, "the plot's legend"
    assert "Train it: <code>pipeline train fox.nerf --train.seconds 20</code>" in text
    assert "number 1 renders fastest, 1.00 s a frame" in text
    assert "Fields: grid: 5 grids of features." in text
    assert "What each part of the method is worth" not in text, "no picture, no title"
    assert "the star" not in text and "trained again" not in text
    assert summary == summary_before, "the study's time is none of the run's"
    Image.new("RGB", (64, 48)).save(inputs["tradeoff"] / "ablation.png")
    for key, older in (("fedcba9876543210", True), (inputs["train"].resolve().name, False)):
        study |= {"workspace_field": {"train": key, "stride": 1}}
        write_json(inputs["tradeoff"] / "tradeoff.json", study)
        text = written(inputs, tmp_path / f"pictures_{older}", progress)[0]
        assert "Every mark is a setting, the star this workspace's field, scored on" in text
        assert ("has been trained again since this study." in text) == older
    assert "What each part of the method is worth" in text and "Against the complete one: −2 dB." in text


def test_a_large_video_lies_beside_the_page(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress, video_limit_mb=0.001)
    assert 'src="video.mp4"' in html and "data:video" not in html


@pytest.mark.parametrize("last", ["ingest", "sfm", "normalise", "train", "evaluate", "render"])
def test_page_reads_well_when_later_stages_are_missing(
    last: str, inputs: dict[str, Path], tmp_path: Path, progress: Any
):
    stages = list(LINES)[: list(LINES).index(last) + 1]
    html, summary = written({stage: inputs[stage] for stage in stages}, tmp_path / "out", progress)
    assert LINES[last] in html and "None" not in html and "Undefined" not in html
    assert summary["mesh"] is None
    assert (summary["psnr"] is None) == (last not in ("evaluate", "render"))
    if summary["psnr"] is None:
        assert summary["verdict"] == "Not measured: stage evaluate has not run."


@pytest.mark.parametrize(
    ("resumed", "command"),
    [(None, "resume"), (("ingest", "train", "evaluate"), "resume"), (("ingest", "sfm"), "evaluate")],
)
def test_what_is_not_measured_names_the_command_for_it(
    resumed: tuple[str, ...] | None, command: str, inputs: dict[str, Path], tmp_path: Path, progress: Any
):
    found = {stage: inputs[stage] for stage in ("ingest", "sfm", "normalise", "train")}
    config = report.Config(resumed=resumed)
    (tmp_path / "out").mkdir()
    line = report.run(config, found, tmp_path / "out", progress).line
    html = (tmp_path / "out/report.html").read_text("utf-8")
    assert line == f"Not measured: stage evaluate has not run. `pipeline {command} fox.nerf` runs it."
    assert f"<code>pipeline {command} fox.nerf</code> runs it." in html
    assert f"then what follows from it: <code>pipeline {command} fox.nerf</code>" in html


def test_without_test_photos_the_page_says_so(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    nothing = dict.fromkeys(("psnr", "ssim", "psnr_interval", "psnr_mean_image", "psnr_nearest_view"))
    note = {"code": "evaluate.nothing-measured", "text": "no photo was kept"}
    write_json(path, metrics | nothing | {"images": [], "verdict": "Not measured.", "notes": [note]})
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "No photo was kept." in html and "None" not in html


@pytest.mark.parametrize(
    ("tests", "roles"), [(1, ["test photo"]), (2, ["test photo"] * 2), (3, ["best", "median", "worst"])]
)
def test_few_test_photos_are_all_shown(tests: int, roles: list[str], tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    write_json(path, metrics | {"images": metrics["images"][:tests]})
    html, _ = written(inputs, tmp_path / "out", progress)
    assert re.findall(r'<span class="tag">([^<]+)</span>', html) == roles
    assert "<details>\n<summary>All" not in html


def test_transparent_photos_are_shown_as_they_were_scored():
    pixels = np.array([[[200, 100, 0, 0], [200, 100, 0, 255], [200, 100, 0, 51]]], np.uint8)
    assert page._opaque(pixels, 255).tolist() == [[[255, 255, 255], [200, 100, 0], [244, 224, 204]]]
    assert page._opaque(pixels[..., :3], 255).tolist() == [[[200, 100, 0]] * 3]


def test_a_finished_stage_lacking_a_file_is_named(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    (inputs["train"] / "curve.json").unlink()
    with refused("io.damaged-json", "curve.json"):
        written(inputs, tmp_path / "out", progress)


@pytest.mark.parametrize(
    ("value", "words"),
    [(None, "–"), (True, "yes"), (0.00012345, "0.0001234"),
     (120_000.0, "120,000"), ([1, None], "1, –"), ({"a": 2}, "a 2"),
     ("/home/someone/fox", "fox"), ("white", "white")],
)  # fmt: skip
def test_settings_in_words(value: Any, words: str):
    assert page._value(value) == words


def test_training_shows_where_its_time_went(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "<h3>Where training spent its time</h3>" in html
    assert re.search(r"backward</td>.*?50\.0%.*?70%", html)
    assert "take 60% of its time" in html and "The limit is then 7.2 k rays/s; these steps reached 3.9 k" in html
    assert "They computed 49 k colours/s: per ray 30.0 densities and 12.5 colours." in html
    widths = [float(width) for width in re.findall(r'<i style="width: ([\d.]+)%; background', html)]
    assert widths == [50, 30, 10, 10]


def test_a_training_without_timed_steps_is_no_fault(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    (inputs["train"] / "profile.json").unlink()
    html, summary = written(inputs, tmp_path / "out", progress)
    assert "Where training spent its time" not in html and summary["training_profile"] is None


def test_a_field_of_no_use_is_named(inputs: dict[str, Path], tmp_path: Path, progress: Any):
    path = inputs["train"] / "manifest.json"
    manifest = json.loads(path.read_text("utf-8"))
    manifest["facts"]["failure_reason"] = "it is empty (mean opacity 0e+00)"
    write_json(path, manifest)
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "<b>The field is undertrained:</b> it is empty (mean opacity 0e+00)." in html
