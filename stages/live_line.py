"""A live line that keeps moving while a long step computes."""

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
