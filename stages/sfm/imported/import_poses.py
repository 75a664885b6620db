"""Imported poses: read, written as a model, checked against what the photos show."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerf.geometry.pose_distance import rotation_angles
from stages.contract import Progress, StageError, listed
from stages.io.photos import Photo, read_frame_names
from stages.io.sparse_model import SparseModel
from stages.sfm.colmap.cameras import focal_lengths_and_centre
from stages.sfm.colmap.models import read_model, write_model
from stages.sfm.imported.check_worker import ADJUSTED, POINTS, check_imported_poses
from stages.sfm.imported.conventions import (
    AXES,
    Fit,
    PoseConvention,
    axes_in_words,
    columns_for,
    found_convention,
    named_axes,
)
from stages.sfm.imported.focal_lengths import FocalFit
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.pose_files import convention_of_format, read_poses

MAX_NAMES = 5


def import_poses(
    cameras: Path,
    convention: PoseConvention,
    photos: Sequence[Photo],
    ingest: Path,
    folder: Path,
    adjust: bool,
    max_seconds: float,
    progress: Progress,
) -> dict[str, Any]:
    """Write ``sparse/`` from imported poses, and check them against the photos, which may ``adjust`` them where they
    are inexact: what registration.json says of them.

    Raises StageError where they cannot be used, and where their photos show that they are of another convention.
    """
    known, errors = write_imported_model(cameras, convention, photos, ingest, folder, progress)
    check = _check(known, photos, ingest, folder, (cameras / "images.txt").is_file(), adjust, max_seconds, progress)
    if check and (fit := check.pop("fit")):
        read_as = convention.with_defaults(convention_of_format(cameras))
        names = _names(known.model, photos)
        raise _another_convention(cameras.name, check, Fit(**fit), read_as, names)
    if check and (longer := check.pop("focal_fit")):
        raise _other_focal_lengths(cameras.name, check["error_px"], FocalFit(**longer), known.model)
    if check:
        _note_doubts(cameras.name, check, known.model, photos, progress)
        known, errors = _improved(known, errors, check, folder, progress)
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


def write_imported_model(
    cameras: Path, convention: PoseConvention, photos: Sequence[Photo], ingest: Path, folder: Path, progress: Progress
) -> tuple[ImportedPoses, Float[np.ndarray, "points"]]:
    """Read the cameras and write ``sparse/``; also the reprojection errors of its points, in pixels."""
    progress.update(f"reading the cameras of {cameras.name}")
    known = read_poses(cameras, photos, read_frame_names(ingest), convention)
    for note in known.notes:
        progress.note(*note)
    write_model(folder / "sparse", known.model)
    errors = read_model(folder / "sparse").error_px  # computed anew: what the given model says of them may be anything
    if lost := int((~np.isfinite(errors)).sum()):
        raise StageError(
            "sfm.points-do-not-fit",
            f"the cameras of {cameras.name} do not fit its points",
            f"{lost} of {len(errors)} points are observed at pixels that have no ray in their camera",
            "Check the distortion of the cameras, or leave them out to find them from the photos.",
        )
    return known, errors


def _another_convention(
    name: str, check: dict[str, Any], fit: Fit, read_as: PoseConvention, photos: Sequence[str]
) -> StageError:
    """The error for poses that agree with their photos under another convention than they were read with."""
    direction, axes = found_convention(fit, read_as)
    how = f"as {direction.replace('-', ' ')}, with camera axes {axes_in_words(axes)}"
    how += ", in a left-handed world" * fit.mirrored + ", with quaternions as x, y, z, w" * fit.scalar_last
    of = listed([photos[i] for i in fit.of], MAX_NAMES)
    return StageError(
        "sfm.other-pose-convention",
        f"the poses of {len(fit.of)} of {len(photos)} photos in {name} contradict the others" if fit.of
        else f"the poses of {name} contradict their photos",
        f"{check['agreeing']} of {check['pairs']} verified pairs of photos agree with them; read {how}, "
        f"{fit.agreeing} of {fit.pairs} {f'pairs of these photos agree: {of}' if fit.of else 'agree'}",
        _how_to_convert(fit, direction, axes, read_as),
    )  # fmt: skip


def _other_focal_lengths(name: str, error_px: float, fit: FocalFit, model: SparseModel) -> StageError:
    """The error for cameras that fit their photos with other focal lengths."""
    given = float(np.median([focal_lengths_and_centre(camera)[0] for camera in model.cameras]))
    return StageError(
        "sfm.other-focal-lengths",
        f"the focal lengths of {name} do not fit the photos",
        f"matches of the photos lie {error_px:.1f} px from where the cameras predict them, and {fit.error_px:.1f} px "
        f"with focal lengths {fit.factor:.2f} times as long",
        f"Change them from {given:.0f} px to about {fit.factor * given:.0f} px, or correct the image size that they "
        "belong to; or leave out the cameras to find them from the photos: pipeline run FOLDER",
    )


def _how_to_convert(fit: Fit, direction: str, axes: Float[np.ndarray, "3 3"], read_as: PoseConvention) -> str:
    """What to do with poses of this convention."""
    known = named_axes(axes)
    say_so = f"--sfm.pose-direction {direction} --sfm.camera-axes {known}"
    if fit.scalar_last:
        also = "" if known and (direction, known) == read_as else f", and add {say_so}" if known else ""
        return f"Write the quaternions in images.txt as QW QX QY QZ{also}."
    if known and not fit.of:
        return f"If the file means that, add {say_so}."
    columns = f"take its columns {columns_for(AXES[read_as.axes or 'opencv'], axes)} (- means negated)"
    of_which = f"the matrix of each of these {len(fit.of)}" if fit.of else "each matrix"
    steps = [f"invert {of_which}", columns] if direction != read_as.direction else [f"of {of_which} {columns}"]
    steps = [*steps, "negate its third row"] if fit.mirrored else steps
    return f"To convert them, {', then '.join(steps)}; or leave out the cameras: pipeline run FOLDER"


def _check(
    known: ImportedPoses,
    photos: Sequence[Photo],
    ingest: Path,
    folder: Path,
    of_quaternions: bool,
    adjust: bool,
    max_seconds: float,
    progress: Progress,
) -> dict[str, Any] | None:
    """What verified matches of neighbouring photos say of imported poses; None, with a note, where they say nothing."""
    posed = {image.file for image in known.model.images}
    posed_photos = [photo for photo in photos if photo.image_name in posed]
    tests = known.test_files or ()
    check = check_imported_poses(
        posed_photos, ingest / "images", folder, tests, of_quaternions, adjust, max_seconds, progress
    )
    if why := check.get("failed"):
        progress.note("sfm.poses-unchecked", f"the imported poses were not checked: {why}")
        return None
    if why := check.pop("unfinished"):
        progress.note("sfm.no-imported-points", f"no points were found for the imported poses: {why}; see sfm.log")
    return check


def _improved(
    known: ImportedPoses, errors: Float[np.ndarray, "points"], check: dict[str, Any], folder: Path, progress: Progress
) -> tuple[ImportedPoses, Float[np.ndarray, "points"]]:
    """The poses as the check has adjusted them, with the points that it has found, in ``sparse/`` too; and the points'
    reprojection errors."""
    model = known.model
    if check["adjusted_from_px"] is not None:
        adjusted = read_model(folder / ADJUSTED)
        moved, turned = _median_changes(model, adjusted)
        progress.note(
            "sfm.poses-adjusted",
            "the imported poses do not fit the photos exactly and were adjusted: the error of the matches was "
            f"{check['adjusted_from_px']:.1f} px and is {check['error_px']:.1f} px. The median camera moved by "
            f"{moved:.2g}% of the cameras' extent and turned by {turned:.2g}°. To keep the poses as given, add "
            "--sfm.no-adjust-poses",
        )
        model = replace(model, images=adjusted.images)
    if check.pop("triangulated"):
        found, of_file = read_model(folder / POINTS), {image.file: i for i, image in enumerate(model.images)}
        view = np.array([of_file[image.file] for image in found.images])[found.view]  # both are in order of file
        points = {name: getattr(found, name) for name in ("xyz", "rgb", "error_px", "point", "xy")}
        model, errors = replace(model, view=view, **points), found.error_px
    if model is not known.model:
        write_model(folder / "sparse", model)
    for scratch in (ADJUSTED, POINTS):
        shutil.rmtree(folder / scratch, ignore_errors=True)
    return replace(known, model=model), errors


def _median_changes(given: SparseModel, adjusted: SparseModel) -> tuple[float, float]:
    """By how much the poses of a model differ from another's: in percent of the extent of its cameras, and degrees."""
    before, after = (np.array([image.sfm_from_camera for image in model.images]) for model in (given, adjusted))
    extent = np.linalg.norm(np.ptp(before[:, :, 3], axis=0))
    moved = np.median(np.linalg.norm(after[:, :, 3] - before[:, :, 3], axis=1)) / extent
    turned = np.degrees(np.median(rotation_angles(before[:, :, :3], after[:, :, :3])))
    return 100 * float(moved), float(turned)


