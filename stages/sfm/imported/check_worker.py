"""Whether imported poses fit their photos, and the points that their matches tell, in a child process: COLMAP may
abort.

Features of reduced photos are matched between neighbours by pose, which the check of stages/sfm/pose_check.py
judges. Poses without points are adjusted to the matches where they are inexact, and get points. ``python -P -m
stages.sfm.imported.check_worker`` reads a job from stdin as one line of JSON and answers with others: where it is, and
what it found.
"""

import json
import os
import shutil
import sys
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stages.contract import Progress
from stages.ingest.masks import write_feature_masks
from stages.io.photos import Photo
from stages.io.stopwatch import live_line
from stages.sfm.colmap.adjustment.imported_models import adjust_intrinsics, adjust_poses, triangulate
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.files import keep_open
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import STRICT_RATIO, match_pairs, verified_matches
from stages.sfm.colmap.model_check import ModelCheck, camera_poses, check_model, facts
from stages.sfm.colmap.models import load_native
from stages.sfm.imported.conventions import MIN_PAIRS, best_fit, fit_of_some
from stages.sfm.imported.focal_lengths import fitting_focal_factor
from stages.sfm.job import end_with_parent, worker_lock
from stages.sfm.pairs.match_graph import MIN_INLIERS, natural_order, pairs_apart
from stages.sfm.pairs.pair_selection import Pairs, closeness, nearest, union
from stages.sfm.registration import count_done
from stages.sfm.worker_process import run_child

COMMAND = ["-P", "-m", "stages.sfm.imported.check_worker"]
MAX_IMAGE_SIZE, MAX_FEATURES = 1000, 2000  # enough to tell a step of a few pixels, in seconds for hundreds of photos
PARTNERS = 6  # of each photo
MAX_NAME_STEPS = 2  # positions before and after it, in the order of names
MAX_ERROR_PX = 4.0  # of an observation, as in mapping, on photos of MAX_IMAGE_SIZE; more on larger ones
MAX_DOUBTFUL = 0.05  # of the photos: more that contradict their poses make poses worth an adjustment
INTRINSICS_MARGIN = 1.5  # × the error after adjusting poses: intrinsics that explain matches so well are to blame
DATABASE, FEATURES, MATCHING = "check/check.db", "features", "matching"
ADJUSTED, POINTS = "adjusted", "points"  # folders of models: with adjusted poses, with points
TURN_DEG = 30.0  # two photos whose axes differ by so much count as far apart as two whose centres are usual neighbours


def check_imported_poses(
    photos: Sequence[Photo],
    images: Path,
    folder: Path,
    test_files: Sequence[str],
    of_quaternions: bool,
    adjust: bool,
    max_seconds: float,
    progress: Progress,
) -> dict[str, Any]:
    """Check the model in ``folder/sparse``, whose images are these photos in order of ``file``. ``of_quaternions``: its
    poses stood as quaternions in a text file, which somebody may have written in another order.

    Returns what ``facts`` (stages/sfm/colmap/model_check.py) says, with the ``fit`` of another convention where the
    poses contradict their photos and it does not, and the ``focal_fit`` of other focal lengths; or {"failed": why}
    where nothing could be compared. The model stays as it is. Where it has no points,

    * inexact poses are adjusted to the matches, if ``adjust``. Where they fit then, ``folder/adjusted`` is a model of
      all photos with these poses, and ``adjusted_from_px`` the error before; else that is None;
    * poses that most pairs agree with get points: ``folder/points`` is a model with those that the matches tell,
      without those of ``test_files``; their number is ``triangulated``.

    ``unfinished``: why these two could not be tried; else None. After ``max_seconds`` the check is ended.
    """
    job = {"photos": [asdict(photo) for photo in photos], "images": str(images.absolute()), "folder": str(folder)}
    job |= {"test_files": list(test_files), "of_quaternions": of_quaternions, "adjust": adjust}
    said: list[dict[str, Any]] = []  # what the check says, then what became of it
    latest: dict[str, Any] = {"phase": FEATURES}

    def hear(message: dict[str, Any]) -> None:
        if "phase" not in message:
            said.append(message)
            return
        latest.update(message)
        progress.update(*describe())

    def describe() -> tuple[str, float | None]:
        return _describe(latest, len(photos), folder / DATABASE)

    with live_line(progress, describe):
        ending = run_child(COMMAND, folder / "sfm.log", job, max_seconds, hear)
    shutil.rmtree((folder / DATABASE).parent, ignore_errors=True)
    ended = f"the check ended with code {ending.status}" if ending.status else None
    if ending.late:
        ended = f"it took longer than {max_seconds:g} s (--force and a longer --sfm.max-seconds repeat it)"
    if ended and not said:
        return {"failed": ended}
    return {"adjusted_from_px": None, "triangulated": 0} | said[-1] | {"unfinished": ended}


def _describe(latest: Mapping[str, Any], photos: int, database: Path) -> tuple[str, float | None]:
    """The live line and the finished share of the whole."""
    features, pairs = count_done(database)
    if latest["phase"] == FEATURES:
        return f"features of {features:,} of {photos:,} photos, to check the imported poses", 0.6 * features / photos
    if latest["phase"] == MATCHING:
        of = max(1, latest["pairs"])
        return f"matched {pairs:,} of {of:,} pairs of photos, to check the imported poses", 0.6 + 0.2 * pairs / of
    return latest["phase"], 0.8


# --- in the child


