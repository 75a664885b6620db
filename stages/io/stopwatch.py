"""How long work has taken so far, over all its attempts, one that was killed too; a live line that moves meanwhile.

A killed program cannot say when it died. What it last wrote down does, by the machine's own running time: the times of
files are those of a clock that can be put forward or back, of a machine that slept, or of a copy of the files.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.contract import Progress
from stages.io.files import write_durably

BEAT = 5.0  # seconds between what is written: whatever ends the program takes no more than these with it
LIVE_PERIOD = 0.5  # seconds between two live lines


def elapsed(file: Path) -> float:
    """Seconds of all attempts with ``file``, as far as these were written; 0 where it holds no number."""
    try:
        return max(0.0, float(json.loads(file.read_bytes())))
    except (OSError, ValueError, TypeError):
        return 0.0


def write_elapsed(file: Path, seconds: float) -> None:
    """Have ``file`` hold so many seconds. Raises OSError where it cannot be written."""
    write_durably(file, json.dumps(round(seconds, 3)).encode())


@contextmanager
def counting(file: Path) -> Iterator[Callable[[], float]]:
    """Yields a function that tells the seconds within this block, those of earlier attempts with the same ``file``
    included."""
    earlier, started = elapsed(file), time.monotonic()

    def spent() -> float:
        return earlier + time.monotonic() - started

    def beat() -> None:
        with suppress(OSError):  # a full disk is said by those whose files matter
            write_elapsed(file, spent())

    try:
        with periodically(BEAT, beat):
            yield spent
    finally:
        beat()


@contextmanager
def periodically(seconds: float, act: Callable[[], object]) -> Iterator[None]:
    """Call ``act`` every ``seconds`` as long as the block runs, and not once after it; from another thread."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(seconds):
            act()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def live_line(progress: Progress, describe: Callable[[], tuple[str, float | None]]) -> Iterator[None]:
    """While the block runs, say twice a second what ``describe`` answers: (message, finished share or None).

    ``describe`` is called from another thread; what it reads may change under it but must not be taken apart.
    """

    def speak() -> None:
        progress.update(*describe())

    try:
        with periodically(LIVE_PERIOD, speak):
            yield
    finally:
        speak()
