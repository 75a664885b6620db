"""Stage sfm: where every photo was taken from, by structure-from-motion or from cameras that are known already."""

import json
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages.contract import Inputs, OptionalSourcePath, Progress, StageConfig, StageError, StageResult
from stages.files import write_json
from stages.live_line import live_line
from stages.sfm_attempts import ATTEMPTS, JOURNAL, abandon

if TYPE_CHECKING:
    from stages.photos import Photo

NEEDS = ("ingest",)
VERSION = 2
RESUMES = True
LINKS = ("sparse",)
UNKEYED = ("max_seconds",)

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
Matcher = Literal["exhaustive", "sequential", "spatial", "retrieval"]
# The share of the first attempt where a phase begins, and how long it is (measured on 11 to 50 photos, two cores).
PHASES = {"features": (0.0, 0.35), "matching": (0.35, 0.5), "mapping": (0.85, 0.15)}
FIRST_ATTEMPT, REFINING = 0.7, 0.95  # where they end and begin in the whole
FOR_CHILD = (
    "seed", "max_image_size", "max_features", "camera_model", "camera_params", "matcher", "neighbours", "attempts",
)  # fmt: skip
CHILD = ["-m", "stages.sfm_child"]
MOST_NAMES = 5


class Config(StageConfig):
    """How cameras are found."""

    cameras: OptionalSourcePath = None
    """Known cameras: a transforms.json, a folder with transforms_train.json, or a COLMAP model."""
    seed: int = Field(default=0, ge=0, lt=2**31)
    """Of every random choice in matching and mapping; docs/numbers.md says how far runs were seen to repeat."""
    max_image_size: int = Field(default=1600, ge=100)
    """Longer side in pixels at which features are searched; larger photos are reduced for it."""
    max_features: int = Field(default=4096, ge=100)
    """Features per photo, the largest ones first; matching takes time with its square."""
    camera_model: CameraModel | None = None
    """COLMAP's camera model; None: SIMPLE_RADIAL while mapping, and then the simplest one that held-out observations
    do not speak against."""
    camera_params: tuple[float, ...] | None = None
    """The numbers of --sfm.camera-model where they are known, in COLMAP's order, for photos of this size; kept."""
    matcher: Matcher | None = None
    """Which pairs of photos are matched: all, neighbours in time or place, or those that look alike; None: by cost."""
    neighbours: int = Field(default=30, ge=1)
    """Partners of each photo, where not all pairs are matched."""
    attempts: int = Field(default=len(ATTEMPTS), ge=1, le=len(ATTEMPTS))
    """How many ways to find the cameras are tried while photos have no place; 1: only the first."""
    max_seconds: float = Field(default=4 * 3600.0, gt=0)
    """When structure-from-motion is given up; what was matched until then is kept for the next try."""


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """The config with the pairs to match chosen, by what matching two of the photos takes on this machine."""
    from stages.matching_plan import chosen_matcher
    from stages.photos import read_photos

    if config.cameras is not None or config.matcher is not None:
        return config
    photos = sorted(read_photos(inputs["ingest"]), key=lambda photo: photo.file)
    photos = [photo for photo in photos if not photo.near_duplicate_of]
    features = config.model_dump(include={"max_image_size", "max_features"})
    matcher = chosen_matcher(photos, inputs["ingest"] / "images", config.neighbours, features, progress)
    return config.model_copy(update={"matcher": matcher})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write ``sparse/`` and registration.json. Raises StageError where no usable model comes out."""
    from stages.photos import read_photos

    photos = sorted(read_photos(inputs["ingest"]), key=lambda photo: photo.file)
    folder.mkdir(parents=True, exist_ok=True)
    if config.cameras is not None:
        return _import(config.cameras, photos, inputs["ingest"], folder, progress)
    return _reconstruct(plan(config, inputs, progress), photos, inputs["ingest"], folder, progress)


# --- known cameras


def _import(cameras: Path, photos: "list[Photo]", ingest: Path, folder: Path, progress: Progress) -> StageResult:
    from stages.colmap.models import write_model
    from stages.known_cameras import read_known_cameras
    from stages.photos import read_frame_names

    progress.update(f"reading the cameras of {cameras.name}")
    known = read_known_cameras(cameras, photos, read_frame_names(ingest))
    for note in known.notes:
        progress.note(note)
    write_model(folder / "sparse", known.model)
    return _result(
        folder,
        source="import",
        attempts=[],
        images=[image | {"uncertainty_px": None} for image in known.account(photos)],
        reprojection_px=float(known.model.error_px.mean()) if len(known.model.xyz) else None,
        points=len(known.model.xyz),
        camera_model="/".join(sorted({camera.model for camera in known.model.cameras})),
        camera_models=[],
        georeference=None,
        test_files=known.test_files,
    )


# --- structure-from-motion


def _reconstruct(config: Config, photos: "list[Photo]", ingest: Path, folder: Path, progress: Progress) -> StageResult:
    from stages.matching_plan import check_matcher, places_of
    from stages.registration import FEWEST_POINTS, FEWEST_REGISTERED, account, read_matches, why_no_model, with_left_out

    everything, photos = photos, [photo for photo in photos if not photo.near_duplicate_of]
    _check_count(photos, len(everything))
    _check_camera(config, photos)
    check_matcher(config.matcher, places_of(photos))
    names = [photo.image_name for photo in photos]
    database = _database(folder, names, progress)
    found = _run_child(config, photos, ingest / "images", folder, database, progress)
    models, points = found["models"], found["points"]
    if not models or len(models[0]) < FEWEST_REGISTERED or points < FEWEST_POINTS:
        shutil.rmtree(folder / "sparse", ignore_errors=True)
        # By the strict matches of the first attempt: later ones let in many that are false.
        raise why_no_model(photos, read_matches(database), len(models[0]) if models else 0, points)
    matches = read_matches(Path(found["database"]))
    images = account(names, matches, models, found["observations"], found["supports"])
    _say_who_is_missing(photos, images, progress)
    spread = found["uncertainty_px"]
    result = _result(
        folder,
        source="sfm",
        attempts=found["attempts"],
        images=[image | {"uncertainty_px": spread.get(image["file"])} for image in with_left_out(images, everything)],
        reprojection_px=found["reprojection_px"],
        points=points,
        camera_model=found["camera_model"],
        camera_models=found["camera_models"],
        georeference=_georeference(folder, photos, progress),
        test_files=None,
    )
    _forget(folder)
    return result


def _georeference(folder: Path, photos: "Sequence[Photo]", progress: Progress) -> dict[str, Any] | None:
    """Metres and compass directions by the registered photos' GPS, said; None where no photo has any, or too little."""
    import numpy as np

    from stages.colmap.models import read_model
    from stages.georeference import georeference

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
    from stages.registration import FEWEST_REGISTERED, OVERLAP_HINT

    if len(photos) < FEWEST_REGISTERED:
        why = f"it takes at least {FEWEST_REGISTERED} photos that overlap"
        if same := ingested - len(photos):
            why += f", and {same} are nearly the same picture as one of these"
        raise StageError(f"cannot find cameras from {len(photos)} photo{'s' * (len(photos) != 1)}", why, OVERLAP_HINT)


