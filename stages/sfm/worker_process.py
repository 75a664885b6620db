"""The worker process of stage sfm from outside: starting it, the live line meanwhile, and every way it can end.

What it does is in stages/sfm/worker.py.
"""

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from stages.contract import Progress, StageError
from stages.hardware import cluster
from stages.hardware.child_process import child_environment
from stages.io.photos import Photo
from stages.io.stopwatch import live_line
from stages.sfm.registration import count_done
from stages.sfm.retry_strategies import STRATEGIES, Skip, abandon

if TYPE_CHECKING:
    from stages.sfm import Config

# The fraction of the first strategy where a phase begins, and how long it is (measured on 11 to 50 photos, two cores).
PHASES = {"features": (0.0, 0.35), "matching": (0.35, 0.5), "mapping": (0.85, 0.15)}
FIRST_STRATEGY, REFINING = 0.7, 0.95  # where they end and begin in the whole
MIN_FREE_BYTES = 1 << 22  # less than the smallest of COLMAP's files that may have found no room
NOT_PASSED = {"photos", "cameras", "camera_axes", "pose_direction", "adjust_poses"}  # to the worker
COMMAND = ["-P", "-m", "stages.sfm.worker"]  # -P: nothing that lies in the current folder is taken for a module


def run_worker(
    config: "Config", photos: Sequence[Photo], images: Path, folder: Path, database: Path, progress: Progress
) -> dict[str, Any]:
    """Do the work in stages/sfm/worker.py and hand back its result. Raises StageError if the worker does not end
    well."""
    job = {
        "folder": str(folder.absolute()),
        "images": str(images.absolute()),
        "database": str(database.absolute()),
        "photos": [asdict(photo) for photo in photos],
        "cluster": cluster.address(),
        **config.model_dump(exclude=NOT_PASSED),
    }
    began, log = time.monotonic(), folder / "sfm.log"
    while True:
        left = config.max_seconds - (time.monotonic() - began)
        status, late, latest = _run_once(job | {"max_seconds": left}, log, len(photos), progress)
        if error := latest.get("error"):
            raise StageError(*error)
        if "result" in latest:
            return latest["result"]
        ended = _abandon_retry(latest, status, late, log)
        if late:
            raise _timeout(config.max_seconds, latest, skipped=ended is not None)
        if ended:
            text = f"going on without the retry strategy {latest['strategy']!r}, because {ended.why}. Log: {log}"
            progress.note("sfm.strategy-crashed", text)
            continue
        raise _worker_failed(status, latest["phase"], latest.get("fault") or _last_line(log), log)


def _run_once(job: dict[str, Any], log: Path, photos: int, progress: Progress) -> tuple[int, bool, dict[str, Any]]:
    """Run the worker to its end: its exit status, whether it was late, and the latest of everything it said."""
    latest: dict[str, Any] = {"phase": "features", "database": job["database"], "done": 0, "pairs": 0}
    latest["strategy"] = STRATEGIES[0].name

    def hear(message: dict[str, Any]) -> None:
        if note := message.pop("note", None):
            progress.note(*note)
        begins = message.get("phase", latest["phase"]) != latest["phase"]
        latest.update(message)
        if begins:  # a phase may take less than the live line waits
            progress.update(*_describe(latest, photos))

    with live_line(progress, lambda: _describe(latest, photos)):
        status, late = run_child(COMMAND, log, job, job["max_seconds"], hear)
    return status, late, latest


class Ending(NamedTuple):
    """How a child process ended: its exit status, and whether it was killed because its time was over."""

    status: int
    late: bool


def run_child(
    command: Sequence[str], log: Path, job: dict[str, Any], max_seconds: float, hear: Callable[[dict[str, Any]], None]
) -> Ending:
    """Run Python with this command line, in which COLMAP works. It gets the job on stdin as a line of JSON; ``hear``
    gets each of its messages, which are such lines, too; what else it prints goes to the log. It is killed after
    ``max_seconds``."""
    with log.open("ab") as stderr:
        child = _start(command, stderr)
        overtime = threading.Timer(max_seconds, child.kill)
        overtime.start()
        assert child.stdin and child.stdout
        try:
            _hand_over(child.stdin, job)
            for line in child.stdout:
                if line.endswith(b"\n"):  # else it was killed as it wrote
                    hear(json.loads(line))
            status = child.wait()
        finally:
            late = not overtime.is_alive()
            overtime.cancel()
            child.kill()
            child.wait()
    return Ending(status, late)


