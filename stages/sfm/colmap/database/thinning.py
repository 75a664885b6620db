"""Fewer matches for mapping: the longest tracks of each photo, spread over it.

Bundle adjustment takes time with the observations, and hundreds of photos have far more than their poses need. Long
tracks tie many photos together; where structure repeats, chance matches make short ones. Mapping works on these, and
the final bundle adjustment brings back all matches (stages/sfm/colmap/adjustment/final_bundle_adjustment.py).
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stages.sfm.colmap.database.calibration import Told, calibrate_focal_lengths
from stages.sfm.colmap.database.copies import keep_inliers
from stages.sfm.colmap.database.correspondences import Correspondences, read_correspondences
from stages.sfm.colmap.database.features import read_keypoints
from stages.sfm.colmap.database.files import unfinished_copy

TRACKS_PER_PHOTO = 500  # of mapping: 1,000 take 1.7 times as long and move no camera by more (docs/stages/sfm.md)
# Of 4 × 4 parts of a photo each gives tracks in turn: those of one corner would leave the rest loose.
CELLS_ACROSS = 4


def thin_matches(database: Path, copy: Path, tracks: int = TRACKS_PER_PHOTO, *, camera_is_known: bool = False) -> Told:
    """Copy the database with the verified matches of each photo's best ``tracks`` tracks alone.

    Focal lengths are calibrated by all pairs together in the copy, unless the camera is known: mapping that begins with
    a guess that is a fifth off can take minutes to leave it, or end with intrinsics that project everything wrongly.
    Returns for which cameras the pairs tell that.
    """
    with unfinished_copy(database, copy) as unfinished:
        with pycolmap.Database.open(unfinished) as db:
            geometries = dict(zip(*db.read_two_view_geometries(), strict=True))
            matches = read_correspondences(db, geometries)
            cells = _cells(db, len(matches.begins) - 1)
        told = Told() if camera_is_known else calibrate_focal_lengths(unfinished)
        kept = best_tracks(matches, cells, tracks)[matches.keypoint[:, 0]]
        bounds = np.searchsorted(matches.pair, np.arange(len(matches.pairs) + 1))
        with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
            for number, (first, second) in enumerate(matches.pairs.tolist()):
                geometry = geometries[pycolmap.image_pair_to_pair_id(first, second)]
                keep_inliers(db, (first, second), geometry, kept[bounds[number] : bounds[number + 1]])
    return told


def _cells(db: pycolmap.Database, photos: int) -> Int[np.ndarray, "keypoints"]:
    """In which part of its photo each keypoint lies."""
    found = [np.zeros(0, int)]
    for photo in range(photos):
        camera = db.read_camera(db.read_image(photo + 1).camera_id)
        share = read_keypoints(db, photo + 1) / (camera.width, camera.height)
        column, row = np.clip(CELLS_ACROSS * share, 0, CELLS_ACROSS - 1).astype(int).T
        found.append(row * CELLS_ACROSS + column)
    return np.concatenate(found)


def best_tracks(matches: Correspondences, cells: Int[np.ndarray, "keypoints"], tracks: int) -> Bool[np.ndarray, "k"]:
    """Which keypoints belong to one of the ``tracks`` best tracks of any photo: the longest in each of its cells, then
    the second longest, and so on. A track that sees a photo twice has mistakes in it and comes after all others."""
    count, photos = int(matches.begins[-1]), len(matches.begins) - 1
    edges = (np.ones(len(matches.keypoint), bool), tuple(matches.keypoint.T))
    _, track = connected_components(coo_matrix(edges, shape=(count, count)), directed=False)
    photo = np.repeat(np.arange(photos), np.diff(matches.begins))
    sees = np.unique(track.astype(np.int64) * photos + photo) // photos
    size, length = np.bincount(track), np.bincount(sees, minlength=int(track.max(initial=-1)) + 1)
    length = np.where(size == length, length, 1)  # with mistakes: behind all others
    length = np.where(size > 1, length, 0)[track]  # never matched: last of all
    in_cell = _rank(photo * CELLS_ACROSS**2 + cells, -length)
    best = (_rank(photo, in_cell, -length) < tracks) & (size[track] > 1)
    keep = np.zeros(len(size), bool)
    keep[track[best]] = True
    return keep[track]


def _rank(group: Int[np.ndarray, "n"], *keys: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """The place of each entry within its group, by these keys; ties by place in the list."""
    order = np.lexsort((*reversed(keys), group))
    begins = np.searchsorted(group[order], group[order])
    rank = np.empty(len(group), int)
    rank[order] = np.arange(len(group)) - begins
    return rank