def _check_camera(config: Config, photos: "Sequence[Photo]") -> None:
    """Raises StageError where the given intrinsics cannot be those of the photos."""
    from nerf.scene import Camera
    from stages.colmap.cameras import is_valid

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
    from stages.registration import count_done, is_sound

    database = folder / f"matches-{version('pycolmap')}.db"
    if not database.exists():
        _forget(folder)  # attempts without their matches, or those of another version of COLMAP
        return database
    journal = folder / "attempts" / JOURNAL
    if all(is_sound(one, names) for one in folder.glob("matches-*.db")) and (not journal.exists() or _parses(journal)):
        features, pairs = count_done(database)
        progress.note(f"going on with the features of {features} photos and {pairs} matched pairs found before")
    else:
        progress.note("the matches of the interrupted run are damaged: starting over")
        _forget(folder)
    return database


def _parses(path: Path) -> bool:
    try:
        json.loads(path.read_bytes())
    except ValueError:
        return False
    return True


def _forget(folder: Path) -> None:
    """Remove what only an interrupted run needs: the journal first, for without the rest it would mislead."""
    (folder / "attempts" / JOURNAL).unlink(missing_ok=True)
    shutil.rmtree(folder / "attempts", ignore_errors=True)
    for database in folder.glob("matches-*"):
        database.unlink()


