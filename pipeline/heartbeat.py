"""A sign of life every few seconds while a stage is at work, so that what a kill takes with it counts to its end.

A killed program cannot say when it died; the last file that it wrote tells, and many stages write theirs at the end.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

BEAT = 5.0  # seconds between signs: a kill hides no more than these
NAME = ".alive"  # in the workspace: what is touched while a stage plans, which has no folder of its own yet


@contextmanager
def beating(file: Path) -> Iterator[None]:
    """Touch ``file`` every BEAT seconds as long as the block runs, and not once after it."""
    over = threading.Event()
    thread = threading.Thread(target=_beat, args=(file, over), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _beat(file: Path, over: threading.Event) -> None:
    while not over.wait(BEAT):
        with suppress(OSError):  # a full disk is said by those whose files matter
            file.touch()
