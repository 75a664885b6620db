"""Cameras that are known already: read, written as a model, checked against what the photos show."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stages.contract import Progress, StageError, listed
from stages.io.photos import Photo, read_frame_names
from stages.io.sparse_model import SparseModel
from stages.sfm.colmap.models import read_model, write_model
from stages.sfm.imported.known_cameras import KnownCameras, read_known_cameras
from stages.sfm.imported.pose_check import check_given_cameras

MOST_NAMES = 5


def import_cameras(
    cameras: Path, photos: Sequence[Photo], ingest: Path, folder: Path, progress: Progress
) -> dict[str, Any]:
    """Write ``sparse/`` from known cameras, and check them against the photos: what registration.json says of them.

    Raises StageError where they cannot be used.
    """
    known, errors = write_known_model(cameras, photos, ingest, folder, progress)
    check = _check_given(known.model, photos, ingest, folder, progress)
    judged = check.pop("images", {}) if check else {}
    unknown = {"agreement": None, "transfer_px": None}
    return {
        "strategies": [],
        "repeated_structure": None,
        "match_graph": None,
        "check": check,
        "global_mapping": None,
        "images": [
            image | {"uncertainty_px": None} | judged.get(image["file"], unknown) for image in known.account(photos)
        ],
        "reprojection_px": float(errors.mean()) if len(errors) else None,
        "points": len(known.model.xyz),
        "camera_model": "/".join(sorted({camera.model for camera in known.model.cameras})),
        "camera_models": [],
        "georeference": None,
        "test_files": known.test_files,
    }


def write_known_model(
    cameras: Path, photos: Sequence[Photo], ingest: Path, folder: Path, progress: Progress
) -> tuple[KnownCameras, Float[np.ndarray, "points"]]:
    """Read the cameras and write ``sparse/``; also the reprojection errors of its points, in pixels."""
    progress.update(f"reading the cameras of {cameras.name}")
    known = read_known_cameras(cameras, photos, read_frame_names(ingest))
    for note in known.notes:
        progress.note(note)
    write_model(folder / "sparse", known.model)
    errors = read_model(folder / "sparse").error_px  # computed anew: what the given model says of them may be anything
    if lost := int((~np.isfinite(errors)).sum()):
        raise StageError(
            "sfm.points-do-not-fit",
            f"the cameras of {cameras.name} do not fit its points",
            f"{lost} of {len(errors)} points are seen where their cameras cannot see anything",
            "Check the distortion of the cameras, or leave them out to have them found from the photos.",
        )
    return known, errors


def _check_given(
    model: SparseModel, photos: Sequence[Photo], ingest: Path, folder: Path, progress: Progress
) -> dict[str, Any] | None:
    """What verified matches of neighbouring photos say of given cameras; None, said, where they say nothing."""
    progress.update("comparing the cameras with what neighbouring photos show")
    posed = {image.file for image in model.images}
    check = check_given_cameras([photo for photo in photos if photo.image_name in posed], ingest / "images", folder)
    if why := check.get("failed"):
        progress.note(f"the given cameras could not be checked: {why}")
        return None
    if 2 * check["agreeing"] < check["pairs"]:
        progress.note(
            f"the given cameras contradict their photos: {check['agreeing']} of {check['pairs']} verified pairs agree "
            "with them. Check that poses are world from camera and which way their axes point, or leave out --cameras"
        )
    elif check["doubtful"]:
        names = {photo.image_name: photo.name for photo in photos}
        who = listed([names[file] for file in check["doubtful"]], MOST_NAMES)
        progress.note(
            f"{len(check['doubtful'])} of {len(posed)} given cameras contradict what their photos show: {who}"
        )
    return check
