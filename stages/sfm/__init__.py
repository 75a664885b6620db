"""Stage sfm: the camera poses and intrinsics of all photos, by structure-from-motion or imported."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from stages.contract import Inputs, OptionalSourcePath, Progress, StageConfig, StageResult
from stages.io.files import write_json

INPUTS = ("ingest",)
VERSION = 15
RESUMES = True
PUBLISHED = ("sparse", "registration.json")
# Both may decide that a retry strategy is skipped, which is said, in the stage's line as well. A run with another limit
# is to resume from the matches that one before it kept, so its key has to be the same. The quality of feature
# extraction, which ``seconds`` decides as well, enters the key by options of its own.
NOT_HASHED = ("max_seconds", "seconds")

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
Matcher = Literal["exhaustive", "sequential", "spatial", "retrieval"]
MAX_STRATEGIES = 8  # the default of ``max_strategies``, which is all of them


class Config(StageConfig):
    """How the cameras are found."""

    cameras: OptionalSourcePath = Field(
        default=None,
        description="Poses to import: a transforms.json, a folder with transforms_train.json, or a COLMAP model.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        lt=2**31,
        description="Seed of matching and mapping (docs/experiments/camera_models.md says how far runs repeat).",
    )
    max_image_size: int | None = Field(
        default=None,
        ge=100,
        description="Longer side in pixels at which features are extracted; larger photos are downscaled "
        "(default: 1600, less where --sfm.seconds or a budget leaves too little time).",
    )
    max_features: int | None = Field(
        default=None,
        ge=100,
        description="Features per photo, the largest first; matching time grows with its square "
        "(default: 4096, fewer where --sfm.seconds or a budget leaves too little time).",
    )
    camera_model: CameraModel | None = Field(
        default=None,
        description="COLMAP's camera model (default: SIMPLE_RADIAL while mapping, then the simplest one that "
        "held-out observations support).",
    )
    camera_params: tuple[float, ...] | None = Field(
        default=None,
        description="Known parameters of --sfm.camera-model in COLMAP's order, for photos of this size; they are "
        "not refined.",
    )
    matcher: Matcher | None = Field(
        default=None,
        description="How image pairs are selected: all, by time, by GPS position, or by image retrieval; all but "
        "exhaustive then follow the verified pairs (default: exhaustive up to 50 photos, else by what EXIF tells).",
    )
    neighbours: int = Field(default=30, ge=1, description="Partners of each photo, where not all pairs are matched.")
    max_strategies: int = Field(
        default=MAX_STRATEGIES,
        ge=1,
        le=MAX_STRATEGIES,
        description="How many retry strategies may be tried while photos are unregistered; 1: only the default one.",
    )
    seconds: float | None = Field(
        default=None,
        gt=0,
        description="Time to aim for: extraction quality is lowered where it would take longer, and retry strategies "
        "that would not fit are skipped; structure-from-motion is not aborted for it (default: no limit).",
    )
    max_seconds: float = Field(
        default=4 * 3600.0,
        gt=0,
        description="Structure-from-motion is aborted after this time; its matches are kept for the next run. Retry "
        "strategies that would not fit are skipped.",
    )


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """The config with features and pairs chosen, by what they take on this machine for some of the photos."""
    if config.cameras is not None or None not in (config.max_image_size, config.max_features, config.matcher):
        return config
    from stages.sfm import reconstruction

    return reconstruction.choose_options(config, inputs["ingest"], progress)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write ``sparse/`` and registration.json. Raises StageError where no usable model comes out."""
    from stages.sfm import reconstruction

    config = plan(config, inputs, progress)
    folder.mkdir(parents=True, exist_ok=True)
<<<<<<< HEAD
    if config.cameras is not None:
        from stages.sfm.imported.poses import import_cameras

        return _result(
            folder, source="import", **import_cameras(config.cameras, photos, inputs["ingest"], folder, progress)
        )
    return _reconstruct(plan(config, inputs, progress), photos, matched, inputs["ingest"], folder, progress)


def _photos(ingest: Path) -> "tuple[list[Photo], list[Photo]]":
    """All photos by file, and those of them that are matched: near duplicates of others are not."""
    from stages.io.photos import read_photos

    everything = sorted(read_photos(ingest), key=lambda photo: photo.file)
    return everything, [photo for photo in everything if not photo.near_duplicate_of]


# --- structure-from-motion


