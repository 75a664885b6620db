"""A live line that keeps moving while a long step computes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from stages.contract import Progress
from stages.io.stopwatch import periodically

PERIOD_SECONDS = 0.5


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
