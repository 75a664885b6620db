"""What stage sfm does in the user's own process: it checks the photos, runs the worker and reports what it found."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import Timeout

from nerf.geometry.georeference import georeference
from stages.contract import Note, Progress, StageError, listed
from stages.hardware.memory import check_memory
from stages.ingest.listing import write_photo_list
from stages.io.amounts import counted
from stages.io.ascii_names import shell_quoted
from stages.io.photos import Photo, read_photos
from stages.sfm.colmap.cameras import is_valid
from stages.sfm.colmap.database.extraction import ExtractionOptions, feature_bytes
from stages.sfm.colmap.given_intrinsics import given_intrinsics
from stages.sfm.colmap.models import read_model
from stages.sfm.imported.conventions import PoseConvention
from stages.sfm.imported.import_poses import import_poses
from stages.sfm.job import worker_lock
from stages.sfm.pairs.pair_selection import capture_priors
from stages.sfm.pairs.quality_level import GivenOptions, check_matcher, chosen
from stages.sfm.registration import (
    MIN_MODEL_POINTS,
    MIN_REGISTERED,
    NEAR_DUPLICATE,
    OVERLAP_HINT,
    PHOTO_GROUPS,
    count_done,
    first_database,
    image_rows,
    is_sound,
    photo_groups,
    read_matches,
    repeated_structure,
    why_no_model,
    with_near_duplicates,
)
from stages.sfm.retry_strategies import LOG, read_kept, read_notes
from stages.sfm.worker_process import run_worker

MAX_NAMES, MAX_COMMANDS = 5, 3
# Of the worker's result, what registration.json takes as it is.
FACTS = (
    "strategies",
    "reprojection_px",
    "points",
    "camera_model",
    "camera_models",
    "match_graph",
    "check",
    "global_mapping",
)

if TYPE_CHECKING:
    from stages.sfm import Config


def choose_options(config: "Config", ingest: Path, progress: Progress) -> "Config":
    """The config with features and pairs chosen, by what they take on this machine for some of the photos."""
    given = GivenOptions(config.max_image_size, config.max_features, config.matcher)
    _, photos = _photos(ingest)
    answer = chosen(given, photos, ingest / "images", config.neighbours, progress, config.seconds)
    return config.model_copy(update=answer._asdict())


def find_cameras(config: "Config", ingest: Path, folder: Path, progress: Progress) -> tuple[dict[str, Any], str]:
    """Write ``sparse/``; what registration.json says of it, and what the stage's line adds.

    Raises StageError where no usable model comes out.
    """
    photos, matched = _photos(ingest)
    _wait_for_worker(folder, progress)
    if config.cameras is not None:
        convention = PoseConvention(config.pose_direction, config.camera_axes)
        limits = config.adjust_poses, config.max_seconds
        imported = import_poses(config.cameras, convention, photos, ingest, folder, *limits, progress)
        return _registration("import", **imported), ""
    return _reconstruct(config, photos, matched, ingest, folder, progress)


def _photos(ingest: Path) -> tuple[list[Photo], list[Photo]]:
    """All photos by file, and those of them that are matched: near duplicates of others are not."""
    everything = sorted(read_photos(ingest), key=lambda photo: photo.file)
    return everything, [photo for photo in everything if not photo.near_duplicate_of]


def _registration(source: str, images: list[dict[str, Any]], **facts: Any) -> dict[str, Any]:
    """The content of registration.json. Near-duplicates are no photos that could be registered and are not."""
    registered = sum(image["registered"] for image in images)
    same = sum(image["reason_code"] == NEAR_DUPLICATE for image in images)
    counts = {"photos": len(images) - same, "registered": registered, "near_duplicates": same}
    return {"source": source, **counts, **facts, "images": images}


def _reconstruct(
    config: "Config", everything: list[Photo], photos: list[Photo], ingest: Path, folder: Path, progress: Progress
) -> tuple[dict[str, Any], str]:
    _check_count(photos, len(everything))
    _check_camera(config, photos, progress)
    check_matcher(config.matcher, capture_priors(photos))
    _check_memory(config, photos)
    names = [photo.image_name for photo in photos]
    database = _database(folder, names, progress)
    found = run_worker(config, photos, ingest / "images", folder, database, progress)
    models, points = found["models"], found["points"]
    if not models or len(models[0]) < MIN_REGISTERED or points < MIN_MODEL_POINTS:
        shutil.rmtree(folder / "sparse", ignore_errors=True)
        # By the matches of the first strategy: later ones let in many that are false.
        raise why_no_model(photos, read_matches(database), len(models[0]) if models else 0, points)
    matches, conflict = read_matches(Path(found["database"])), found["conflict"]
    left_out = read_notes(found["left_out"])
    images = image_rows(names, matches, models, found["observations"], found["supports"], conflict, left_out)
    if conflict:
        progress.note(
            "sfm.repeated-structure", repeated_structure(conflict, {photo.image_name: photo.name for photo in photos})
        )
    _note_unregistered(photos, images, progress)
    list_groups(config.photos, photos, models, folder, progress)
    _note_weak_links(photos, found["check"]["weak_links"], progress)
    registration = _registration(
        "sfm",
        repeated_structure=conflict,
        images=_with_figures(with_near_duplicates(images, everything), found),
        georeference=_georeference(folder, photos, progress),
        test_files=None,
        **{name: found[name] for name in FACTS},
    )
    complete = all(image["registered"] for image in images)
    return registration, "" if complete else _skipped_for_time(found["skipped_for_time"])


# --- checks beforehand


def _check_count(photos: Sequence[Photo], ingested: int) -> None:
    if len(photos) < MIN_REGISTERED:
        why = f"structure from motion needs at least {MIN_REGISTERED} photos that overlap"
        if same := ingested - len(photos):
            why += f", and {counted(same, 'more is a near-duplicate', 'more are near-duplicates')} of these"
        raise StageError(
            "sfm.few-photos",
            f"cannot find cameras from {counted(len(photos))}",
            why,
            OVERLAP_HINT,
        )


def _check_memory(config: "Config", photos: Sequence[Photo]) -> None:
    """Raises StageError where memory does not suffice for the features of even one photo at a time."""
    assert config.max_image_size and config.max_features, "choose_options() sets them"
    needed = feature_bytes(photos, ExtractionOptions(config.max_image_size, config.max_features))
    why = f"feature extraction from one photo at {config.max_image_size} pixels takes"
    check_memory(needed, "features of the photos", why, f"Try --sfm.max-image-size {config.max_image_size // 2}.")


def _check_camera(config: "Config", photos: Sequence[Photo], progress: Progress) -> None:
    """Raises StageError where the given intrinsics cannot be those of the photos, and notes for how many sizes they are
    adapted."""
    if config.camera_params is None:
        return
    what = "cannot use --sfm.camera-params"
    hint = "Give COLMAP's numbers for these photos: --sfm.camera-model SIMPLE_RADIAL --sfm.camera-params F CX CY K."
    if config.camera_model is None:
        raise StageError("sfm.parameters-without-model", what, "--sfm.camera-model is missing", hint)
    try:
        cameras = given_intrinsics(photos, config.camera_model, config.camera_params)
    except ValueError as error:
        raise StageError("sfm.parameter-count", what, str(error), hint) from error
    if not any(cameras):
        sizes = dict.fromkeys(f"{photo.width}×{photo.height}" for photo in photos)
        why = f"their principal point is the middle of none of the photos' sizes ({listed([*sizes], MAX_NAMES)})"
        raise StageError("sfm.parameters-of-no-photo", what, why, hint)
    if others := [f"{p.name} ({p.width}×{p.height})" for p, one in zip(photos, cameras, strict=True) if one is None]:
        raise StageError(
            "sfm.parameters-of-other-photos",
            what,
            f"{len(others)} of {len(photos)} photos do not have the shape of the photos that the parameters are for: "
            f"{listed(others, MAX_NAMES)}",
            "Give the parameters of one of the photos' sizes, and leave out photos of another shape.",
        )
    if not all(is_valid(camera) for camera in cameras if camera):
        raise StageError("sfm.focal-not-positive", what, "a focal length is not positive", hint)
    if adapted := sum(camera.params != config.camera_params for camera in cameras if camera):
        progress.note(
            "sfm.parameters-adapted",
            f"--sfm.camera-params are turned or rescaled with {adapted} of {len(photos)} photos",
        )


# --- what an interrupted run left


def _wait_for_worker(folder: Path, progress: Progress) -> None:
    """Wait for the worker process of a run that was killed, which may not have ended yet."""
    lock = worker_lock(folder)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        progress.update("waiting for the worker process of a killed run to end")
        lock.acquire()
    lock.release()


def _database(folder: Path, names: Sequence[str], progress: Progress) -> Path:
    """The database of features and matches: an interrupted run's if it can be trusted, else none yet.

    Its settings are those of the folder's key.
    """
    database = first_database(folder)
    if not database.exists():
        _remove_intermediate(folder)  # strategies without their matches, or those of another version of COLMAP
        return database
    if _are_sound(folder / "strategies") and all(is_sound(one, names) for one in folder.glob("matches-*.db")):
        features, pairs = count_done(database)
        progress.note(
            "sfm.resumes",
            f"resuming with the features of {counted(features)} and {counted(pairs, 'matched pair')}",
        )
    else:
        progress.note("sfm.damaged-matches", "starting over, because the matches of the interrupted run are damaged")
        _remove_intermediate(folder)
    return database


def _are_sound(strategies: Path) -> bool:
    try:
        for file in strategies.glob("*.json"):
            read_kept(file)
    except ValueError:
        return False
    return True


def _remove_intermediate(folder: Path) -> None:
    """Remove what an interrupted run left: the log first, for without the rest it would mislead. Of a finished run that
    is the runner's to do, once its manifest is written: until then a kill would lose all of it."""
    (folder / "strategies" / LOG).unlink(missing_ok=True)
    shutil.rmtree(folder / "strategies", ignore_errors=True)
    for database in folder.glob("matches-*"):
        database.unlink()