def _reconstruct(
    config: Config,
    everything: "list[Photo]",
    photos: "list[Photo]",
    ingest: Path,
    folder: Path,
    progress: Progress,
) -> StageResult:
    from stages.sfm.pairs.matching_plan import check_matcher
    from stages.sfm.pairs.pair_selection import places_of
    from stages.sfm.registration import (
        FEWEST_POINTS,
        FEWEST_REGISTERED,
        account,
        read_matches,
        repeated_structure,
        why_no_model,
        with_left_out,
    )

    _check_count(photos, len(everything))
    _check_camera(config, photos)
    check_matcher(config.matcher, places_of(photos))
    _check_memory(config, photos)
    names = [photo.image_name for photo in photos]
    database = _database(folder, names, progress)
    found = run_child(config, photos, ingest / "images", folder, database, progress)
    models, points = found["models"], found["points"]
    if not models or len(models[0]) < FEWEST_REGISTERED or points < FEWEST_POINTS:
        shutil.rmtree(folder / "sparse", ignore_errors=True)
        # By the strict matches of the first attempt: later ones let in many that are false.
        raise why_no_model(photos, read_matches(database), len(models[0]) if models else 0, points)
    matches = read_matches(Path(found["database"]))
    images = account(
        names, matches, models, found["observations"], found["supports"], found["conflict"], found["left_out"]
    )
    if found["conflict"]:
        progress.note(repeated_structure(found["conflict"], {photo.image_name: photo.name for photo in photos}))
    _say_who_is_missing(photos, images, progress)
    result = _result(
        folder,
        source="sfm",
        repeated_structure=found["conflict"],
        images=_with_figures(with_left_out(images, everything), found),
        georeference=_georeference(folder, photos, progress),
        test_files=None,
        **{name: found[name] for name in FACTS},
    )
    _forget(folder)
    all_placed = all(image["registered"] for image in images)
    return result if all_placed else replace(result, line=result.line + _for_want_of_time(found["attempts"]))


def _with_figures(images: list[dict[str, Any]], found: dict[str, Any]) -> list[dict[str, Any]]:
    """The account of each image with how well its pose is known, and how its matches agree with it."""
    spread, judged = found["uncertainty_px"], found["check"].pop("images")
    unknown = {"agreement": None, "transfer_px": None}
    return [
        image | {"uncertainty_px": spread.get(image["file"])} | judged.get(image["file"], unknown) for image in images
    ]


def _georeference(folder: Path, photos: "Sequence[Photo]", progress: Progress) -> dict[str, Any] | None:
    """Metres and compass directions by the registered photos' GPS, said; None where no photo has any, or too little."""
    import numpy as np

    from stages.normalise.georeference import georeference
    from stages.sfm.colmap.models import read_model

    place_of = {
        photo.image_name: (photo.latitude, photo.longitude, photo.altitude_m)
        for photo in photos
        if photo.latitude is not None and photo.longitude is not None
    }
    images = read_model(folder / "sparse").images if place_of else []
    located = [image for image in images if image.file in place_of]
    if not located:
        return None
    centres = np.array([image.sfm_from_camera[:, 3] for image in located])
    found = georeference(centres, [place_of[image.file] for image in located])
    if isinstance(found, str):
        progress.note(f"no metres from the photos' GPS: {found}")
        return None
    scale = f"one unit is {found.enu_from_sfm.scale:.3g} m"
    progress.note(f"GPS of {found.used} photos: {scale}; places are off by {found.error_m:.1f} m (median)")
    return found.to_json()


def _check_count(photos: "Sequence[Photo]", ingested: int) -> None:
    from stages.sfm.registration import FEWEST_REGISTERED, OVERLAP_HINT

    if len(photos) < FEWEST_REGISTERED:
        why = f"it takes at least {FEWEST_REGISTERED} photos that overlap"
        if same := ingested - len(photos):
            why += f", and {same} are nearly the same picture as one of these"
        raise StageError(
            "sfm.few-photos",
            f"cannot find cameras from {len(photos)} photo{'s' * (len(photos) != 1)}",
            why,
            OVERLAP_HINT,
        )


def _check_memory(config: Config, photos: "Sequence[Photo]") -> None:
    """Raises StageError where not even one photo at a time can be searched for features."""
    from stages.hardware.memory import check_memory
    from stages.sfm.colmap.matching import Search, feature_bytes

    assert config.max_image_size and config.max_features, "plan() chooses them"
    needed = feature_bytes(photos, Search(config.max_image_size, config.max_features))
    why = f"a photo searched at {config.max_image_size} pixels takes"
    check_memory(needed, "features of the photos", why, f"Try --sfm.max-image-size {config.max_image_size // 2}.")


