"""Global mapping (GLOMAP, Pan et al. 2024) of the same matches, in a process of its own: it has no limit itself.

It estimates all poses together, incremental mapping one after the other, so they go wrong in different ways. To compare
with, it works on fewer tracks, on a core that incremental mapping leaves free. ``python -P -m
stages.sfm.global_mapping`` reads a job from stdin as one line of JSON, and writes its models into its folder.
"""

import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from stages.io.amounts import rough_duration
from stages.sfm.colmap.database.thinning import thin_matches
from stages.sfm.colmap.mappers import map_globally
from stages.sfm.colmap.models import load_native, write_native
from stages.sfm.job import end_with_parent
from stages.sfm.worker_process import environment

TRACKS_PER_PHOTO = 200  # of the best: enough for poses that are compared, not kept
# Where it takes so many times as long as incremental mapping, it will not end either.
MAX_TIMES, MIN_SECONDS = 4.0, 60.0
MIN_PHOTOS = 10  # of fewer there is no telling which of two models is right
COMMAND = ["-P", "-m", "stages.sfm.global_mapping"]


class Started(NamedTuple):
    """Global mapping that is running; its models come into ``folder``."""

    process: "subprocess.Popen[bytes]"
    folder: Path
    began: float  # time.monotonic()


def start(
    database: Path, thinned: Path | None, images: Path, folder: Path, seed: int, camera_is_known: bool
) -> Started:
    """Begin with the matches of ``database``, or the best of them, copied to ``thinned``; the caller waits with
    :func:`failure`.

    It ends with this process.
    """
    shutil.rmtree(folder, ignore_errors=True)
    paths = {"database": database, "thinned": thinned, "images": images, "folder": folder}
    job = {name: path and str(path) for name, path in paths.items()} | {"seed": seed}
    process = subprocess.Popen([sys.executable, *COMMAND], stdin=subprocess.PIPE, stdout=2, env=environment())
    assert process.stdin
    process.stdin.write(json.dumps(job | {"camera_is_known": camera_is_known}).encode() + b"\n")
    process.stdin.flush()  # and left open: its end tells the process that this one is gone
    return Started(process, folder, time.monotonic())


def failure(started: Started, seconds: float) -> str | None:
    """Wait until it is done, or so many ``seconds`` at most: why there is no model, None if there is one."""
    try:
        code = started.process.wait(max(0.0, seconds))
    except subprocess.TimeoutExpired:
        started.process.kill()
        started.process.wait()
        return f"it was given up after {rough_duration(time.monotonic() - started.began)}"
    if code == 0 and started.folder.exists():
        return None
    return f"it ended with code {code}" if code else "it found no model"


def found_models(started: Started) -> list[Any]:
    """All sub-models, best first, where there is no :func:`failure`."""
    return [load_native(folder) for folder in sorted(started.folder.iterdir(), key=lambda one: int(one.name))]


def patience(started: Started, mapping_seconds: float) -> float:
    """For how many seconds to wait for it, where incremental mapping took so many."""
    return max(MIN_SECONDS, MAX_TIMES * mapping_seconds) - (time.monotonic() - started.began)


def main() -> None:
    """Read the job from stdin, do it."""
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=end_with_parent, daemon=True).start()
    folder, database, known = Path(job["folder"]), Path(job["database"]), job["camera_is_known"]
    if job["thinned"]:
        thin_matches(database, thinned := Path(job["thinned"]), TRACKS_PER_PHOTO, camera_is_known=known)
        database = thinned
    scratch = folder.with_name(f"{folder.name}.scratch")
    models = map_globally(database, Path(job["images"]), scratch, job["seed"], known)
    shutil.rmtree(scratch, ignore_errors=True)
    for number, model in enumerate(models):
        write_native(folder / str(number), model)


if __name__ == "__main__":
    main()
