"""A sign of life every few seconds while a stage is at work, so that what a kill takes with it counts to its end.

A killed program cannot say when it died; the last file that it wrote tells, and many stages write theirs at the end.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.periodically import periodically

BEAT = 5.0  # seconds between signs: a kill hides no more than these
NAME = ".alive"  # in the workspace: what is touched while a stage plans, which has no folder of its own yet


@contextmanager
def beating(file: Path) -> Iterator[None]:
    """Touch ``file`` every BEAT seconds as long as the block runs, and not once after it."""

    def beat() -> None:
        with suppress(OSError):  # a full disk is said by those whose files matter
            file.touch()

    with periodically(BEAT, beat):
        yield
