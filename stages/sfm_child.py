"""The child process of stage sfm: all of structure-from-motion, away from the program that the user talks to.

COLMAP is native code that may abort or hang; here that ends one process and nothing else. The parent writes one line
of JSON (a :class:`Job`) to stdin and keeps stdin open: its end means that the parent is gone, and so this process
goes too. Messages to the parent are lines of JSON on stdout; whatever COLMAP prints goes to stderr, the log.
"""

import json
import os
import shutil
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

from stages.colmap.mapping import MAPPING_MODEL, map_incrementally, rank
from stages.colmap.matching import (
    LOOSE_RATIO,
    STRICT_RATIO,
    copy_without_matches_of,
    extract_features,
    fill_database,
    look_alike,
    match_pairs,
)
from stages.colmap.refinement import finish
from stages.matching_plan import about, places_of
from stages.pairing import Pairs, pairs_of, second_look
from stages.photos import Photo
from stages.sfm import Matcher

Say = Callable[..., None]


@dataclass(frozen=True)
class Job:
    """What the parent asks for; ``photos`` are Photos as dicts in order of ``file``. ``folder`` gets ``sparse/``.

    ``camera_model`` None: SIMPLE_RADIAL for mapping, and RADIAL in the end where there is enough to go by.
    """

    folder: str
    images: str
    database: str
    photos: list[dict[str, Any]]
    seed: int
    max_image_size: int
    max_features: int
    camera_model: str | None
    matcher: Matcher
    neighbours: int


def main() -> None:
    """Read the job from stdin, do it, say the result."""
    job = Job(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # nothing else may write on the channel

    def say(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")

    say(result=reconstruct(job, say))


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def reconstruct(job: Job, say: Say) -> dict[str, Any]:
    """Run structure-from-motion and write the best sub-model to ``sparse/``; nothing if none came out.

    Returns the ``database`` that was used in the end, the files in each sub-model, best first (``models``), and of the
    best: its ``points``, ``observations`` by file, mean ``reprojection_px``, ``camera_model``, and how many
    ``vague_cameras`` kept their principal points in the centre.
    """
    database, images = Path(job.database), Path(job.images)
    photos = [Photo(**photo) for photo in job.photos]
    say(phase="features")
    fill_database(database, photos, job.camera_model or MAPPING_MODEL)
    extract_features(database, images, photos, job.max_image_size, job.max_features)
    similarity = cache(lambda: look_alike(database, len(photos), job.seed))
    pairs = pairs_of(job.matcher, job.neighbours, len(photos), places_of(photos), similarity)
    mapped = _match_and_map(job, database, pairs, STRICT_RATIO, say)
    placed = _files(mapped[0]) if mapped else []
    files = [photo.file.removeprefix("images/") for photo in photos]
    missing = [number for number, file in enumerate(files) if file not in placed]
    if missing:
        say(note=f"{len(missing)} of {len(photos)} photos found no place: matching them again, less strictly")
        loose = database.with_name(f"{database.stem}-loose.db")
        copy_without_matches_of({files[number] for number in missing}, database, loose)
        pairs = second_look(pairs, missing, job.neighbours, similarity)
        again = _match_and_map(job, loose, pairs, LOOSE_RATIO, say)
        if again and (not mapped or rank(again[0]) > rank(mapped[0])):
            mapped, database = again, loose
    if not mapped:
        return {"database": str(database), "models": []}
    say(phase="refining")
    model, vague = finish(mapped[0], database, job.seed, job.camera_model is not None)
    sparse = Path(job.folder, "sparse")
    sparse.mkdir(exist_ok=True)
    model.write_binary(sparse)
    return {
        "database": str(database),
        "models": [_files(m) for m in (model, *mapped[1:])],
        "observations": {m.name: m.num_points3D for m in map(model.image, sorted(model.reg_image_ids()))},
        "points": model.num_points3D(),
        "reprojection_px": model.compute_mean_reprojection_error(),
        "camera_model": "/".join(sorted({camera.model_name for camera in model.cameras.values()})),
        "vague_cameras": len(vague),
    }


def _match_and_map(job: Job, database: Path, pairs: Pairs, max_ratio: float, say: Say) -> list[Any]:
    """All sub-models that come of matching these pairs so strictly, best first."""
    again = " again" if max_ratio == LOOSE_RATIO else ""
    say(phase="matching", database=str(database), pairs=len(pairs), again=again)
    match_pairs(database, pairs, job.seed, max_ratio, lambda left, seconds: say(note=_expected(job, left, seconds)))
    say(phase="mapping", done=0)
    placed = count(1)
    models = Path(job.folder, "models")
    mapped = map_incrementally(
        database, Path(job.images), models, job.seed, lambda: say(phase="mapping", done=next(placed))
    )
    shutil.rmtree(models)
    return mapped


def _expected(job: Job, pairs: int, seconds: float) -> str:
    count = len(job.photos)
    every = "all " if pairs == count * (count - 1) // 2 else ""
    return f"matching {every}{pairs:,} pairs of photos: about {about(seconds)}"


def _files(model: Any) -> list[str]:
    return sorted(model.image(i).name for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
