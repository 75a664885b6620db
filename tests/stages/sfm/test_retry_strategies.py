from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stages.sfm import worker
from stages.sfm.retry_strategies import (
    MAX_SECONDS_LIMIT,
    STRATEGIES,
    TIME_GIVEN,
    Outcome,
    Situation,
    Skip,
    StrategyLog,
    abandon,
    exceeds_time,
    expected_seconds,
    mapping_seconds,
    reason_against,
)

BY_NAME = {strategy.name: strategy for strategy in STRATEGIES}


def test_the_list_begins_with_the_default_and_names_are_unique() -> None:
    assert STRATEGIES[0].matches == "strict" and not STRATEGIES[0].description
    assert len(BY_NAME) == len(STRATEGIES)
    assert all(strategy.description for strategy in STRATEGIES[1:])


def test_more_photos_beat_more_points_beat_less_error() -> None:
    groups = [["a", "b", "c"], ["d"]]
    ranked = [
        Outcome("none", "x.db"),
        Outcome("misfit", "x.db", groups, 900, 0.1, fits=False),
        Outcome("few", "x.db", [["a", "b"]], 900, 0.1),
        Outcome("inexact", "x.db", groups, 500, 0.9),
        Outcome("exact", "x.db", groups, 500, 0.3),
        Outcome("more", "x.db", groups, 501, 2.0),
    ]
    ranks = [outcome.rank for outcome in ranked]
    assert ranks == sorted(set(ranks))


def test_the_log_is_read_back_and_knows_the_best(tmp_path: Path) -> None:
    log = StrategyLog(tmp_path / "strategies")
    assert log.best() is None and log.left() == STRATEGIES
    one, other = Outcome("default", "x.db", [["a", "b"]], 50, 0.5), Outcome("other seed", "x.db", [["a", "b"]], 50, 0.5)
    for outcome in (one, Outcome("weaker initial pair", "x.db"), other):
        log.add(outcome)
    again = StrategyLog(tmp_path / "strategies")
    assert again.outcomes == log.outcomes and again.best() == one  # of equals the first
    assert [strategy.name for strategy in again.left()] == ["global mapping", "more features"]
    assert again.model("other seed") == tmp_path / "strategies" / "other-seed"


def test_the_report_lists_tried_and_skipped_strategies(tmp_path: Path) -> None:
    log = StrategyLog(tmp_path / "strategies")
    log.add(Outcome("default", "x.db", [["a", "b"]], 50, 0.5))
    log.skipped["fisheye"] = Skip("the camera model is given")
    log.add(Outcome("relaxed ratio test", "x.db", [["a", "b", "c"]], 60, 0.4))
    log.skipped["weaker initial pair"] = Skip("not noted: nothing was tried after it")
    again = StrategyLog(tmp_path / "strategies")
    assert again.skipped == {"fisheye": Skip("the camera model is given")}
    none = {"registered": None, "points": None, "reprojection_px": None}
    assert again.report() == [
        {"strategy": "default", "registered": 2, "points": 50, "reprojection_px": 0.5, "kept": False, "skipped": None},
        {"strategy": "fisheye", **none, "kept": False, "skipped": "the camera model is given"},
        {"strategy": "relaxed ratio test", "registered": 3, "points": 60, "reprojection_px": 0.4}
        | {"kept": True, "skipped": None},
    ]


TIMED = [
    Outcome("default", "x.db", seconds={"features": 10.0, "matching": 40.0, "mapping": 20.0}),
    Outcome("other seed", "x.db", seconds={"mapping": 30.0}),
]


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("fisheye", 40 + 30),
        ("relaxed ratio test", 2 * 0.75 * 40 + 30),
        ("missing photos", 2 * 0.75 * 40 + 0.4 * 30),
        ("weaker initial pair", 30),
        ("global mapping", 30),
        ("more features", 1.25 * 4 * 10 + 4 * 0.75 * 40 + 2 * 30),
    ],
)
def test_earlier_strategies_predict_the_seconds_of_the_next(name: str, seconds: float) -> None:
    assert expected_seconds(BY_NAME[name], TIMED, 0.75, 4.0) == pytest.approx(seconds)


