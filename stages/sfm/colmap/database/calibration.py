"""Focal lengths calibrated by all verified pairs of a database together."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from stages.sfm.colmap.database.files import copy_database
from stages.sfm.colmap.database.images import FOCAL_GUESS

CALIBRATION_STARTS = 0.5, 2.0  # × the guess; where pairs tell the focal length, both lead to the same within 1 %
MAX_START_RATIO = 1.1
# COLMAP calibrates on all cores, and gives no option for it: the last digits are as the order of summation has it. A
# focal length that is held would carry them into every number after it.
TOLD_DIGITS = 6
# Distortion, which calibration knows nothing of, puts it off by up to a sixth; a photo that was cropped by more.
MAX_EXIF_RATIO = 1.3


class Told(NamedTuple):
    """The cameras (ids) whose focal lengths the pairs tell, and whether these are all of them."""

    cameras: frozenset[int] = frozenset()
    all: bool = False


def calibrate_focal_lengths(database: Path) -> Told:
    """Focal lengths under which most fundamental matrices are essential ones (Sweeney et al. 2015, "Optimizing the
    viewing graph for structure-from-motion"), where EXIF tells none or one that is far from it: that of a cropped
    photo. Returns for which cameras they are told.

    They are believed where short and long ones to begin with lead to the same: photos whose axes meet in one point do
    not tell them (Newsam et al. 1996, "Recovering unknown focal lengths in self-calibration"), planes neither. Nothing
    changes there.
    """
    with pycolmap.Database.open(database) as db:
        cameras = db.read_all_cameras()
    if any(camera.model_name.endswith("FISHEYE") for camera in cameras):
        return Told()  # two views through it have no fundamental matrix
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
    return Told(frozenset(told), len(told) == len(cameras))


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
