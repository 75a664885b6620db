"""Work beside a block of code: something repeated, or a live line that keeps moving while a long step computes."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from stages.contract import Progress

PERIOD_SECONDS = 0.5


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
        with periodically(PERIOD_SECONDS, speak):
            yield
    finally:
        speak()