def test_a_strategy_must_leave_time_for_the_final_bundle_adjustment() -> None:
    assert exceeds_time(50.0, TIMED, 50.0 + 2 * 30 - 1)
    assert not exceeds_time(50.0, TIMED, 50.0 + 2 * 30 + 1)


@pytest.mark.parametrize(
    ("size", "longer", "enlarged"),
    [(1600, 1536, 4), (1600, 1000, 1), (1600, 3000, (3000 / 1600) ** 2), (800, 1000, (1000 / 1600) ** 2)],
    ids=["of usual size", "doubled before", "larger", "doubled no more"],
)
def test_more_features_take_time_by_their_pixels(size: int, longer: int, enlarged: float) -> None:
    photo = SimpleNamespace(width=longer, height=longer // 2)
    job = SimpleNamespace(matcher="exhaustive", max_image_size=size, max_features=500)
    state: Any = SimpleNamespace(log=SimpleNamespace(outcomes=TIMED), photos=[photo], job=job)
    more = min(2, max(1, enlarged))
    seconds = 1.25 * enlarged * 10 + 0.2 * more**2 * 40 + more * 30
    assert worker._expected(BY_NAME["more features"], [0], state) == pytest.approx(seconds)


def test_global_mapping_does_not_predict_incremental_mapping() -> None:
    hung = Outcome("global mapping", "x.db", seconds={"mapping": 500.0})
    assert mapping_seconds([*TIMED, hung]) == 30


def test_strategies_that_ended_the_worker_are_remembered(tmp_path: Path) -> None:
    ended, late = Skip("it ended the program"), Skip("it ran out of time", for_time=True)
    for name, why in (("global mapping", ended), ("fisheye", ended), ("fisheye", late)):
        abandon(tmp_path / "strategies", name, why)
    assert StrategyLog(tmp_path / "strategies").abandoned == {"global mapping": ended, "fisheye": late}


def test_strategies_skipped_for_time_are_counted(tmp_path: Path) -> None:
    log, late = StrategyLog(tmp_path / "strategies"), Skip("in any words", for_time=True)
    log.skipped = {"fisheye": late, "relaxed ratio test": Skip("in other words"), "more features": late}
    assert log.skipped_for_time() == 2
    log.add(Outcome("fisheye", "x.db"))
    again = StrategyLog(tmp_path / "strategies")
    assert again.skipped_for_time() == log.skipped_for_time() == 1, "not one that was tried in the end"


@pytest.mark.parametrize(
    ("name", "broken"),
    [("default", True), ("more features", True), ("relaxed ratio test", False), ("missing photos", False)],
)
def test_only_strict_matches_break_a_sequence(name: str, broken: bool, tmp_path: Path) -> None:
    log = StrategyLog(tmp_path / "strategies")
    log.add(Outcome(name, "x.db", sequence_broken=True))
    assert log.sequence_broken() == broken


PLAIN = Situation(missing=5, alone=5, images=50, linked=True, planar=False, camera_model_is_given=False)
TOO_LITTLE = "the missing photos share too few matches"
APART = "form models of their own"


@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("relaxed ratio test", {"linked": False, "planar": True}, None),
        ("weaker initial pair", {}, None),
        ("weaker initial pair", {"linked": False, "missing": 40}, TOO_LITTLE),
        ("weaker initial pair", {"missing": 4}, "starting over is not worth it for 4 of 50"),
        ("other seed", {"missing": 9, "images": 300}, "starting over is not worth it for 9 of 300"),
        ("global mapping", {"missing": 9, "images": 300}, "starting over is not worth it for 9 of 300"),
        ("relaxed ratio test", {"missing": 9, "images": 300}, "starting over is not worth it for 9 of 300"),
        ("missing photos", {"missing": 1, "images": 300}, None),
        ("missing photos", {"missing": 29, "images": 300}, None),
        ("missing photos", {"missing": 30, "images": 300}, "30 of 300 photos are too many"),
        ("missing photos", {"missing": 1, "images": 8}, None),
        ("missing photos", {"missing": 8, "images": 8}, "no model"),
        ("missing photos", {"missing": 1, "sequence_broken": True}, "repeated structure"),
        ("other seed", {"missing": 1, "images": 8}, None),
        ("relaxed ratio test", {"missing": 1, "images": 8}, "starting over is not worth it for 1 of 8"),
        ("weaker initial pair", {"planar": True}, "no depth"),
        ("global mapping", {"linked": False}, TOO_LITTLE),
        ("relaxed ratio test", {"missing": 150, "alone": 0, "images": 300, "linked": False}, None),
        ("fisheye", {"missing": 150, "alone": 3, "images": 300, "linked": False}, APART),
        ("more features", {"missing": 150, "alone": 3, "images": 300, "linked": False}, APART),
        ("more features", {"missing": 150, "alone": 30, "images": 300, "linked": False}, None),
        ("more features", {"missing": 150, "alone": 3, "images": 300}, None),
        ("fisheye", {"missing": 40}, None),
        ("fisheye", {"missing": 40, "camera_model_is_given": True}, "the camera model is given"),
        ("fisheye", {"missing": 40, "long_lenses": True}, "no fisheye has"),
        ("relaxed ratio test", {"missing": 40, "long_lenses": True}, None),
        ("fisheye", {"missing": 4}, "starting over is not worth it for 4 of 50"),
        ("weaker initial pair", {"missing": 1, "images": 51}, "starting over is not worth it for 1 of 51"),
        ("relaxed ratio test", {"missing": 30, "images": 300}, None),
        ("more features", {"linked": False, "camera_model_is_given": True}, None),
        ("more features", {"missing": 4}, "starting over is not worth it for 4 of 50"),
        ("more features", {"missing": 1, "images": 8}, "starting over is not worth it for 1 of 8"),
        ("more features", {"missing": 2, "images": 8}, None),
        ("more features", {"missing": 50, "planar": True}, "no depth"),
        ("consecutive pairs", {"missing": 40, "sequence_broken": True}, None),
        (
            "consecutive pairs",
            {"missing": 4, "sequence_broken": True},
            "starting over is not worth it for 4 of 50",
        ),
        ("other seed", {"missing": 50, "misfit": True}, None),
        ("fisheye", {"missing": 50, "misfit": True}, None),
        (
            "more features",
            {"missing": 50, "misfit": True},
            "the cameras do not fit",
        ),
        (
            "fisheye",
            {"missing": 40, "sequence_broken": True},
            "repeated structure",
        ),
    ],
)
def test_a_strategy_that_cannot_help_is_skipped(name: str, change: dict[str, Any], why: str | None) -> None:
    found = reason_against(BY_NAME[name], PLAIN._replace(**change))
    assert found is None if why is None else why in str(found)