def _check_camera(config: Config, photos: "Sequence[Photo]") -> None:
    """Raises StageError where the given intrinsics cannot be those of the photos."""
    from nerf.geometry.scene import Camera
    from stages.sfm.colmap.cameras import is_valid

    if config.camera_params is None:
        return
    what = "cannot use --sfm.camera-params"
    hint = "Give COLMAP's numbers for these photos: --sfm.camera-model SIMPLE_RADIAL --sfm.camera-params F CX CY K."
    if config.camera_model is None:
        raise StageError(
            "sfm.parameters-without-model", what, "the model that they are the parameters of is not given", hint
        )
    sizes = sorted({(photo.width, photo.height) for photo in photos})
    if len(sizes) > 1:
        listed = ", ".join(f"{width}×{height}" for width, height in sizes[:3])
        raise StageError(
            "sfm.parameters-of-several-cameras",
            what,
            f"the photos have {len(sizes)} sizes ({listed}) and so several cameras",
            hint,
        )
    try:
        valid = is_valid(Camera(config.camera_model, *sizes[0], config.camera_params))
    except ValueError as error:
        raise StageError("sfm.parameter-count", what, str(error), hint) from error
    if not valid:
        raise StageError("sfm.focal-not-positive", what, "a focal length is not positive", hint)


def _database(folder: Path, names: Sequence[str], progress: Progress) -> Path:
    """The database of features and matches: an interrupted run's if it can be trusted, else none yet.

    Its settings are those of the folder's key; COLMAP's version is not part of the key, so it is in the name.
    """
    from stages.sfm.registration import count_done, is_sound

    database = folder / f"matches-{version('pycolmap')}.db"
    if not database.exists():
        _forget(folder)  # attempts without their matches, or those of another version of COLMAP
        return database
    if _are_sound(folder / "attempts") and all(is_sound(one, names) for one in folder.glob("matches-*.db")):
        features, pairs = count_done(database)
        progress.note(f"going on with the features of {features} photos and {pairs} matched pairs found before")
    else:
        progress.note("the matches of the interrupted run are damaged: starting over")
        _forget(folder)
    return database


def _are_sound(attempts: Path) -> bool:
    try:
        for file in attempts.glob("*.json"):
            read_kept(file)
    except ValueError:
        return False
    return True


def _forget(folder: Path) -> None:
    """Remove what only an interrupted run needs: the journal first, for without the rest it would mislead."""
    (folder / "attempts" / JOURNAL).unlink(missing_ok=True)
    shutil.rmtree(folder / "attempts", ignore_errors=True)
    for database in folder.glob("matches-*"):
        database.unlink()


# --- what is said and written


def _say_who_is_missing(photos: "Sequence[Photo]", images: list[dict[str, Any]], progress: Progress) -> None:
    missing = [(photo.name, i["reason"]) for photo, i in zip(photos, images, strict=True) if not i["registered"]]
    if not missing:
        return
    progress.note(f"{len(missing)} of {len(photos)} photos found no place and are left out:")
    by_reason: dict[str, list[str]] = {}
    for name, reason in missing:
        by_reason.setdefault(reason, []).append(name)
    for reason, who in by_reason.items():
        progress.note(f"  {listed(who, MOST_NAMES)}: {reason}")


def _for_want_of_time(attempts: Sequence[dict[str, Any]]) -> str:
    """What the line says of attempts that were left out: a run with more time takes this result as finished."""
    ways = left_out_for_time(attempts)
    return f" · {ways} way{'s' * (ways != 1)} left out for time: sfm --force" if ways else ""


def _result(folder: Path, source: str, images: list[dict[str, Any]], **facts: Any) -> StageResult:
    registered = sum(image["registered"] for image in images)
    counts = {"source": source, "photos": len(images), "registered": registered}
    write_json(folder / "registration.json", {**counts, **facts, "images": images})
    error = "" if facts["reprojection_px"] is None else f", {facts['reprojection_px']:.2f} px"
    what = "registered" if source == "sfm" else "cameras known"
    points = f" · {facts['points']:,} points".replace(",", " ") if facts["points"] else ""
=======
    registration, skipped = reconstruction.find_cameras(config, inputs["ingest"], folder, progress)
    write_json(folder / "registration.json", registration)
>>>>>>> main
    return StageResult(
        outputs=("sparse", "registration.json"),
        records=("sfm.log",),
        line=_line(registration) + skipped,
        facts={name: fact for name, fact in registration.items() if name not in ("images", "test_files")},
    )


def _line(registration: dict[str, Any]) -> str:
    """The stage's line."""
    what = "registered" if registration["source"] == "sfm" else "poses imported"
    error, points = registration["reprojection_px"], registration["points"]
    line = f"{registration['registered']}/{registration['photos']} {what}"
    line += "" if error is None else f", {error:.2f} px"
    line += f" · {registration['camera_model']}"
    return line + (f" · {points:,} points".replace(",", " ") if points else "")
