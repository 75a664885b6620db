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
from itertools import count
from pathlib import Path
from typing import Any

from stages.colmap.mapping import MAPPING_MODEL, map_incrementally, rank
from stages.colmap.matching import copy_without_matches_of, extract_features, fill_database, match_exhaustively
from stages.colmap.refinement import finish
from stages.photos import Photo

# Lowe's ratio: 0.8 is SIFT's own. 0.9 lets in many mismatches, most of which verification throws out again, and
# finds views that lie farther apart; only photos that otherwise stay without a place are matched like that.
STRICT_RATIO = 0.8
LOOSE_RATIO = 0.9

Say = Callable[..., None]


@dataclass(frozen=True)
class Job:
    """What the parent asks for; ``photos`` are Photos as dicts in order of ``file``. ``folder`` gets ``sparse/``.

    ``camera_model`` None: SIMPLE_RADIAL for mapping, and in the end what held-out observations speak for.
    """

    folder: str
    images: str
    database: str
    photos: list[dict[str, Any]]
    seed: int
    max_image_size: int
    max_features: int
    camera_model: str | None


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
    best: its ``points``, mean ``reprojection_px``, ``camera_model``, the comparison of ``camera_models``, and by file
    ``observations`` and ``uncertainty_px``.
    """
    database, images = Path(job.database), Path(job.images)
    photos = [Photo(**photo) for photo in job.photos]
    say(phase="features")
    fill_database(database, photos, job.camera_model or MAPPING_MODEL)
    extract_features(database, images, photos, job.max_image_size, job.max_features)
    mapped = _match_and_map(job, database, STRICT_RATIO, say)
    placed = _files(mapped[0]) if mapped else []
    missing = {file for photo in photos if (file := photo.file.removeprefix("images/")) not in placed}
    if missing:
        say(note=f"{len(missing)} of {len(photos)} photos found no place: matching them again, less strictly")
        loose = database.with_name(f"{database.stem}-loose.db")
        copy_without_matches_of(missing, database, loose)
        again = _match_and_map(job, loose, LOOSE_RATIO, say)
        if again and (not mapped or rank(again[0]) > rank(mapped[0])):
            mapped, database = again, loose
    if not mapped:
        return {"database": str(database), "models": []}
    say(phase="refining")
    finished = finish(mapped[0], database, job.seed, job.camera_model)
    for note in finished.notes:
        say(note=note)
    model = finished.model
    registered = [model.image(i) for i in sorted(model.reg_image_ids())]
    sparse = Path(job.folder, "sparse")
    sparse.mkdir(exist_ok=True)
    model.write_binary(sparse)
    return {
        "database": str(database),
        "models": [_files(m) for m in (model, *mapped[1:])],
        "observations": {image.name: image.num_points3D for image in registered},
        "uncertainty_px": finished.uncertainty_px,
        "points": model.num_points3D(),
        "reprojection_px": model.compute_mean_reprojection_error(),
        "camera_model": "/".join(sorted({model.camera(image.camera_id).model_name for image in registered})),
        "camera_models": finished.camera_models,
    }


def _match_and_map(job: Job, database: Path, max_ratio: float, say: Say) -> list[Any]:
    """All sub-models that come of matching so strictly, best first."""
    say(phase="matching", database=str(database), again=" again" if max_ratio == LOOSE_RATIO else "")
    match_exhaustively(database, job.seed, max_ratio)
    say(phase="mapping", done=0)
    placed = count(1)
    models = Path(job.folder, "models")
    mapped = map_incrementally(
        database, Path(job.images), models, job.seed, lambda: say(phase="mapping", done=next(placed))
    )
    shutil.rmtree(models)
    return mapped


def _files(model: Any) -> list[str]:
    return sorted(model.image(i).name for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