def _run_child(
    config: Config, photos: "Sequence[Photo]", images: Path, folder: Path, database: Path, progress: Progress
) -> dict[str, Any]:
    """Do the work in stages/sfm_child.py and hand back its result. Raises StageError if the child does not end well."""
    job = {
        "folder": str(folder.absolute()),
        "images": str(images.absolute()),
        "database": str(database.absolute()),
        "photos": [asdict(photo) for photo in photos],
        **config.model_dump(include={*FOR_CHILD}),
    }
    latest: dict[str, Any] = {"phase": "features", "database": job["database"], "done": 0, "pairs": 0}
    latest["attempt"] = ATTEMPTS[0].name
    log = folder / "sfm.log"
    with log.open("ab") as stderr:
        child = _start_child(stderr)
        overtime = threading.Timer(config.max_seconds, child.kill)
        overtime.start()
        assert child.stdin and child.stdout
        try:
            with live_line(progress, lambda: _describe(latest, len(photos))):
                _hand_over(child.stdin, job)
                for message in map(json.loads, child.stdout):
                    if note := message.pop("note", None):
                        progress.note(note)
                    latest.update(message)
            code = child.wait()
        finally:
            late = not overtime.is_alive()
            overtime.cancel()
            child.kill()
            child.wait()
    if "result" not in latest:
        if latest["attempt"] != ATTEMPTS[0].name and (late or code not in (0, -signal.SIGKILL)):
            abandon(folder / "attempts", latest["attempt"], "ran out of time" if late else "ended the program")
            without = f"Run again: it goes on without the attempt {latest['attempt']!r}. Log: {log}"
        else:
            without = None
        raise _child_failed(code, config.max_seconds if late else None, latest["phase"], log, without)
    return latest["result"]


def _start_child(stderr: Any) -> "subprocess.Popen[bytes]":
    from stages.matching_plan import environment

    return subprocess.Popen(
        [sys.executable, *CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=environment(),
        start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends the child
    )


def _hand_over(stdin: Any, job: dict[str, Any]) -> None:
    """Write the job and leave the pipe open: its end tells the child that the parent is gone."""
    try:
        stdin.write(json.dumps(job).encode() + b"\n")
        stdin.flush()
    except BrokenPipeError:  # the child died at once; its exit code says how
        return


def _describe(latest: Mapping[str, Any], photos: int) -> tuple[str, float | None]:
    """The live line and the finished share of the whole."""
    from stages.registration import count_done

    phase = latest["phase"]
    if phase == "refining":
        return "adjusting all cameras and points together", REFINING
    features, pairs = count_done(Path(latest["database"]))  # the first of mapping's steps places two photos
    done, total, words = {
        "features": (features, photos, "features of {} of {} photos"),
        "matching": (pairs, latest["pairs"], "matched {} of {} pairs of photos"),
        "mapping": (latest["done"] and min(latest["done"] + 1, photos), photos, "placed {} of {} photos"),
    }[phase]
    begin, length = PHASES[phase]
    share = begin + length * done / max(1, total)
    attempt = [one.name for one in ATTEMPTS].index(latest["attempt"])
    if not attempt:
        return words.format(done, total), FIRST_ATTEMPT * share
    later = (attempt - 1 + share) / (len(ATTEMPTS) - 1)
    return f"{words.format(done, total)} ({latest['attempt']})", FIRST_ATTEMPT + (REFINING - FIRST_ATTEMPT) * later


def _child_failed(code: int, limit: float | None, phase: str, log: Path, without: str | None) -> StageError:
    """``without``: the hint where running again goes on without the attempt that failed."""
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    last = lines[-1].strip() if lines else "it left no message"
    where = f"while {phase}" if phase != "features" else "while finding features"
    if limit is not None:
        return StageError(
            f"structure-from-motion was given up {where}",
            f"it took longer than {limit:g} s",
            without or "Give it longer with --sfm.max-seconds, or fewer photos; matches found so far are kept.",
        )
    if code < 0:
        name = signal.Signals(-code).name
        memory = code == -signal.SIGKILL
        return StageError(
            f"structure-from-motion was ended by {name} {where}",
            "most often the machine ran out of memory" if memory else f"COLMAP failed inside ({last})",
            f"Run again: what was matched is kept. With less memory: --sfm.max-features 2048. Log: {log}",
        )
    return StageError(f"structure-from-motion failed {where}", last, f"The whole log is in {log}")


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
        more = f" and {len(who) - MOST_NAMES} more" if len(who) > MOST_NAMES else ""
        progress.note(f"  {', '.join(who[:MOST_NAMES])}{more}: {reason}")


def _result(folder: Path, source: str, images: list[dict[str, Any]], **facts: Any) -> StageResult:
    registered = sum(image["registered"] for image in images)
    counts = {"source": source, "photos": len(images), "registered": registered}
    write_json(folder / "registration.json", {**counts, **facts, "images": images})
    error = "" if facts["reprojection_px"] is None else f", {facts['reprojection_px']:.2f} px"
    what = "registered" if source == "sfm" else "cameras known"
    points = f" · {facts['points']:,} points".replace(",", " ") if facts["points"] else ""
    return StageResult(
        outputs=("sparse", "registration.json"),
        records=("sfm.log",) if source == "sfm" else (),
        line=f"{registered}/{len(images)} {what}{error} · {facts['camera_model']}{points}",
        facts=counts | {name: fact for name, fact in facts.items() if name != "test_files"},
    )
