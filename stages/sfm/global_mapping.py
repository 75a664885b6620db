"""Global mapping (GLOMAP, Pan et al. 2024) of the same matches, to compare with, in a process of its own.

It estimates all poses together, incremental mapping one after the other, so they go wrong in different ways. It works
on fewer tracks, on a core that incremental mapping leaves free. ``python -P -m stages.sfm.global_mapping`` reads a job
from stdin as one line of JSON, and writes the best model into its folder.
"""

import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

from stages.io.amounts import rough_duration
from stages.io.files import make_durable
from stages.sfm.colmap.database.thinning import thin_matches
from stages.sfm.colmap.mappers import map_globally
from stages.sfm.colmap.models import write_native
from stages.sfm.job import end_with_parent
from stages.sfm.worker_process import environment

TRACKS_PER_PHOTO = 200  # of the best: enough for poses that are compared, not kept
# It works on fewer tracks than incremental mapping, on a core of its own, and has no limit itself: where it takes so
# many times as long, it will not end either.
MAX_TIMES, MIN_SECONDS = 4.0, 60.0
MIN_PHOTOS = 10  # of fewer there is no telling which of two models is right
COMMAND = ["-P", "-m", "stages.sfm.global_mapping"]


class Started(NamedTuple):
    """Global mapping that is running; its model comes into ``folder``."""

    process: "subprocess.Popen[bytes]"
    folder: Path
    began: float  # time.monotonic()


def start(database: Path, thinned: Path, images: Path, folder: Path, seed: int, camera_is_known: bool) -> Started:
    """Begin with the best matches of ``database``, copied to ``thinned``; the caller waits with :func:`failure`.

    It ends with this process.
    """
    shutil.rmtree(folder, ignore_errors=True)
    paths = {"database": database, "thinned": thinned, "images": images, "folder": folder}
    job = {name: str(path) for name, path in paths.items()} | {"seed": seed}
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


def patience(started: Started) -> float:
    """For how many seconds to wait for it, once incremental mapping is done, which began at the same time."""
    taken = time.monotonic() - started.began
    return max(MIN_SECONDS, MAX_TIMES * taken) - taken


def main() -> None:
    """Read the job from stdin, do it."""
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=end_with_parent, daemon=True).start()
    folder = Path(job["folder"])
    scratch = folder.with_name(f"{folder.name}.scratch")
    thinned = Path(job["thinned"])
    known = job["camera_is_known"]
    thin_matches(Path(job["database"]), thinned, TRACKS_PER_PHOTO, camera_is_known=known)
    models = map_globally(thinned, Path(job["images"]), scratch, job["seed"], known)
    shutil.rmtree(scratch, ignore_errors=True)
    if models:
        unfinished = folder.with_name(f"{folder.name}.unfinished")
        write_native(unfinished, models[0])
        make_durable(unfinished)
        unfinished.rename(folder)


if __name__ == "__main__":
    main()
