"""Work for the tests of a cluster, in a module that its machines can import."""

import os
import signal
import time
from pathlib import Path

from stages.contract import StageError


def power(exponent: int, item: int) -> int:
    """``item`` to the ``exponent``."""
    return item**exponent


def fail(item: int) -> int:
    """As work fails for a reason that a user can act on."""
    raise StageError("tests.failed", f"item {item}", "it always does", "Try nothing.")


def die_once(folder: Path, item: int) -> int:
    """Kills its process where it is called with 2 for the first time."""
    if item == 2 and not (marker := Path(folder, "died")).exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def die(item: int) -> int:
    """Kills its process each time."""
    os.kill(os.getpid(), signal.SIGKILL)
    return item


def wait(seconds: float) -> None:
    """Takes that long."""
    time.sleep(seconds)


def stay(folder: Path, item: int) -> None:
    """Says which process it is in, and takes long."""
    Path(folder, "unfinished").write_text(str(os.getpid()))
    Path(folder, "unfinished").rename(Path(folder, f"{item}.pid"))
    time.sleep(600)
