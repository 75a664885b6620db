from pathlib import Path
from typing import Any

import pytest

from stages.sfm.retry_strategies import (
    ATTEMPTS,
    Journal,
    Situation,
    Tried,
    abandon,
    expected_seconds,
    reason_against,
    time_against,
)

BY_NAME = {attempt.name: attempt for attempt in ATTEMPTS}


def test_the_list_begins_with_the_plain_attempt_and_its_names_are_unique() -> None:
    assert ATTEMPTS[0].matches == "strict" and not ATTEMPTS[0].words
    assert len(BY_NAME) == len(ATTEMPTS)
    assert all(attempt.words for attempt in ATTEMPTS[1:])


def test_more_photos_beat_more_points_beat_less_error() -> None:
    groups = [["a", "b", "c"], ["d"]]
    ranked = [
        Tried("none", "x.db"),
        Tried("few", "x.db", [["a", "b"]], 900, 0.1),
        Tried("inexact", "x.db", groups, 500, 0.9),
        Tried("exact", "x.db", groups, 500, 0.3),
        Tried("rich", "x.db", groups, 501, 2.0),
    ]
    ranks = [tried.rank for tried in ranked]
    assert ranks == sorted(set(ranks))


def test_the_journal_is_read_back_and_knows_the_best(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "attempts")
    assert journal.best() is None and journal.left() == ATTEMPTS
    one, other = Tried("first", "x.db", [["a", "b"]], 50, 0.5), Tried("other seed", "x.db", [["a", "b"]], 50, 0.5)
    for tried in (one, Tried("weaker start", "x.db"), other):
        journal.add(tried)
    again = Journal(tmp_path / "attempts")
    assert again.tried == journal.tried and again.best() == one  # of equals the first
    assert [attempt.name for attempt in again.left()] == ["all at once", "more features"]
    assert again.model("other seed") == tmp_path / "attempts" / "other-seed"


def test_what_was_passed_over_is_kept_with_what_was_made_and_one_of_these_is_kept(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "attempts")
    journal.add(Tried("first", "x.db", [["a", "b"]], 50, 0.5))
    journal.passed["fisheye"] = "the camera model is given"
    journal.add(Tried("looser matching", "x.db", [["a", "b", "c"]], 60, 0.4))
    journal.passed["weaker start"] = "not noted: nothing was made after it"
    again = Journal(tmp_path / "attempts")
    assert again.passed == {"fisheye": "the camera model is given"}
    none = {"registered": None, "points": None, "reprojection_px": None}
    assert again.account() == [
        {"attempt": "first", "registered": 2, "points": 50, "reprojection_px": 0.5, "kept": False, "passed": None},
        {"attempt": "fisheye", **none, "kept": False, "passed": "the camera model is given"},
        {"attempt": "looser matching", "registered": 3, "points": 60, "reprojection_px": 0.4}
        | {"kept": True, "passed": None},
    ]


TIMED = [
    Tried("first", "x.db", seconds={"features": 10.0, "matching": 40.0, "mapping": 20.0}),
    Tried("other seed", "x.db", seconds={"mapping": 30.0}),
]


@pytest.mark.parametrize(
    ("name", "chosen_pairs", "seconds"),
    [
        ("fisheye", False, 40 + 30),
        ("looser matching", False, 0.75 * 40 + 30),  # of all pairs, three quarters have one of half of the photos
        ("looser matching", True, 40 + 30),
        ("weaker start", False, 30),
        ("all at once", True, 30),
        ("more features", False, 4 * (10 + 40) + 2 * 30),
    ],
)
def test_earlier_attempts_tell_how_long_the_next_will_take(name: str, chosen_pairs: bool, seconds: float) -> None:
    assert expected_seconds(BY_NAME[name], TIMED, 0.5, chosen_pairs) == pytest.approx(seconds)


def test_an_attempt_must_leave_time_for_the_last_adjustment() -> None:
    assert time_against(50.0, TIMED, 50.0 + 2 * 30 - 1)
    assert not time_against(50.0, TIMED, 50.0 + 2 * 30 + 1)


def test_what_ended_the_program_is_remembered(tmp_path: Path) -> None:
    for name in ("all at once", "fisheye", "fisheye"):
        abandon(tmp_path / "attempts", name, "ran out of time" if name == "fisheye" else "ended the program")
    abandoned = Journal(tmp_path / "attempts").abandoned
    assert abandoned == {"all at once": "ended the program", "fisheye": "ran out of time"}


PLAIN = Situation(missing=5, alone=5, photos=50, linked=True, flat=False, lens_is_given=False)
TOO_LITTLE = "the missing photos share too little with the others"
APART = "the missing photos fit together among themselves and share too little with the others"


@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("looser matching", {"linked": False, "flat": True}, None),
        ("weaker start", {}, None),
        ("weaker start", {"linked": False, "missing": 40}, TOO_LITTLE),
        ("weaker start", {"missing": 4}, "4 of 50 photos missing is not worth starting over"),
        ("other seed", {"missing": 9, "photos": 300}, "9 of 300 photos missing is not worth starting over"),
        ("all at once", {"missing": 9, "photos": 300}, "9 of 300 photos missing is not worth starting over"),
        ("looser matching", {"missing": 9, "photos": 300}, None),
        ("other seed", {"missing": 1, "photos": 8}, None),
        ("weaker start", {"flat": True}, "the photos tell nothing of depth"),
        ("all at once", {"linked": False}, TOO_LITTLE),
        ("looser matching", {"missing": 150, "alone": 0, "photos": 300, "linked": False}, None),
        ("fisheye", {"missing": 150, "alone": 3, "photos": 300, "linked": False}, APART),
        ("more features", {"missing": 150, "alone": 3, "photos": 300, "linked": False}, APART),
        ("more features", {"missing": 150, "alone": 30, "photos": 300, "linked": False}, None),
        ("more features", {"missing": 150, "alone": 3, "photos": 300}, None),
        ("fisheye", {"missing": 40}, None),
        ("fisheye", {"missing": 40, "lens_is_given": True}, "the camera model is given"),
        ("fisheye", {"missing": 4}, "4 of 50 photos missing is not worth starting over"),
        ("weaker start", {"missing": 1, "photos": 51}, "1 of 51 photos missing is not worth mapping again"),
        ("looser matching", {"missing": 5, "photos": 300}, "5 of 300 photos missing is not worth mapping again"),
        ("looser matching", {"missing": 6, "photos": 300}, None),
        ("more features", {"linked": False, "lens_is_given": True}, None),
        ("more features", {"missing": 4}, "4 of 50 photos missing is not worth starting over"),
        ("more features", {"missing": 1, "photos": 8}, "1 of 8 photos missing is not worth starting over"),
        ("more features", {"missing": 2, "photos": 8}, None),
        ("more features", {"missing": 50, "flat": True}, "the photos tell nothing of depth"),
        ("in order", {"missing": 40, "folded": True}, None),
        ("in order", {"missing": 4, "folded": True}, "4 of 50 photos missing is not worth starting over"),
        ("fisheye", {"missing": 40, "folded": True}, "parts of the scene look alike, which these do not mend"),
    ],
)
def test_an_attempt_that_cannot_help_is_not_made(name: str, change: dict[str, Any], why: str | None) -> None:
    assert reason_against(BY_NAME[name], PLAIN._replace(**change)) == why
