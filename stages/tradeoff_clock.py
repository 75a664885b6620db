"""How long a study has taken so far, over all its attempts: one that was killed costs time like any other."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.files import read_json, write_durably
from stages.periodically import periodically

BEAT = 5.0  # seconds between what is kept: whatever ends the program takes no more than these with it


@contextmanager
def counted(file: Path) -> Iterator[Callable[[], float]]:
    """Yields a function that tells the seconds within this block, those of earlier attempts with the same ``file``
    included."""
    earlier, started = read_json(file) if file.exists() else 0.0, time.monotonic()

    def spent() -> float:
        return earlier + time.monotonic() - started

    def keep() -> None:
        with suppress(OSError):  # a full disk is said by those whose files matter
            write_durably(file, json.dumps(round(spent(), 3)).encode())

    try:
        with periodically(BEAT, keep):
            yield spent
    finally:
        keep()