# --- the report of a reconstruction


def _with_figures(images: list[dict[str, Any]], found: dict[str, Any]) -> list[dict[str, Any]]:
    """The row of each image with how well its pose is known, and how its matches agree with it."""
    uncertainty, checked = found["uncertainty_px"], found["check"].pop("images")
    unknown = {"agreement": None, "transfer_px": None}
    return [
        image | {"uncertainty_px": uncertainty.get(image["file"])} | checked.get(image["file"], unknown)
        for image in images
    ]


def _georeference(folder: Path, photos: Sequence[Photo], progress: Progress) -> dict[str, Any] | None:
    """Metres and compass directions by the registered photos' GPS, noted; None where none or too few have it."""
    position_of = {
        photo.image_name: (photo.latitude, photo.longitude, photo.altitude_m)
        for photo in photos
        if photo.latitude is not None and photo.longitude is not None
    }
    images = read_model(folder / "sparse").images if position_of else []
    located = [image for image in images if image.file in position_of]
    if not located:
        return None
    centres = np.array([image.sfm_from_camera[:, 3] for image in located])
    found = georeference(centres, [position_of[image.file] for image in located])
    if isinstance(found, str):
        progress.note("sfm.no-gps-scale", f"the photos' GPS gives no metric scale: {found}")
        return None
    scale = f"by the GPS of {found.used} photos one unit is {found.enu_from_sfm.scale:.3g} m"
    progress.note("sfm.gps-scale", f"{scale}; the median position error is {found.error_m:.1f} m")
    return found.to_json()


