"""How long a study has taken so far, over all its attempts: one that was killed costs time like any other."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.files import read_json, write_durably

BEAT = 5.0  # seconds between what is kept: whatever ends the program takes no more than these with it


@contextmanager
def counted(file: Path) -> Iterator[Callable[[], float]]:
    """Yields a function that tells the seconds within this block, those of earlier attempts with the same ``file``
    included."""
    earlier, started, over = read_json(file) if file.exists() else 0.0, time.monotonic(), threading.Event()

    def spent() -> float:
        return earlier + time.monotonic() - started

    def keep() -> None:
        write_durably(file, json.dumps(round(spent(), 3)).encode())

    def beat() -> None:
        while not over.wait(BEAT):
            with suppress(OSError):  # a full disk is said by those whose files matter
                keep()

    watcher = threading.Thread(target=beat, daemon=True)
    watcher.start()
    try:
        yield spent
    finally:
        over.set()
        watcher.join()
        with suppress(OSError):
            keep()