@pytest.mark.parametrize(
    ("limit", "found", "at_most", "code"),
    [
        (TIME_GIVEN, False, 1000.0, "sfm.takes-longer"),
        (TIME_GIVEN, False, 20.0, "sfm.strategy-too-slow"),
        (TIME_GIVEN, True, 1000.0, "sfm.strategy-too-slow"),
        (MAX_SECONDS_LIMIT, False, 1.0, "sfm.strategy-too-slow"),
    ],
)
def test_the_time_given_is_exceeded_before_all_is_lost(limit: str, found: bool, at_most: float, code: str) -> None:
    """Where there is a model, the time is kept; the time after which sfm is given up always is."""
    said, outcome = list[str](), TIMED[0]
    log = SimpleNamespace(abandoned={}, outcomes=TIMED)
    state: Any = SimpleNamespace(
        log=log,
        photos=[None] * 4,
        job=SimpleNamespace(matcher="exhaustive"),
        left=lambda: (1.0, limit),
        left_at_most=lambda: at_most,
        usable=lambda: outcome if found else None,
        send=lambda note: said.append(note.code),
    )
    skipped = worker._why_infeasible(STRATEGIES[5], worker._expected(STRATEGIES[5], [0, 1, 2, 3], state), state)
    assert said == [code] and (skipped is None) == (code == "sfm.takes-longer")
