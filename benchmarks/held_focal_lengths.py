"""What mapping makes of many photos whose focal length is free from the first photo on, or held until all are mapped.

    python -m benchmarks.held_focal_lengths DATABASE IMAGES [--seeds 0 1 2] [--distortion 0 -0.15] [--focal 1 0.8]

DATABASE is the matches-*.db that stage sfm has in its folder while it maps, and leaves there where it is killed then;
IMAGES the folder of its photos, which share one camera. With ``--distortion K`` the keypoints are moved to where a
lens r (1 + K r²), r in units of the guessed focal length, would have shown them, and verified anew. Each seed then maps
the thinned matches twice, and all intrinsics are adjusted once at the end. Held is the calibrated focal length, or
``--focal`` times it. Printed, and written as JSON with ``--out``: how many photos are registered, the focal length
while mapping and adjusted, the error, how many verified pairs agree with the poses, CPU seconds.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks.record import Record, add_out
from stages.sfm.colmap.adjustment.bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.database.calibration import set_focal_length
from stages.sfm.colmap.database.matching import verify_again
from stages.sfm.colmap.database.thinning import thin_matches
from stages.sfm.colmap.mappers import incremental_options, map_incrementally
from stages.sfm.colmap.model_check import check_model
from stages.sfm.retry_strategies import STRATEGIES


def main() -> None:
    """Map the photos in every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("database", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--distortion", type=float, nargs="+", default=[0.0])
    parser.add_argument("--focal", type=float, nargs="+", default=[1.0])
    add_out(parser)
    asked = parser.parse_args()
    record, pycolmap.logging.minloglevel = Record(asked.out), 3
    with tempfile.TemporaryDirectory() as scratch:
        for distortion in asked.distortion:
            database, thinned = asked.database, Path(scratch, "thinned.db")
            if distortion:
                database = Path(scratch, "distorted.db")
                distort(asked.database, database, distortion)
            told = thin_matches(database, thinned).all
            calibrated = focal_length(thinned)
            for factor in asked.focal:
                begin_with(thinned, factor * calibrated)
                for seed in asked.seeds:
                    for held in (False, True):
                        figures = mapped(thinned, database, asked.images, seed, held)
                        record.add(distortion=distortion, told=told, begins_px=round(factor * calibrated), **figures)


def mapped(thinned: Path, database: Path, images: Path, seed: int, held: bool) -> dict[str, int | float]:
    """The figures of one mapping."""
    mapping = STRATEGIES[0].mapping
    assert mapping is not None
    began = time.process_time()
    options = incremental_options(seed, mapping, camera_is_known=False, thinned=True, hold_focal=held)
    with tempfile.TemporaryDirectory() as models:
        found = map_incrementally(thinned, images, Path(models), options)
    seconds = time.process_time() - began
    if not found:
        return {"held": held, "seed": seed, "registered": 0}
    while_mapping = found[0].camera(1).mean_focal_length()
    release_focal_lengths(found[0])
    check = check_model(found[0], database, seed).check
    return {
        "held": held,
        "seed": seed,
        "registered": found[0].num_reg_images(),
        "mapped_focal_px": round(while_mapping),
        "focal_px": round(found[0].camera(1).mean_focal_length()),
        "error_px": round(check.median_px, 2),
        "agreeing_pairs": int(check.agrees.sum()),
        "cpu_seconds": round(seconds),
    }


def distort(database: Path, copy: Path, distortion: float) -> None:
    """Copy the database as a lens with this distortion would have filled it, its matches verified anew."""
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as db, pycolmap.DatabaseTransaction(db):
        camera = db.read_camera(1)
        centre = np.array([camera.principal_point_x, camera.principal_point_y])
        for image in db.read_all_images():
            keypoints = np.array(db.read_keypoints(image.image_id), np.float32)
            offset = keypoints[:, :2] - centre
            square = (offset**2).sum(axis=1, keepdims=True) / focal_length(database) ** 2
            keypoints[:, :2] = centre + offset * (1 + distortion * square)
            db.update_keypoints(image.image_id, keypoints)
        verify_again(db, seed=0)


def focal_length(database: Path) -> float:
    """Of the first camera, in pixels."""
    with pycolmap.Database.open(database) as db:
        return db.read_camera(1).mean_focal_length()


def begin_with(database: Path, focal_px: float) -> None:
    """Let mapping begin with this focal length."""
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        camera = db.read_camera(1)
        set_focal_length(camera, focal_px)
        db.update_camera(camera)


if __name__ == "__main__":
    main()