def _abandon_retry(latest: Mapping[str, Any], status: int, late: bool, log: Path) -> Skip | None:
    """Note that the retry strategy in which the worker failed is not to be tried again, and why; None where none is at
    work: the first strategy is always tried, and the final adjustment belongs to all."""
    first = latest["strategy"] == STRATEGIES[0].name
    if first or latest["phase"] == "refining" or not (late or status) or _full_disk(log):
        return None
    # Also where it was killed: most often for want of memory, and then it would be every time.
    became = "was killed, most likely because memory ran out" if status == -signal.SIGKILL else "ended the program"
    ended = Skip("it ran out of time", for_time=True) if late else Skip(f"it {became}")
    abandon(log.parent / "strategies", latest["strategy"], ended)
    return ended


def _start(command: Sequence[str], stderr: IO[bytes]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, *command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=environment(),
        start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends the child
    )


def environment() -> dict[str, str]:
    """Of a child process in which COLMAP runs."""
    # Work is divided by photos and pairs; threads inside linear algebra would let roundings depend on the number of
    # cores and on what else the machine does.
    return child_environment() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def _hand_over(stdin: IO[bytes], job: dict[str, Any]) -> None:
    """Write the job and leave the pipe open: its end tells the child that the parent is gone."""
    try:
        stdin.write(json.dumps(job).encode() + b"\n")
        stdin.flush()
    except BrokenPipeError:  # the child died at once; its exit status says how
        return


def _describe(latest: Mapping[str, Any], photos: int) -> tuple[str, float | None]:
    """The live line and the finished share of the whole."""
    phase = latest["phase"]
    if phase == "refining":
        return "final bundle adjustment", REFINING
    features, pairs = count_done(Path(latest["database"]))  # the first of mapping's steps registers two photos
    done, total, words = {
        "features": (features, photos, "features of {:,} of {:,} photos"),
        "matching": (pairs, latest["pairs"], "matched {:,} of {:,} pairs of photos"),
        "mapping": (latest["done"] and min(latest["done"] + 1, photos), photos, "registered {:,} of {:,} photos"),
    }[phase]
    begin, length = PHASES[phase]
    share = begin + length * done / max(1, total)
    number = [one.name for one in STRATEGIES].index(latest["strategy"])
    if not number:
        return words.format(done, total), FIRST_STRATEGY * share
    later = (number - 1 + share) / (len(STRATEGIES) - 1)
    return f"{words.format(done, total)} ({latest['strategy']})", FIRST_STRATEGY + (REFINING - FIRST_STRATEGY) * later


def _last_line(log: Path) -> str:
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    return lines[-1].strip() if lines else "it printed no message"


def _full_disk(log: Path) -> str:
    """A remark where the disk is full, else nothing: COLMAP and its database report it in other words, or do not
    notice."""
    free = shutil.disk_usage(log.parent).free
    return f"; the disk is full, with {free / 2**20:.1f} MB free" if free < MIN_FREE_BYTES else ""


def _timeout(limit: float, latest: Mapping[str, Any], skipped: bool) -> StageError:
    """``skipped``: whether the strategy at work will not be tried again."""
    hint = "Raise --sfm.max-seconds, or give fewer photos; the matches found so far are kept."
    if skipped:
        hint = f"Run again: the strategy {latest['strategy']!r} is then skipped."
    what = f"structure from motion was stopped {_while(latest['phase'])}"
    return StageError("sfm.timeout", what, f"it took longer than {limit:g} s", hint)


def _worker_failed(status: int, phase: str, last: str, log: Path) -> StageError:
    """``last``: the last message of the worker."""
    last += _full_disk(log)
    if status < 0:
        name = signal.Signals(-status).name
        memory = status == -signal.SIGKILL
        return StageError(
            "sfm.worker-killed",
            f"structure from motion was killed by {name} {_while(phase)}",
            "the machine most likely ran out of memory" if memory else f"COLMAP crashed ({last})",
            f"Run again: the matches are kept. To use less memory: --sfm.max-features 2048. Log: {log}",
        )
    what = f"structure from motion failed {_while(phase)}"
    return StageError("sfm.worker-failed", what, last, f"The whole log is in {log}")


def _while(phase: str) -> str:
    return f"while {phase}" if phase != "features" else "while extracting features"