def _note_unregistered(photos: Sequence[Photo], images: list[dict[str, Any]], progress: Progress) -> None:
    missing = [
        (photo.name, Note(i["reason_code"], i["reason"]))
        for photo, i in zip(photos, images, strict=True)
        if not i["registered"]
    ]
    if not missing:
        return
    progress.note("sfm.unregistered", f"{len(missing)} of {len(photos)} photos are unregistered and left out:")
    by_reason: dict[Note, list[str]] = {}
    for name, reason in missing:
        by_reason.setdefault(reason, []).append(name)
    for reason, who in by_reason.items():
        progress.note(*reason._replace(text=f"  {listed(who, MAX_NAMES)}: {reason.text}"))


def list_groups(
    given: Path | None, photos: Sequence[Photo], models: Sequence[Sequence[str]], folder: Path, progress: Progress
) -> None:
    """List the photos of each further sub-model in a file, and note how to run them by themselves; ``given`` is
    PHOTOS."""
    shutil.rmtree(folder / PHOTO_GROUPS, ignore_errors=True)  # of an interrupted run
    workspace = folder.absolute().parent.parent
    if any(photo.time_s is not None for photo in photos):  # frames that ingest has taken from a video
        given = workspace / "output" / "images"
    name_of = {photo.image_name: photo.name for photo in photos}
    groups = photo_groups(models)
    for number, (file, members) in enumerate(groups.items(), start=2):
        names = [name_of[member] for member in members]
        write_photo_list(folder / file, names)
        other = workspace.parent / f"{workspace.stem}-{number}{workspace.suffix}"
        words = (given or "PHOTOS", "--ingest.photo-list", workspace / "output" / file, "-o", other)
        command = " ".join(["pipeline run", *(shell_quoted(str(word)) for word in words)])
        if number < 2 + MAX_COMMANDS:
            which = f"{len(names)} photos form another group ({listed(names, MAX_NAMES)})"
            progress.note("sfm.photo-group", f"{which}; to run it by itself: {command}")
    if (more := len(groups) - MAX_COMMANDS) > 0:
        progress.note("sfm.more-photo-groups", f"… and {counted(more, 'more group')}, listed in output/{PHOTO_GROUPS}/")


def _note_weak_links(photos: Sequence[Photo], links: Sequence[dict[str, Any]], progress: Progress) -> None:
    """Name the photos whose poses rest on few matches: nothing else would show it if these were wrong."""
    weak = {file for link in links for file in link["photos"]}
    if who := [photo.name for photo in photos if photo.image_name in weak]:
        progress.note("sfm.few-matches", f"few matches link {listed(who, MAX_NAMES)} to the other photos")


def _skipped_for_time(count: int) -> str:
    """What the line says of strategies skipped for time: a run with more time takes this result as finished."""
    return f" · {counted(count, 'retry strategy', 'retry strategies')} skipped for time: sfm --force" if count else ""