def _names(model: SparseModel, photos: Sequence[Photo]) -> list[str]:
    """The photos' own names, in the order of the model's images."""
    names = {photo.image_name: photo.name for photo in photos}
    return [names[image.file] for image in model.images]


def _note_doubts(
    source: str, check: dict[str, Any], model: SparseModel, photos: Sequence[Photo], progress: Progress
) -> None:
    """Note where photos contradict their imported poses."""
    if 2 * check["agreeing"] < check["pairs"]:
        progress.note(
            "sfm.poses-contradict",
            f"the cameras of {source} contradict their photos: only {check['agreeing']} of {check['pairs']} verified "
            "pairs of photos agree with them, and no other pose convention fits better. Check the focal lengths, and "
            "that the cameras belong to these photos; or leave out the cameras to find them from the photos",
        )
    elif check["doubtful"]:
        names = dict(zip([image.file for image in model.images], _names(model, photos), strict=True))
        who = listed([names[file] for file in check["doubtful"]], MAX_NAMES)
        progress.note(
            "sfm.doubtful-poses",
            f"{len(check['doubtful'])} of {len(model.images)} imported poses contradict the matches of their photos: "
            f"{who}. They are used; correct or remove them in {source} if they are wrong",
        )
    elif not check["fits"]:
        progress.note(
            "sfm.cameras-inexact",
            f"the cameras of {source} are inexact: the error of the matches is {check['error_px']:.1f} px with these "
            f"cameras, and {check['noise_px']:.1f} px with the geometry of each pair alone. Check distortion and "
            "principal point; or leave out the cameras to find them from the photos",
        )