def main() -> None:
    """Read the job from stdin, do it, print the answers: COLMAP may abort after the first."""
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=end_with_parent, daemon=True).start()
    channel = os.dup(1)
    os.dup2(2, 1)  # nothing else may print there
    with worker_lock(Path(job["folder"])):
        for answer in check(**job):
            os.write(channel, json.dumps(answer).encode() + b"\n")


def check(
    photos: list[dict[str, Any]],
    images: str,
    folder: str,
    test_files: list[str],
    of_quaternions: bool,
    adjust: bool,
) -> Iterator[dict[str, Any]]:
    """Match neighbours by pose and by name, and let their matches judge the poses, then adjust and complete them."""
    some, root, database = [Photo(**photo) for photo in photos], Path(folder), Path(folder, DATABASE)
    database.parent.mkdir(exist_ok=True)
    for left in (ADJUSTED, POINTS):  # by a check that was interrupted
        shutil.rmtree(root / left, ignore_errors=True)
    sparse = root / "sparse"
    model = load_native(sparse)
    held = keep_open(database)  # the parent reads in it how far we are
    verified = yield from _match(some, Path(images), camera_poses(model), database)
    if verified < MIN_PAIRS:
        yield {"failed": f"only {verified} pairs of neighbouring photos have enough matches"}
        return
    checked = check_model(model, database, 0)
    found, failed = facts(model, checked), checked.failed()
    found |= _other_conventions(found, checked, camera_poses(model), of_quaternions)
    yield found
    longest = max(max(photo.width, photo.height) for photo in some)
    limit_px = MAX_ERROR_PX * max(1.0, longest / MAX_IMAGE_SIZE)
    if not (found["fit"] or found["focal_fit"] or model.num_points3D()):
        job, better = (sparse, database, Path(images)), None
        if adjust and not _fit_well(found):
            yield {"phase": "adjusting the imported poses to the matches of their photos"}
            better = _adjusted(*job, root / ADJUSTED, found, limit_px)
        if better:
            found, failed = found | better[0] | {"adjusted_from_px": found["error_px"]}, better[1]
            job = root / ADJUSTED, *job[1:]
        # Photos with alpha need no points to tell the region, and edges of what is cut out are no points of a surface.
        if _mostly_agree(found) and 2 * sum(photo.has_alpha for photo in some) <= len(some):
            # Official test photos are to be as unknown as any new view.
            tests = [number for number, photo in enumerate(some, 1) if photo.image_name in test_files]
            yield {"phase": "triangulating points at the imported poses"}
            found["triangulated"] = triangulate(*job, root / POINTS, {*failed, *tests}, limit_px)
    held.close()
    yield found


def _match(
    photos: list[Photo], images: Path, poses: Float[np.ndarray, "photos 3 4"], database: Path
) -> Generator[dict[str, Any], None, int]:
    """Match the photos' neighbours; how many pairs have enough verified matches. Yields when matching begins."""
    masks = database.with_name("masks")
    fill_database(database, photos, MAPPING_MODEL)
    extraction = ExtractionOptions(MAX_IMAGE_SIZE, MAX_FEATURES, doubled_up_to=MAX_IMAGE_SIZE // 2)
    if write_feature_masks(images.parent, photos, masks):
        extraction = extraction._replace(masks=masks)
    extract_features(database, images, photos, extraction)
    by_name = natural_order([photo.name for photo in photos])  # where poses are wrong, so are their neighbours
    pairs = union(neighbours_by_pose(poses), pairs_apart(by_name, 1, MAX_NAME_STEPS))
    yield {"phase": MATCHING, "pairs": len(pairs)}
    match_pairs(database, pairs, 0, STRICT_RATIO)
    return int((verified_matches(database, pairs) >= MIN_INLIERS).sum())


def _other_conventions(
    found: dict[str, Any], checked: ModelCheck, poses: Float[np.ndarray, "photos 3 4"], of_quaternions: bool
) -> dict[str, Any]:
    """Another convention and other focal lengths that fit the matches, where the poses as given do not."""
    fit = None if _mostly_agree(found) else best_fit(checked.matches, poses, of_quaternions)
    if fit is None and found["agreeing"] < found["pairs"]:
        fit = fit_of_some(checked.matches, poses, checked.check.agrees)
    longer = None if fit or checked.fits else fitting_focal_factor(checked.matches, poses)
    return {"fit": fit._asdict() if fit else None, "focal_fit": longer._asdict() if longer else None}


def _adjusted(
    sparse: Path, database: Path, images: Path, target: Path, found: dict[str, Any], limit_px: float
) -> tuple[dict[str, Any], list[int]] | None:
    """Adjust the poses, and judge again; None where they do not fit well then, or where intrinsics are to blame: poses
    would bend to what other intrinsics explain about as well."""
    error_px, other = found["error_px"], database.with_name("intrinsics")
    if not adjust_poses(sparse, database, images, target, error_px, limit_px):
        return None
    model = load_native(target)
    checked = check_model(model, database, 0)
    again = facts(model, checked)
    if _fit_well(again) and again["error_px"] < error_px:
        tried = adjust_intrinsics(sparse, database, images, other, error_px, limit_px)
        of_intrinsics = check_model(load_native(other), database, 0).check.median_px if tried else np.inf
        if of_intrinsics > INTRINSICS_MARGIN * again["error_px"]:
            return again, checked.failed()
    shutil.rmtree(target)
    return None


def _mostly_agree(found: dict[str, Any]) -> bool:
    return 2 * found["agreeing"] >= found["pairs"]


def _fit_well(found: dict[str, Any]) -> bool:
    """Whether poses are exact for all but a few photos."""
    few = len(found["doubtful"]) <= MAX_DOUBTFUL * len(found["images"])
    return found["fits"] and _mostly_agree(found) and few


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
