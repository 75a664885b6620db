"""The child process of stage sfm from outside: starting it, what is on the screen meanwhile, and every way it can end.

What it does is in stages/sfm/worker.py.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from stages.contract import Progress, StageError
from stages.io.live_line import live_line
from stages.sfm.retry_strategies import ATTEMPTS, OUT_OF_TIME, abandon

if TYPE_CHECKING:
    from stages.io.photos import Photo
    from stages.sfm import Config

# The share of the first attempt where a phase begins, and how long it is (measured on 11 to 50 photos, two cores).
PHASES = {"features": (0.0, 0.35), "matching": (0.35, 0.5), "mapping": (0.85, 0.15)}
FIRST_ATTEMPT, REFINING = 0.7, 0.95  # where they end and begin in the whole
FULL_DISK = 1 << 22  # bytes: less than the smallest of COLMAP's files that may have found no room
CHILD = ["-P", "-m", "stages.sfm.worker"]  # -P: nothing that lies in the current folder is taken for a module


def run_child(
    config: "Config", photos: "Sequence[Photo]", images: Path, folder: Path, database: Path, progress: Progress
) -> dict[str, Any]:
    """Do the work in stages/sfm/worker.py and hand back its result. Raises StageError if the child does not end
    well."""
    job = {
        "folder": str(folder.absolute()),
        "images": str(images.absolute()),
        "database": str(database.absolute()),
        "photos": [asdict(photo) for photo in photos],
        **config.model_dump(exclude={"cameras"}),
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
        limit = config.max_seconds if late else None
        last = latest.get("fault") or _last_words(log)
        raise _child_failed(code, limit, latest["phase"], last, _without(latest["attempt"], code, late, log), log)
    return latest["result"]


def _without(attempt: str, code: int, late: bool, log: Path) -> str | None:
    """The hint to run again without the attempt that failed, which is noted; None for the first: it is always made."""
    if attempt == ATTEMPTS[0].name or not (late or code):
        return None
    # Also where it was killed: most often for want of memory, and then it would be every time.
    became = "was killed, most often for want of memory" if code == -signal.SIGKILL else "ended the program"
    abandon(log.parent / "attempts", attempt, OUT_OF_TIME if late else became)
    return f"Run again: it goes on without the attempt {attempt!r}. Log: {log}"


def _start_child(stderr: IO[bytes]) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, *CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=environment(),
        start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends the child
    )


def environment() -> dict[str, str]:
    """Of a child process in which COLMAP runs."""
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
    # Work is divided by photos and pairs; threads inside linear algebra would let roundings depend on the number of
    # cores and on what else the machine does.
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def _hand_over(stdin: IO[bytes], job: dict[str, Any]) -> None:
    """Write the job and leave the pipe open: its end tells the child that the parent is gone."""
    try:
        stdin.write(json.dumps(job).encode() + b"\n")
        stdin.flush()
    except BrokenPipeError:  # the child died at once; its exit code says how
        return


def _describe(latest: Mapping[str, Any], photos: int) -> tuple[str, float | None]:
    """The live line and the finished share of the whole."""
    from stages.sfm.registration import count_done

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


def _last_words(log: Path) -> str:
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    return lines[-1].strip() if lines else "it left no message"


def _child_failed(code: int, limit: float | None, phase: str, last: str, without: str | None, log: Path) -> StageError:
    """``last``: what the child said at last; ``without``: the hint where running again goes on without the attempt that
    failed."""
    free = shutil.disk_usage(log.parent).free
    if free < FULL_DISK:  # COLMAP and its database say it in words of their own, or do not notice
        last += f"; the disk has only {free / 2**20:.1f} MB free: No space left on device"
    where = f"while {phase}" if phase != "features" else "while finding features"
    if limit is not None:
        return StageError(
            "sfm.timeout",
            f"structure-from-motion was given up {where}",
            f"it took longer than {limit:g} s",
            without or "Give it longer with --sfm.max-seconds, or fewer photos; matches found so far are kept.",
        )
    if code < 0:
        name = signal.Signals(-code).name
        memory = code == -signal.SIGKILL
        return StageError(
            "sfm.worker-killed",
            f"structure-from-motion was ended by {name} {where}",
            "most often the machine ran out of memory" if memory else f"COLMAP failed inside ({last})",
            without or f"Run again: what was matched is kept. With less memory: --sfm.max-features 2048. Log: {log}",
        )
    return StageError(
        "sfm.worker-failed", f"structure-from-motion failed {where}", last, without or f"The whole log is in {log}"
    )
