import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.contract import Note
from stages.ingest.masks import STILL_BACKGROUND_HINT
from stages.io.photos import Photo
from stages.sfm import _line
from stages.sfm.registration import (
    Matches,
    count_done,
    image_rows,
    is_sound,
    repeated_structure,
    why_no_model,
    with_near_duplicates,
)

NAMES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"]
PHOTOS = [Photo(name, f"images/{name}", 60, 40, 0, None, None, False, 1.0) for name in NAMES]


def matches(
    *pairs: tuple[int, int],
    keypoints: int = 500,
    planar: int = 0,
    forward: int = 0,
    shift_px: float = 9.0,
    turned: bool = True,
) -> Matches:
    """The given pairs, the first so many of them ``planar`` or ``forward``, all of them turns or none."""
    array = np.array(pairs, int).reshape(-1, 2)
    return Matches(
        keypoints=np.full(len(NAMES), keypoints),
        tried=len(NAMES) * (len(NAMES) - 1) // 2,
        sizes=np.tile([640, 480], (len(NAMES), 1)),
        pairs=array,
        planar=np.arange(len(array)) < planar,
        homography=np.tile(np.eye(3) if turned else np.diag([2.0, 1.0, 1.0]), (len(array), 1, 1)),
        forward=np.arange(len(array)) < forward,
        shift_px=np.full(len(array), shift_px),
    )


def test_photos_left_out_of_matching_are_listed() -> None:
    photos = [
        replace(photo, near_duplicate_of="ä.jpg") if index in (0, 3) else photo for index, photo in enumerate(PHOTOS)
    ]
    names = ["b.jpg", "c.jpg", "e.jpg"]
    matched = image_rows(names, matches((0, 1), (1, 2)), [names], {}, {}, None, {})
    entries = with_near_duplicates(matched, photos)
    assert [entry["file"] for entry in entries] == NAMES
    assert ["ä.jpg" in entry["reason"] for entry in entries if not entry["registered"]] == [True, True]
    assert {entry["reason_code"] for entry in entries} == {None, "sfm.unregistered-near-duplicate"}
    assert all(entry.keys() == entries[0].keys() for entry in entries)


FOUR = (matches((0, 1), (1, 2), (2, 3), (1, 3)), [["a.jpg", "b.jpg", "c.jpg"]])


def reasons(found: Matches, models: list[list[str]], **support: tuple[int, int]) -> dict[str, tuple[str, str] | None]:
    """Of each photo why it is missing: the end of the code, and the words."""
    entries = image_rows(NAMES, found, models, {}, {name: support.get(name[0], (0, 0)) for name in NAMES}, None, {})
    code = "sfm.unregistered-"
    return {
        entry["file"][0]: entry["reason"] and (entry["reason_code"].removeprefix(code), entry["reason"])
        for entry in entries
    }


def code_of(reason: tuple[str, str] | None) -> str | None:
    return reason and reason[0]


def test_the_account_tells_who_is_registered() -> None:
    nothing = dict.fromkeys(NAMES, (0, 0))
    entries = image_rows(NAMES, *FOUR, {"a.jpg": 60, "b.jpg": 70, "c.jpg": 50}, nothing, None, {})
    assert [entry["registered"] for entry in entries] == [True, True, True, False, False]
    assert [entry["observations"] for entry in entries] == [60, 70, 50, 0, 0]
    assert [entry["reason"] is None for entry in entries] == [True, True, True, False, False]


def test_a_photo_whose_camera_cannot_be_used_has_that_reason() -> None:
    why = Note("sfm.unregistered-degenerate-camera", "its parameters are not finite")
    entries = image_rows(NAMES, *FOUR, {}, dict.fromkeys(NAMES, (60, 60)), None, {"d.jpg": why})
    assert (entries[3]["reason_code"], entries[3]["reason"]) == why


@pytest.mark.parametrize(
    ("support", "code"),
    [((7, 6), "few-points"), ((40, 9), "contradictions"), ((40, 35), "uncertain-pose")],
)
def test_a_photo_with_few_shared_views_is_told(support: tuple[int, int], code: str) -> None:
    found = reasons(*FOUR, d=support)["d"]
    assert found and found[0] == code and str(support[0]) in found[1]


def test_pure_rotation_is_a_reason() -> None:
    found = matches((2, 3), (1, 3), (0, 1), planar=2)
    assert code_of(reasons(found, FOUR[1], d=(3, 3))["d"]) == "rotation-or-plane"


def test_forward_motion_is_a_reason() -> None:
    steps = (2, 3), (1, 3), (0, 1)
    assert code_of(reasons(matches(*steps, forward=2), FOUR[1], d=(3, 3))["d"]) == "forward-motion"
    assert code_of(reasons(matches(*steps, forward=2, planar=1), FOUR[1], d=(3, 3))["d"]) == "forward-motion"
    assert code_of(reasons(matches(*steps, forward=1), FOUR[1], d=(3, 3))["d"]) == "few-points"
    enough = reasons(matches(*steps, forward=2), FOUR[1], d=(40, 35))["d"]  # it sees enough of the model
    assert code_of(enough) == "uncertain-pose"


