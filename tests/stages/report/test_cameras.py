"""What the report says of the cameras: when they are doubtful, why, which photos are shown, what to try."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from stages import report
from stages.io.files import write_json
from stages.report import page
from stages.report.cameras import MAX_SHOWN, camera_report, doubtful_files, order_is_informative
from tests.stages.report.report_workspace import make_workspace, written

PHOTOS = 60


def files(count: int) -> list[str]:
    return [f"{i}.jpg" for i in range(count)]


def check(**changed: Any) -> dict[str, Any]:
    agree = {
        "pairs": 800,
        "agreeing": 780,
        "error_px": 0.25,
        "tolerance_px": 0.75,
        "noise_px": 0.18,
        "fits": True,
        "doubtful": [],
        "weak_links": [],
        "sequence_breaks": [],
    }
    return agree | changed


def opinion(**changed: Any) -> dict[str, Any]:
    agree = {"photos": PHOTOS, "agree": PHOTOS, "different": [], "centre": 0.0006, "degrees": 0.02, "failed": None}
    return (
        agree
        | {"agreeing": 100, "agreeing_other": 100, "taken": False, "drift": False, "linked": 1.0, "linked_other": 1.0}
        | changed
    )


def weak(*counts: int) -> list[dict[str, Any]]:
    """Weakly linked groups of so many photos."""
    return [{"photos": files(count), "pairs": 1, "matches": 40} for count in counts]


def registration(**changed: Any) -> dict[str, Any]:
    images = [{"file": file, "registered": True, "reason": None} for file in files(PHOTOS)]
    whole = {"source": "sfm", "photos": PHOTOS, "registered": PHOTOS, "images": images, "repeated_structure": None}
    return whole | {"check": check(), "global_mapping": opinion()} | changed


def test_cameras_that_agree_are_said_to_with_figures() -> None:
    said = camera_report(registration(), {})
    assert said.doubt is None and not said.groups and said.verdict == said.figures
    assert said.figures and re.findall(r"[\d.]*\d", said.figures) == ["780", "800", "0.25", "60", "60", "0.06"]


@pytest.mark.parametrize(
    ("changed", "groups"),
    [
        ({"check": check(doubtful=files(4))}, 1),
        ({"check": check(agreeing=399)}, 0),
        ({"check": check(error_px=0.96, fits=False)}, 0),
        ({"check": check(weak_links=weak(2))}, 1),
        ({"check": check(sequence_breaks=[[file, file] for file in files(4)])}, 1),
        ({"check": check(weak_links=[{"photos": [file], "pairs": 1, "matches": 9} for file in files(4)])}, 1),
        ({"global_mapping": opinion(different=files(4))}, 1),
        ({"check": None, "global_mapping": opinion(different=files(4))}, 1),
        ({"repeated_structure": {"photos": files(2), "others": files(9)}}, 2),
        ({"repeated_structure": {"photos": files(2), "others": files(9)}, "check": None, "global_mapping": None}, 2),
    ],
)  # fmt: skip
def test_each_kind_of_doubt_makes_the_cameras_doubtful(changed: dict[str, Any], groups: int) -> None:
    said = camera_report(registration(**changed), {})
    assert said.doubt and said.verdict == f"{said.doubt} {said.advice}" and len(said.groups) == groups


@pytest.mark.parametrize(
    ("changed", "groups"),
    [
        ({"check": check(doubtful=files(3))}, 1),
        ({"check": check(agreeing=400)}, 0),
        ({"check": check(weak_links=weak(1))}, 1),
        ({"check": check(sequence_breaks=[[file, file] for file in files(3)])}, 1),
        ({"global_mapping": opinion(different=files(3))}, 0),
        ({"global_mapping": opinion(different=files(40), agreeing_other=89)}, 0),
        ({"global_mapping": opinion(different=files(40), drift=True)}, 0),
        ({"global_mapping": opinion(different=files(40), linked_other=0.94)}, 0),
        ({"global_mapping": {"failed": "global mapping found no model"}}, 0),
    ],
)
def test_single_photos_are_shown_and_cast_no_doubt(changed: dict[str, Any], groups: int) -> None:
    said = camera_report(registration(**changed), {})
    assert said.doubt is None and len(said.groups) == groups


def test_of_a_large_group_the_first_photos_are_shown() -> None:
    (group,) = camera_report(registration(check=check(doubtful=files(20))), {}).groups
    assert (group.files, group.more) == (files(20)[:MAX_SHOWN], 20 - MAX_SHOWN)


def test_weak_links_are_shown_largest_first() -> None:
    groups = camera_report(registration(check=check(weak_links=weak(1, 2, 3, 4, 5, 6, 1))), {}).groups
    assert [len(group.files) + group.more for group in groups] == [6, 5, 4, 3, 1 + 2 + 1]


def test_a_global_mapping_that_falls_apart_casts_no_doubt() -> None:
    said = camera_report(registration(global_mapping=opinion(different=files(40), linked_other=0.71)), {})
    assert said.figures and re.findall(r"[\d.]*\d", said.figures)[3:] == ["40", "71"]


def test_a_contradicted_global_mapping_casts_no_doubt() -> None:
    said = camera_report(registration(global_mapping=opinion(different=files(40), agreeing_other=89)), {})
    assert said.figures and re.findall(r"[\d.]*\d", said.figures)[3:] == ["40", "89", "100"]


@pytest.mark.parametrize("second", [None, {"failed": "global mapping found no model"}, opinion(centre=None)])
def test_without_global_mapping_the_check_stands_alone(second: dict[str, Any] | None) -> None:
    said = camera_report(registration(global_mapping=second), {})
    assert said.figures and re.findall(r"[\d.]*\d", said.figures) == ["780", "800", "0.25"]


@pytest.mark.parametrize("unchecked", [None, {}, {"check": None}, {"check": check(pairs=0, agreeing=0)}])
def test_nothing_is_said_of_cameras_that_were_not_checked(unchecked: dict[str, Any] | None) -> None:
    old = unchecked and registration(**unchecked, global_mapping=None)
    said = camera_report(old, {})
    assert (said.verdict, said.doubt, said.groups) == (None, None, [])
    without = {key: value for key, value in registration().items() if key not in ("check", "global_mapping")}
    assert camera_report(without, {}).verdict is None and doubtful_files(without) == []


@pytest.mark.parametrize(
    ("source", "config", "tried"),
    [
        ("sfm", {}, ["--sfm.matcher exhaustive", "--sfm.seed 1"]),
        ("sfm", {"matcher": "exhaustive", "seed": 1}, ["--sfm.seed 2"]),
        ("import", {"matcher": None, "seed": 0}, ["--cameras"]),
    ],
)
def test_only_what_was_not_tried_yet_is_advised(source: str, config: dict[str, Any], tried: list[str]) -> None:
    said = camera_report(registration(source=source, check=check(agreeing=9)), config)
    assert re.findall(r"--[a-z.]+(?: exhaustive| \d)?", said.advice) == tried


def test_given_cameras_do_not_rest_on_matches() -> None:
    said = camera_report(registration(source="import", check=check(weak_links=weak(20))), {})
    assert said.doubt is None and not said.groups
    assert camera_report(registration(source="import", check=check(doubtful=files(4))), {}).doubt


@pytest.mark.parametrize(
    ("changed", "informative"), [({}, True), ({"match_graph": None}, True), ({"match_graph": {"order": False}}, False)]
)
def test_names_tell_an_order_unless_matching_found_otherwise(changed: dict[str, Any], informative: bool) -> None:
    assert order_is_informative(changed) is informative and order_is_informative(None)


# --- on the page


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    return make_workspace(tmp_path)


def change(inputs: dict[str, Path], **changed: Any) -> None:
    path = inputs["sfm"] / "registration.json"
    write_json(path, json.loads(path.read_text("utf-8")) | changed)


def png(numbers: range) -> list[str]:
    return [f"{i:04d}.png" for i in numbers]


def test_doubtful_cameras_come_first_with_photos_by_their_own_names(
    inputs: dict[str, Path], tmp_path: Path, progress: Any
):
    calm = written(inputs, tmp_path / "calm", progress)[0]
    link = {"photos": png(range(20, 22)), "pairs": 1, "matches": 31}
    change(inputs, check=check(doubtful=png(range(10)), weak_links=[link]))
    html, summary = written(inputs, tmp_path / "out", progress)
    assert summary["cameras_doubtful"] and summary["cameras_verdict"].startswith("The cameras are doubtful: ")
    assert summary["verdict"] == "Better than the nearest training view by 7.3 dB but soft."
    assert html.index("The cameras are doubtful: ") < html.index("<h1>") and "The cameras are doubtful" not in calm
    shown = re.findall(r'<figure><img src="data:image/jpeg[^"]*" alt="([^"]*)"><figcaption>', html)
    assert shown == [*(f"IMG_{i:04d}.jpg" for i in range(8)), "IMG_0020.jpg", "IMG_0021.jpg"]
    assert "and 2 more" in html
    line = report.run(report.Config(), inputs, tmp_path / "out", progress).line
    assert line.startswith("The cameras are doubtful.") and line.endswith(summary["verdict"])


def test_photos_whose_given_poses_are_contradicted_are_not_drawn(
    inputs: dict[str, Path], tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
):
    drawn: list[int] = []
    monkeypatch.setattr(page, "camera_svgs", lambda _, views, *__: str(drawn.append(len(views))) and {})
    change(inputs, source="import", check=check(doubtful=png(range(5))))
    assert "Left out of the plot: 5 photos" in written(inputs, tmp_path / "out", progress)[0]
    change(inputs, check=check(doubtful=png(range(24))))
    assert "Left out of the plot" not in written(inputs, tmp_path / "all", progress)[0]
    assert drawn == [19, 24]
