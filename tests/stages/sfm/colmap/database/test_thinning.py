from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from stages.sfm.colmap.database.correspondences import Correspondences
from stages.sfm.colmap.database.thinning import best_tracks, thin_matches
from stages.sfm.colmap.mappers import incremental_options, map_incrementally
from stages.sfm.colmap.model_check import (
    check_model,
)
from stages.sfm.colmap.model_comparison import compare_models
from stages.sfm.retry_strategies import MappingOptions
from tests.stages.sfm.colmap.made_models import PHOTOS, make

TRACKED_PHOTOS, KEYPOINTS = 4, 6


def matched(*tracks: list[tuple[int, int]]) -> Correspondences:
    """Photos of six keypoints each; a track lists (photo, keypoint), each matched with the next one."""
    rows = [(first, second) for track in tracks for first, second in pairwise(track)]
    numbers = np.array([[photo * KEYPOINTS + keypoint for photo, keypoint in row] for row in rows]).reshape(-1, 2)
    pair = np.zeros(len(rows), int)
    return Correspondences(np.array([[1, 2]]), pair, numbers, KEYPOINTS * np.arange(TRACKED_PHOTOS + 1))


def kept(correspondences: Correspondences, cells: np.ndarray, tracks: int) -> set[tuple[int, int]]:
    chosen = np.flatnonzero(best_tracks(correspondences, cells, tracks))
    return {(int(k) // KEYPOINTS, int(k) % KEYPOINTS) for k in chosen}


ONE_CELL = np.zeros(TRACKED_PHOTOS * KEYPOINTS, int)
LONG = [(0, 0), (1, 0), (2, 0), (3, 0)]
SHORT = [(0, 1), (1, 1)]
MIDDLE = [(0, 2), (1, 2), (2, 2)]


def test_the_longest_tracks_of_each_photo_are_kept() -> None:
    tracks = matched(LONG, SHORT, MIDDLE)
    assert kept(tracks, ONE_CELL, 1) == set(LONG)
    assert kept(tracks, ONE_CELL, 2) == {*LONG, *MIDDLE}
    assert kept(tracks, ONE_CELL, 3) == {*LONG, *MIDDLE, *SHORT}


def test_a_photo_with_few_tracks_keeps_all_of_them() -> None:
    lonely = [(3, 5), (2, 5)]
    assert kept(matched(MIDDLE, SHORT, lonely), ONE_CELL, 1) == {*MIDDLE, *lonely}


def test_every_part_of_a_photo_gives_tracks_in_turn() -> None:
    cells = ONE_CELL.copy()
    cells[[1, KEYPOINTS + 1]] = 7  # the short track lies elsewhere in its photos
    assert kept(matched(LONG, SHORT, MIDDLE), cells, 2) == {*LONG, *SHORT, *MIDDLE}
    assert kept(matched(LONG, SHORT, [(0, 2), (1, 2), (3, 2)]), cells, 1) == set(LONG)


def test_a_track_that_sees_a_photo_twice_comes_last() -> None:
    twice = [(0, 3), (1, 3), (2, 3), (3, 3), (0, 4)]
    assert kept(matched(twice, MIDDLE), ONE_CELL, 1) == {*MIDDLE, *twice}  # all that photo 3 has
    assert kept(matched(twice, MIDDLE, [(3, 1), (2, 1)]), ONE_CELL, 1) == {*MIDDLE, (3, 1), (2, 1)}


def test_nothing_matched_keeps_nothing() -> None:
    assert kept(matched(), ONE_CELL, 5) == set()


def test_mapping_of_thinned_matches_finds_the_same_cameras(tmp_path: Path) -> None:
    made = make(tmp_path, points=1000)
    thinned = tmp_path / "thinned.db"
    thin_matches(made.database, thinned, tracks=30)
    with pycolmap.Database.open(made.database) as db, pycolmap.Database.open(thinned) as few:
        before, after = db.num_inlier_matches(), few.num_inlier_matches()
    assert 0 < after < 0.6 * before
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True)
    (model,) = map_incrementally(thinned, tmp_path, tmp_path / "models", options)
    compared = compare_models(made.model, model)
    assert compared["agree"] == PHOTOS and 0 < compared["centre"] < 0.01
    assert check_model(model, made.database, 0).check.passed.all()
