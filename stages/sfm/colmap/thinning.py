"""Fewer matches for mapping: the longest tracks of each photo, spread over it. Call it in a child process.

Bundle adjustment takes time with the observations, and hundreds of photos have far more than their poses need. Long
tracks tie many photos together; where structure repeats, chance matches make short ones. Mapping works on these, and
the final adjustment brings back all matches (stages/sfm/colmap/final_bundle_adjustment.py).
"""

import math
from itertools import islice, takewhile
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stages.sfm.colmap.correspondences import Correspondences, read_correspondences
from stages.sfm.colmap.database.copies import keep_inliers
from stages.sfm.colmap.database.files import copy_database, unfinished_copy
from stages.sfm.colmap.database.images import FOCAL_GUESS
from stages.sfm.pairs.match_graph import inlier_matrix, most_linked

TRACKS_PER_PHOTO = 500  # of mapping: 1,000 take 1.7 times as long and move no camera by more (docs/stages/sfm.md)
CALIBRATION_STARTS = 0.5, 2.0  # × the guess; where pairs tell the focal length, both lead to the same within 1 %
MAX_START_RATIO = 1.1
# COLMAP calibrates on all cores, and gives no option for it: the last digits are as the order of summation has it. A
# focal length that is held would carry them into every number after it.
TOLD_DIGITS = 6
# Distortion, which calibration knows nothing of, puts it off by up to a sixth; a photo that was cropped by more.
MAX_EXIF_RATIO = 1.3
CELLS = 4  # of 4 × 4 parts of a photo each gives tracks in turn: those of one corner would leave the rest loose


def thin_matches(database: Path, copy: Path, tracks: int = TRACKS_PER_PHOTO, *, camera_is_known: bool = False) -> bool:
    """Copy the database with the verified matches of each photo's best ``tracks`` tracks alone.

    Focal lengths are calibrated by all pairs together in the copy, unless the camera is known: mapping that begins with
    a guess that is a fifth off can take minutes to leave it, or end with intrinsics that project everything wrongly.
    Returns whether the pairs tell that of every camera.
    """
    with unfinished_copy(database, copy) as unfinished:
        with pycolmap.Database.open(unfinished) as db:
            geometries = dict(zip(*db.read_two_view_geometries(), strict=True))
            matches = read_correspondences(db, geometries)
            cells = _cells(db, len(matches.begins) - 1)
        calibrated = not camera_is_known and calibrate_focal_lengths(unfinished)
        kept = best_tracks(matches, cells, tracks)[matches.keypoint[:, 0]]
        bounds = np.searchsorted(matches.pair, np.arange(len(matches.pairs) + 1))
        with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
            for number, (first, second) in enumerate(matches.pairs.tolist()):
                geometry = geometries[pycolmap.image_pair_to_pair_id(first, second)]
                keep_inliers(db, (first, second), geometry, kept[bounds[number] : bounds[number + 1]])
    return calibrated


def _cells(db: pycolmap.Database, photos: int) -> Int[np.ndarray, "keypoints"]:
    """In which part of its photo each keypoint lies."""
    found = [np.zeros(0, int)]
    for photo in range(photos):
        camera = db.read_camera(db.read_image(photo + 1).camera_id)
        xy: Float[np.ndarray, "n 2"] = np.array(db.read_keypoints(photo + 1), float).reshape(-1, 6)[:, :2]
        column, row = np.clip(CELLS * xy / (camera.width, camera.height), 0, CELLS - 1).astype(int).T
        found.append(row * CELLS + column)
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
    in_cell = _rank(photo * CELLS**2 + cells, -length)
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


def calibrate_focal_lengths(database: Path) -> bool:
    """Focal lengths under which most fundamental matrices are essential ones (Sweeney et al. 2015, "Optimizing the
    viewing graph for structure-from-motion"), where EXIF tells none or one that is far from it: that of a cropped
    photo. Returns whether they are told for every camera.

    They are believed where short and long ones to begin with lead to the same: photos whose axes meet in one point do
    not tell them (Newsam et al. 1996, "Recovering unknown focal lengths in self-calibration"), planes neither. Nothing
    changes there.
    """
    with pycolmap.Database.open(database) as db:
        cameras = db.read_all_cameras()
    if any(camera.model_name.endswith("FISHEYE") for camera in cameras):
        return False  # two views through it have no fundamental matrix
    by_short, by_long = (_calibrated(database, factor) for factor in CALIBRATION_STARTS)
    told = {
        camera: float(f"{math.sqrt(short * long):.{TOLD_DIGITS}g}")
        for camera, short in by_short.items()
        if (long := by_long.get(camera)) and not far_apart(short, long, MAX_START_RATIO)
    }
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        for camera in cameras:
            focal_px, known = told.get(camera.camera_id), camera.has_prior_focal_length
            if focal_px is None or (known and not far_apart(focal_px, camera.mean_focal_length(), MAX_EXIF_RATIO)):
                continue
            set_focal_length(camera, focal_px)
            camera.has_prior_focal_length = True
            db.update_camera(camera)
    return len(told) == len(cameras)


def _calibrated(database: Path, factor: float) -> dict[int, float]:
    """By camera the calibrated focal length, of those for which one is found, beginning with ``factor`` × a guess."""
    copy = database.with_name(f"{database.stem}-calibration.unfinished")  # no .db: it is no copy to resume with
    copy_database(database, copy)
    with pycolmap.Database.open(copy) as db, pycolmap.DatabaseTransaction(db):
        for camera in db.read_all_cameras():
            set_focal_length(camera, factor * FOCAL_GUESS * max(camera.width, camera.height))
            camera.has_prior_focal_length = False  # those that count as known are not calibrated
            db.update_camera(camera)
    options = pycolmap.ViewGraphCalibrationOptions(random_seed=0, reestimate_relative_pose=False)
    done = pycolmap.calibrate_view_graph(copy, options)
    with pycolmap.Database.open(copy) as db:
        cameras = db.read_all_cameras() if done else []
    for file in copy.parent.glob(f"{copy.name}*"):
        file.unlink()
    return {camera.camera_id: camera.mean_focal_length() for camera in cameras if camera.has_prior_focal_length}


def far_apart(one: float, other: float, max_ratio: float) -> bool:
    """Whether two lengths differ by more than a ratio."""
    return not 1 / max_ratio < one / other < max_ratio


def set_focal_length(camera: pycolmap.Camera, focal_px: float) -> None:
    """In place; its other parameters stay."""
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] = focal_px
    camera.params = params.tolist()


def best_linked(database: Path, count: int) -> list[str]:
    """The names of so many images that hang together by the most verified matches: the one that has most, then again
    and again the one that has most with those taken. Fewer where no other is linked with them."""
    with pycolmap.Database.open(database) as db:
        names = [image.name for image in sorted(db.read_all_images(), key=lambda image: image.image_id)]
        pair_ids, inliers = db.read_two_view_geometry_num_inliers()
    pairs = np.array([pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids], int).reshape(-1, 2) - 1
    strength = np.maximum(inlier_matrix(len(names), pairs, np.array(inliers, int)), 0)  # none where none was tried
    linked = takewhile(lambda one: one.links > 0, most_linked(strength))
    return [names[photo] for photo, _ in islice(linked, count)]
