"""Stage sfm: where every photo was taken from, by structure-from-motion or from cameras that are known already."""

import json
import os
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

if TYPE_CHECKING:
    from stages.photos import Photo

NEEDS = ("ingest",)
VERSION = 2
RESUMES = True
LINKS = ("sparse",)
UNKEYED = ("max_seconds",)

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
# The share of the whole where a phase begins, and how long it is (measured on 11 to 50 photos, two cores).
PHASES = {
    "features": (0.0, 0.25),
    "matching": (0.25, 0.35),
    "mapping": (0.6, 0.1),
    "matching again": (0.7, 0.15),
    "mapping again": (0.85, 0.1),
    "refining": (0.95, 0.05),
}
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
    matcher: Literal["exhaustive"] = "exhaustive"
    """Which pairs of photos are matched: all of them."""
    max_seconds: float = Field(default=4 * 3600.0, gt=0)
    """When structure-from-motion is given up; what was matched until then is kept for the next try."""


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write ``sparse/`` and registration.json. Raises StageError where no usable model comes out."""
    from stages.photos import read_photos

    photos = sorted(read_photos(inputs["ingest"]), key=lambda photo: photo.file)
    folder.mkdir(parents=True, exist_ok=True)
    if config.cameras is not None:
        return _import(config.cameras, photos, inputs["ingest"], folder, progress)
    return _reconstruct(config, photos, inputs["ingest"], folder, progress)


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
        images=[image | {"uncertainty_px": None} for image in known.account(photos)],
        reprojection_px=float(known.model.error_px.mean()) if len(known.model.xyz) else None,
        points=len(known.model.xyz),
        camera_model="/".join(sorted({camera.model for camera in known.model.cameras})),
        camera_models=[],
        test_files=known.test_files,
    )


# --- structure-from-motion


def _reconstruct(config: Config, photos: "list[Photo]", ingest: Path, folder: Path, progress: Progress) -> StageResult:
    from stages.registration import FEWEST_POINTS, FEWEST_REGISTERED, account, read_matches, why_no_model

    _check_count(photos)
    names = [photo.file.removeprefix("images/") for photo in photos]
    database = _database(folder, names, progress)
    found = _run_child(config, photos, ingest / "images", folder, database, progress)
    matches = read_matches(Path(found["database"]))
    models, points = found["models"], found.get("points", 0)
    if not models or len(models[0]) < FEWEST_REGISTERED or points < FEWEST_POINTS:
        shutil.rmtree(folder / "sparse", ignore_errors=True)
        raise why_no_model(photos, matches, len(models[0]) if models else 0, points)
    images = account(names, matches, models, found["observations"])
    _say_who_is_missing(photos, images, progress)
    for leftover in folder.glob("matches-*"):
        leftover.unlink()
    return _result(
        folder,
        source="sfm",
        images=[image | {"uncertainty_px": found["uncertainty_px"].get(image["file"])} for image in images],
        reprojection_px=found["reprojection_px"],
        points=points,
        camera_model=found["camera_model"],
        camera_models=found["camera_models"],
        test_files=None,
    )


def _check_count(photos: "Sequence[Photo]") -> None:
    from stages.registration import FEWEST_REGISTERED, OVERLAP_HINT

    if len(photos) < FEWEST_REGISTERED:
        raise StageError(
            f"cannot find cameras from {len(photos)} photo{'s' * (len(photos) != 1)}",
            f"it takes at least {FEWEST_REGISTERED} photos that overlap",
            OVERLAP_HINT,
        )


def _database(folder: Path, names: Sequence[str], progress: Progress) -> Path:
    """The database of features and matches: an interrupted run's if it can be trusted, else none yet.

    Its settings are those of the folder's key; COLMAP's version is not part of the key, so it is in the name.
    """
    from stages.registration import count_done, is_sound

    database = folder / f"matches-{version('pycolmap')}.db"
    if not database.exists():
        return database
    if all(is_sound(one, names) for one in folder.glob("matches-*.db")):
        features, pairs = count_done(database)
        progress.note(f"going on with the features of {features} photos and {pairs} matched pairs found before")
    else:
        progress.note("the matches of the interrupted run are damaged: starting over")
        for damaged in folder.glob("matches-*"):
            damaged.unlink()
    return database


def _run_child(
    config: Config, photos: "Sequence[Photo]", images: Path, folder: Path, database: Path, progress: Progress
) -> dict[str, Any]:
    """Do the work in stages/sfm_child.py and hand back its result. Raises StageError if the child does not end well."""
    job = {
        "folder": str(folder.absolute()),
        "images": str(images.absolute()),
        "database": str(database.absolute()),
        "photos": [asdict(photo) for photo in photos],
        **config.model_dump(include={"seed", "max_image_size", "max_features", "camera_model"}),
    }
    latest: dict[str, Any] = {"phase": "features", "database": job["database"], "done": 0, "again": ""}
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
        raise _child_failed(code, config.max_seconds if late else None, latest["phase"], log)
    return latest["result"]


def _start_child(stderr: Any) -> "subprocess.Popen[bytes]":
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, *CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        # COLMAP parallelises over photos and pairs by itself; threads inside its linear algebra would let
        # roundings depend on the number of cores and on what else the machine does.
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
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
        return "adjusting all cameras and points together", PHASES[phase][0]
    features, pairs = count_done(Path(latest["database"]))  # the first of mapping's steps places two photos
    done, total, words = {
        "features": (features, photos, "features of {} of {} photos"),
        "matching": (pairs, photos * (photos - 1) // 2, "matched {} of {} pairs of photos"),
        "mapping": (latest["done"] and min(latest["done"] + 1, photos), photos, "placed {} of {} photos"),
    }[phase]
    begin, length = PHASES[phase + latest["again"]]
    return words.format(done, total) + latest["again"], begin + length * done / total


def _child_failed(code: int, limit: float | None, phase: str, log: Path) -> StageError:
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    last = lines[-1].strip() if lines else "it left no message"
    where = f"while {phase}" if phase != "features" else "while finding features"
    if limit is not None:
        return StageError(
            f"structure-from-motion was given up {where}",
            f"it took longer than {limit:g} s",
            "Give it longer with --sfm.max-seconds, or fewer photos; matches found so far are kept.",
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
