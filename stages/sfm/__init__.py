"""Stage sfm: where every photo was taken from, by structure-from-motion or from cameras that are known already."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages.contract import Inputs, OptionalSourcePath, Progress, StageConfig, StageError, StageResult, listed
from stages.io.files import write_json
from stages.sfm.process import run_child
from stages.sfm.retry_strategies import ATTEMPTS, JOURNAL, left_out_for_time, read_kept

if TYPE_CHECKING:
    from stages.io.photos import Photo

INPUTS = ("ingest",)
VERSION = 14
RESUMES = True
PUBLISHED = ("sparse", "registration.json")
# Both may decide that an attempt is not made, which is said, in the stage's line as well. A run with another limit is
# to go on from the matches that one before it kept, so its key has to be the same. How far features are searched, which
# ``seconds`` decides as well, enters the key by options of its own.
NOT_HASHED = ("max_seconds", "seconds")

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
Matcher = Literal["exhaustive", "sequential", "spatial", "retrieval"]
MOST_NAMES = 5
# Of what the child process says, what registration.json takes as it is.
FACTS = (
    "attempts",
    "reprojection_px",
    "points",
    "camera_model",
    "camera_models",
    "match_graph",
    "check",
    "second_opinion",
)


class Config(StageConfig):
    """How cameras are found."""

    cameras: OptionalSourcePath = Field(
        default=None,
        description="Known cameras: a transforms.json, a folder with transforms_train.json, or a COLMAP model.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        lt=2**31,
        description="Of every random choice in matching and mapping; docs/experiments/camera_models.md says "
        "how far runs were seen to repeat.",
    )
    max_image_size: int | None = Field(
        default=None,
        ge=100,
        description="Longer side in pixels at which features are searched; larger photos are reduced for it; "
        "None: 1600, and less where --sfm.seconds or a budget leaves too little time.",
    )
    max_features: int | None = Field(
        default=None,
        ge=100,
        description="Features per photo, the largest ones first; matching takes time with its square; None: "
        "4096, and fewer where --sfm.seconds or a budget leaves too little time.",
    )
    camera_model: CameraModel | None = Field(
        default=None,
        description="COLMAP's camera model; None: SIMPLE_RADIAL while mapping, and then the simplest one that "
        "held-out observations do not speak against.",
    )
    camera_params: tuple[float, ...] | None = Field(
        default=None,
        description="The numbers of --sfm.camera-model where they are known, in COLMAP's order, for photos of "
        "this size; kept.",
    )
    matcher: Matcher | None = Field(
        default=None,
        description="Which pairs of photos matching begins with: all, neighbours in time or place, or those that "
        "look alike; all but the first go on where verified pairs point; None: all of up to 50 photos, else by what is "
        "known of them.",
    )
    neighbours: int = Field(default=30, ge=1, description="Partners of each photo, where not all pairs are matched.")
    attempts: int = Field(
        default=len(ATTEMPTS),
        ge=1,
        le=len(ATTEMPTS),
        description="How many ways to find the cameras are tried while photos have no place; 1: only the first.",
    )
    seconds: float | None = Field(
        default=None,
        gt=0,
        description="That it may take, if it can be: features are searched less far where they would take "
        "longer, and further attempts that would not fit are not begun. It is not given up for "
        "it; None: as long as is bearable.",
    )
    max_seconds: float = Field(
        default=4 * 3600.0,
        gt=0,
        description="When structure-from-motion is given up; what was matched until then is kept for the next "
        "try. Attempts that would not fit are not begun.",
    )


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """The config with features and pairs chosen, by what they take on this machine for some of the photos."""
    from stages.sfm.pairs.matching_plan import Open, chosen

    left_open = Open(config.max_image_size, config.max_features, config.matcher)
    if config.cameras is not None or None not in left_open:
        return config
    _, photos = _photos(inputs["ingest"])
    images = inputs["ingest"] / "images"
    answer = chosen(left_open, photos, images, config.neighbours, progress, config.seconds)
    return config.model_copy(update=answer._asdict())


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write ``sparse/`` and registration.json. Raises StageError where no usable model comes out."""
    photos, matched = _photos(inputs["ingest"])
    folder.mkdir(parents=True, exist_ok=True)
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
        raise StageError(f"cannot find cameras from {len(photos)} photo{'s' * (len(photos) != 1)}", why, OVERLAP_HINT)


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
        raise StageError(what, "the model that they are the parameters of is not given", hint)
    sizes = sorted({(photo.width, photo.height) for photo in photos})
    if len(sizes) > 1:
        listed = ", ".join(f"{width}×{height}" for width, height in sizes[:3])
        raise StageError(what, f"the photos have {len(sizes)} sizes ({listed}) and so several cameras", hint)
    try:
        valid = is_valid(Camera(config.camera_model, *sizes[0], config.camera_params))
    except ValueError as error:
        raise StageError(what, str(error), hint) from error
    if not valid:
        raise StageError(what, "a focal length is not positive", hint)


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
    return StageResult(
        outputs=("sparse", "registration.json"),
        records=("sfm.log",),
        line=f"{registered}/{len(images)} {what}{error} · {facts['camera_model']}{points}",
        facts=counts | {name: fact for name, fact in facts.items() if name != "test_files"},
    )
