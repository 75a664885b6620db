import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.photos import Photo
from stages.registration import Matches, account, count_done, is_sound, why_no_model, with_left_out

NAMES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"]
PHOTOS = [Photo(name, f"images/{name}", 60, 40, 0, None, None, False, 1.0) for name in NAMES]


def matches(*pairs: tuple[int, int, int], keypoints: int = 500, flat: int = 0, shift_px: float = 9.0) -> Matches:
    """Pairs as (first, second, inliers), the first ``flat`` of them flat."""
    array = np.array(pairs, int).reshape(-1, 3)
    return Matches(
        keypoints=np.full(len(NAMES), keypoints),
        pairs=array[:, :2],
        inliers=array[:, 2],
        flat=np.arange(len(array)) < flat,
        shift_px=np.full(len(array), shift_px),
    )


def test_photos_left_out_of_matching_stand_in_the_account() -> None:
    photos = [
        replace(photo, near_duplicate_of="ä.jpg") if index in (0, 3) else photo for index, photo in enumerate(PHOTOS)
    ]
    matched = account(["b.jpg", "c.jpg", "e.jpg"], matches((0, 1, 90), (1, 2, 80)), [["b.jpg", "c.jpg", "e.jpg"]], {})
    entries = with_left_out(matched, photos)
    assert [entry["file"] for entry in entries] == NAMES
    assert [entry["reason"] for entry in entries if not entry["registered"]] == [
        "nearly the same picture as ä.jpg: it adds no baseline"
    ] * 2
    assert all(entry.keys() == entries[0].keys() for entry in entries)


def test_every_photo_without_a_place_has_its_reason() -> None:
    found = matches((0, 1, 90), (1, 2, 80), (2, 3, 19), (1, 3, 22))
    found.keypoints[4] = 0
    entries = account(NAMES, found, [["a.jpg", "b.jpg", "c.jpg"]], {"a.jpg": 60, "b.jpg": 70, "c.jpg": 50})
    assert [entry["registered"] for entry in entries] == [True, True, True, False, False]
    assert [entry["observations"] for entry in entries] == [60, 70, 50, 0, 0]
    assert [entry["reason"] for entry in entries] == [
        *[None] * 3,
        "too few matches to the model: at most 22 with a registered photo",
        "no features found in it: blurred, dark or without texture",
    ]


def test_a_photo_may_share_no_view_or_belong_elsewhere() -> None:
    found = matches((0, 1, 90), (2, 3, 80))
    models = [["a.jpg", "b.jpg"], ["c.jpg"]]
    assert [entry["reason"] for entry in account(NAMES, found, models, {})] == [
        *[None] * 2,
        "it belongs to another group of 1 photos that does not connect to this one",
        "it shares views only with photos that are not registered either",
        "it shares no view with any other photo",
    ]


@pytest.mark.parametrize(
    ("found", "registered", "why"),
    [
        (matches(keypoints=20), 0, "half of the photos show fewer than 50 features"),
        (matches(), 0, "0 of 10 pairs of photos share a view"),
        (
            matches((0, 1, 90), shift_px=0.2),
            3,
            "the photos are all the same view (1 of 10 pairs differ by less than a pixel)",
        ),
        (
            matches((0, 1, 90), (1, 2, 90), (2, 3, 90), flat=2),
            3,
            "2 of 3 matching pairs differ by a turn of the camera alone, or show one flat surface",
        ),
        (
            matches((0, 1, 90)),
            0,
            "1 of 10 pairs of photos share a view, but no two of them tell the depth of the scene",
        ),
        (matches((0, 1, 90)), 2, "only 2 photos and 7 points fit together; 1 of 10 pairs share a view"),
    ],
)
def test_why_no_scene_can_be_made(found: Matches, registered: int, why: str) -> None:
    error = why_no_model(PHOTOS, found, registered, 7)
    assert error.what == "the cameras of 5 photos could not be found"
    assert error.why == why
    assert error.hint.endswith(".")


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
