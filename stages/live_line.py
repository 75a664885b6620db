"""Live lines: one that keeps moving while a long step computes, and numbers short enough for it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from stages.contract import Progress

PERIOD_SECONDS = 0.5


@contextmanager
def live_line(progress: Progress, describe: Callable[[], tuple[str, float | None]]) -> Iterator[None]:
    """While the block runs, say twice a second what ``describe`` answers: (message, finished share or None).

    ``describe`` is called from another thread; what it reads may change under it but must not be taken apart.
    """
    over = threading.Event()

    def speak() -> None:
        while not over.wait(PERIOD_SECONDS):
            progress.update(*describe())

    thread = threading.Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        progress.update(*describe())


def short_count(count: float) -> str:
    """``950``, ``9.4 k``, ``24 k``, ``2.4 M``: a count at a glance."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if count >= size:
            return f"{count / size:.{0 if count >= 10 * size else 1}f} {unit}"
    return f"{count:.0f}"


def duration(seconds: float) -> str:
    """``0.4 s``, ``58 s``, ``3 min 20 s``, ``1 h 5 min``: seconds as people say them."""
    if seconds < 9.95:
        return f"{seconds:.1f} s".replace(".0 s", " s")
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    big, small, units = (
        (whole // 60, whole % 60, ("min", "s")) if whole < 3600 else (whole // 3600, whole % 3600 // 60, ("h", "min"))
    )
    return f"{big} {units[0]} {small} {units[1]}" if small else f"{big} {units[0]}"