def test_groups_that_contradict_each_other_are_named() -> None:
    found, models = matches((0, 1), (3, 4)), [["a.jpg", "b.jpg", "c.jpg"], ["b.jpg", "c.jpg", "d.jpg", "e.jpg"]]
    conflict = {"group": 1, "shared": 2, "different": 2}
    entries = image_rows(NAMES, found, models, {}, dict.fromkeys(NAMES, (0, 0)), conflict, {})
    assert [entry["reason"] for entry in entries[:3]] == [None] * 3
    assert {entry["reason_code"] for entry in entries[3:]} == {"sfm.unregistered-repeated-structure"}
    assert "4 photos" in entries[3]["reason"]
    moved = {"photos": ["b.jpg", "c.jpg"], "others": ["d.jpg", "e.jpg"]}
    message = repeated_structure(conflict | moved, {name: f"holiday/{name}" for name in NAMES})
    assert all(f"holiday/{name}" in message for name in ("b.jpg", "c.jpg", "d.jpg", "e.jpg"))


def test_a_photo_may_be_alone_or_of_another_group() -> None:
    told = reasons(matches((0, 1), (2, 3)), [["a.jpg", "b.jpg"], ["c.jpg"]])
    assert (told["a"], told["b"]) == (None, None)
    assert [code_of(told[name]) for name in "cde"] == ["other-group", "partners", "no-match"]


@pytest.mark.parametrize(
    ("keypoints", "code", "named"),
    [(0, "no-features", ""), (20, "no-match", "20")],
)
def test_a_photo_may_have_next_to_nothing_to_match(keypoints: int, code: str, named: str) -> None:
    found = reasons(matches((0, 1), keypoints=keypoints), [["a.jpg", "b.jpg"]])["e"]
    assert found and found[0] == code and named in found[1]


def test_few_features_are_named_where_they_match_something_too() -> None:
    told = reasons(matches((0, 1), (1, 2), (3, 4), keypoints=20), [["a.jpg", "b.jpg"]])
    assert [code_of(told[name]) for name in "cd"] == ["few-points", "partners"]
    assert all("20 features" in str(told[name]) for name in "cd")


@pytest.mark.parametrize(
    ("found", "registered", "code", "named"),
    [
        (matches(keypoints=20), 0, "few-features", "50 features"),
        (matches(), 0, "no-overlap", "10 pairs"),
        (matches((0, 1), shift_px=0.2), 3, "same-view", "1 of 10 pairs"),
        (matches((0, 1), (1, 2), (2, 3), planar=2), 3, "pure-rotation", "2 of 3 matching pairs"),
        (matches((0, 1), (1, 2), (2, 3), planar=2, turned=False), 3, "planar-scene", "2 of 3 matching pairs"),
        (
            matches((0, 1), (1, 2), (2, 3), forward=2, planar=2, turned=False),
            3,
            "forward-motion",
            "2 of 3 matching pairs",
        ),
        (matches((0, 1)), 0, "no-model", "1 of 10 pairs"),
        (matches((0, 1)), 2, "no-model", "only 2 photos and 7 points"),
    ],
)
def test_why_no_scene_can_be_made(found: Matches, registered: int, code: str, named: str) -> None:
    error = why_no_model(PHOTOS, found, registered, 7)
    assert error.code == f"sfm.{code}" and "5 photos" in error.what and named in error.why
    assert (STILL_BACKGROUND_HINT in error.hint) == (code == "same-view")


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "matches.db"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        db.execute("CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, data BLOB)")
        db.execute("CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, data BLOB)")
        db.executemany("INSERT INTO images (name) VALUES (?)", [(name,) for name in NAMES])
        db.executemany("INSERT INTO descriptors VALUES (?, ?)", [(i, b"x" * 5000) for i in (1, 2, 3)])
        db.execute("INSERT INTO two_view_geometries VALUES (1, 'x')")
    db.close()
    return path


def test_progress_is_counted(database: Path, tmp_path: Path) -> None:
    assert count_done(database) == (3, 1)
    assert count_done(tmp_path / "none.db") == (0, 0)
    assert not (tmp_path / "none.db").exists()


def test_a_database_is_sound_for_its_own_photos_only(database: Path) -> None:
    assert is_sound(database, NAMES)
    assert not is_sound(database, NAMES[:4])
    assert not is_sound(database, NAMES[::-1])


@pytest.mark.parametrize("keep", [0, 50, 5000, 12_288])
def test_a_database_cut_short_is_not_sound(database: Path, keep: int) -> None:
    content = database.read_bytes()
    assert len(content) > keep
    database.write_bytes(content[:keep])
    assert not is_sound(database, NAMES)


def test_the_line_groups_points_as_other_numbers() -> None:
    facts = {"source": "sfm", "check": None, "reprojection_px": 0.5, "points": 87446, "registered": 4, "photos": 4}
    assert "87,446" in _line(facts | {"near_duplicates": 0, "camera_model": "PINHOLE"})
