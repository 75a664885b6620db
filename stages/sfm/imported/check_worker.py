"""Whether imported poses fit their photos, and the points that their matches tell, in a child process: COLMAP may
abort.

Features of reduced photos are matched between neighbours by pose, which the check of stages/sfm/pose_check.py
judges. Poses that fit and came without points get those of the matches. ``python -P -m
stages.sfm.imported.check_worker`` reads a job from stdin as one line of JSON and answers with another.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stages.ingest.masks import write_feature_masks
from stages.io.photos import Photo
from stages.sfm.colmap.database import (
    MAPPING_MODEL,
    STRICT_RATIO,
    ExtractionOptions,
    extract_features,
    fill_database,
    match_pairs,
    verified_matches,
)
from stages.sfm.colmap.mappers import triangulate
from stages.sfm.colmap.models import load_native
from stages.sfm.colmap.repair import camera_poses, check_model, facts
from stages.sfm.imported.conventions import MIN_PAIRS, best_fit, fit_of_some
from stages.sfm.imported.focal_lengths import fitting_focal_factor
from stages.sfm.pairs.match_graph import MIN_INLIERS, natural_order, pairs_apart
from stages.sfm.pairs.pair_selection import Pairs, closeness, nearest, union
from stages.sfm.worker_process import environment

COMMAND = ["-P", "-m", "stages.sfm.imported.check_worker"]
MAX_IMAGE_SIZE, MAX_FEATURES = 1000, 2000  # enough to tell a step of a few pixels, in seconds for hundreds of photos
PARTNERS = 6  # of each photo
MAX_NAME_STEPS = 2  # positions before and after it, in the order of names
POINTS = "points"  # the folder of a model with the points that the matches tell
TURN_DEG = 30.0  # two photos whose axes differ by so much count as far apart as two whose centres are usual neighbours


def check_imported_poses(
    photos: Sequence[Photo], images: Path, folder: Path, test_files: Sequence[str] = (), of_quaternions: bool = False
) -> dict[str, Any]:
    """Check the model in ``folder/sparse``, whose images are these photos in order of ``file``. ``of_quaternions``: its
    poses stood as quaternions in a text file, which somebody may have written in another order.

    Returns what :func:`stages.sfm.colmap.repair.facts` says, with the ``fit`` of another convention where the poses
    contradict their photos and it does not, and the ``focal_fit`` of other focal lengths; or {"failed": why} where
    nothing could be compared. The model stays as it is. Where it has no points and its poses fit, ``folder/points``
    is a model with the points that the matches tell, without those of ``test_files``: ``triangulated`` many.
    """
    job = {"photos": [asdict(photo) for photo in photos], "images": str(images.absolute()), "folder": str(folder)}
    job |= {"test_files": list(test_files), "of_quaternions": of_quaternions}
    with (folder / "sfm.log").open("ab") as log:
        answer = subprocess.run(
            [sys.executable, *COMMAND],
            input=json.dumps(job).encode() + b"\n",
            stdout=subprocess.PIPE,
            stderr=log,
            env=environment(),
        )
    if answer.returncode:
        return {"failed": f"the check ended with code {answer.returncode}"}
    return json.loads(answer.stdout)


# --- in the child


def main() -> None:
    """Read the job from stdin, do it, print the answer."""
    job = json.loads(sys.stdin.buffer.readline())
    channel = os.dup(1)
    os.dup2(2, 1)  # nothing else may print there
    os.write(channel, json.dumps(check(**job)).encode())


def check(
    photos: list[dict[str, Any]], images: str, folder: str, test_files: list[str], of_quaternions: bool
) -> dict[str, Any]:
    """Match neighbours by pose and by name, and let their matches judge the poses."""
    some, scratch = [Photo(**photo) for photo in photos], Path(folder, "check")
    scratch.mkdir(exist_ok=True)
    database, masks = scratch / "check.db", scratch / "masks"
    model = load_native(Path(folder, "sparse"))
    fill_database(database, some, MAPPING_MODEL)
    extraction = ExtractionOptions(MAX_IMAGE_SIZE, MAX_FEATURES, doubled_up_to=MAX_IMAGE_SIZE // 2)
    if write_feature_masks(Path(images).parent, some, masks):
        extraction = extraction._replace(masks=masks)
    extract_features(database, Path(images), some, extraction)
    poses = camera_poses(model)
    by_name = natural_order([photo.name for photo in some])  # where poses are wrong, so are their neighbours
    pairs = union(neighbours_by_pose(poses), pairs_apart(by_name, 1, MAX_NAME_STEPS))
    match_pairs(database, pairs, 0, STRICT_RATIO)
    verified = int((verified_matches(database, pairs) >= MIN_INLIERS).sum())
    checked = check_model(model, database, 0) if verified >= MIN_PAIRS else None
    if checked is None:
        shutil.rmtree(scratch)
        return {"failed": f"only {verified} pairs of neighbouring photos have enough matches"}
    found = facts(model, checked)
    contradicted = 2 * found["agreeing"] < found["pairs"]
    fit = best_fit(checked.matches, poses, of_quaternions) if contradicted else None
    if fit is None and found["agreeing"] < found["pairs"]:
        fit = fit_of_some(checked.matches, poses, checked.check.agrees)
    longer = None if fit or checked.fits else fitting_focal_factor(checked.matches, poses)
    points, transparent = 0, sum(photo.has_alpha for photo in some)
    # Photos with alpha need no points to tell the region, and edges of what is cut out are no points of a surface.
    if not (contradicted or fit or longer or model.num_points3D()) and 2 * transparent <= len(some):
        # Official test photos are to be as unknown as any new view.
        tests = [number for number, photo in enumerate(some, 1) if photo.image_name in test_files]
        without = {*checked.failed(), *tests}
        points = triangulate(Path(folder, "sparse"), database, Path(images), Path(folder, POINTS), without)
    shutil.rmtree(scratch)
    return found | {
        "fit": fit._asdict() if fit else None,
        "focal_fit": longer._asdict() if longer else None,
        "triangulated": points,
    }


def neighbours_by_pose(world_from_camera: Float[np.ndarray, "photos 3 4"]) -> Pairs:
    """Each photo with those that stand nearest and look the same way most nearly."""
    centres, axes = world_from_camera[:, :, 3], world_from_camera[:, :, 2]
    distance = -closeness(centres)
    usual = np.median(np.sort(distance, axis=1)[:, min(1, len(centres) - 1)])
    turn = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    apart = distance / usual if usual > 0 else distance
    return nearest(-(apart + turn / TURN_DEG), PARTNERS)


if __name__ == "__main__":
    main()
