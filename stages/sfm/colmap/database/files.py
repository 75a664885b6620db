"""COLMAP's database as a file: others read along while it is written, and copies are there whole or not at all."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pycolmap

OPENINGS, PAUSE_SECONDS = 50, 0.1  # a reader holds the lock for milliseconds


def keep_open(database: Path) -> pycolmap.Database:
    """A connection to keep for as long as another process reads along.

    Whoever opens the database first or closes it last has to be alone in it, and COLMAP does not wait for that: it
    fails. With this connection there no other one is the first or the last. Raises RuntimeError where it cannot be
    opened for seconds.
    """
    for _ in range(OPENINGS - 1):
        with suppress(RuntimeError):
            return pycolmap.Database.open(database)
        time.sleep(PAUSE_SECONDS)
    return pycolmap.Database.open(database)


@contextmanager
def changed_copy(database: Path, copy: Path) -> Iterator[pycolmap.Database]:
    """As :func:`unfinished_copy`, open, and changed in one transaction."""
    with (
        unfinished_copy(database, copy) as unfinished,
        pycolmap.Database.open(unfinished) as db,
        pycolmap.DatabaseTransaction(db),
    ):
        yield db


@contextmanager
def unfinished_copy(database: Path, copy: Path) -> Iterator[Path]:
    """A copy of a database, to be changed beside ``copy``, which it becomes at the end; where that is not reached there
    is no ``copy``, or it is as it was."""
    unfinished = copy.with_suffix(".unfinished")
    copy_database(database, unfinished)
    yield unfinished
    # The log of an earlier copy, which a process that was killed leaves behind, would be read as if it were this one's.
    for part in ("-wal", "-shm"):
        copy.with_name(copy.name + part).unlink(missing_ok=True)
    unfinished.replace(copy)


def copy_database(database: Path, copy: Path) -> None:
    """Copy a database as it is, also one that is in use."""
    for part in ("", "-wal"):  # as long as anybody reads along, the latest pages stay in the write-ahead log
        copy.with_name(copy.name + part).unlink(missing_ok=True)
        if (source := database.with_name(database.name + part)).exists():
            shutil.copyfile(source, copy.with_name(copy.name + part))
