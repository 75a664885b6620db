"""What a running training shows to whoever watches, and what they may ask of it: the files in ``live/`` of its folder.

A watcher (pipeline/view) touches WATCHED while a page is open. Only then does the training write: STATE every
POLL_SECONDS, SCENE once, and the field every SNAPSHOT_SECONDS or as rarely as MAX_FRACTION of the time demands, both
as the page reads them: a watcher need not load what packs them, which takes seconds on cores that train. Where FINISH
lies the training is to end early. Neither side waits for the other, and either may die at any time: files appear
whole, and of all that lies here training reads nothing but that FINISH is there.
"""

import math
import os
import secrets
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from stages.contract import StageError
from stages.io.files import write_json

LIVE, WATCHED, FINISH, STATE = "live", "watched", "finish", "state.json"
SCENE, FIELD = "scene.bin", "field.bin"  # beside STATE, and in the folder of each snapshot
POLL_SECONDS = 1.0  # between two looks at WATCHED: two system calls, all that a training nobody watches pays
FORGET_SECONDS = 5.0  # after the last touch nobody is there any more
SNAPSHOT_SECONDS = 4.0  # between two fields that are written, at least
MAX_FRACTION = 0.01  # of a watched training's time that goes into them
KEPT = 2  # fields: the one that is read may be the last but one


class LiveFolder:
    """``live/`` in the ``folder`` of a training. ``save(folder)`` writes FIELD as it is now, and SCENE beside it."""

    def __init__(self, folder: Path, save: Callable[[Path], None]) -> None:
        self.root, self.save = folder / LIVE, save
        self.next_poll = self.next_snapshot = 0.0  # by time.monotonic
        self.touched, self.watched_until = 0.0, -math.inf
        self.snapshots: list[Path] = []
        self.root.mkdir(exist_ok=True)
        for path in self.root.iterdir():  # what a killed training left, except that it was asked to finish
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != FINISH:
                path.unlink()
        watched = self.root / WATCHED
        watched.touch()
        self.touched = watched.stat().st_mtime

    @property
    def is_asked_to_finish(self) -> bool:
        """Whether a watcher wants the training to end."""
        return (self.root / FINISH).exists()

    def is_watched(self) -> bool:
        """Whether anybody watches. By how WATCHED changes, not by what its time is: clocks may differ."""
        now = time.monotonic()
        self.next_poll = now + POLL_SECONDS
        with suppress(OSError):  # a user may have deleted it
            if (touched := (self.root / WATCHED).stat().st_mtime) != self.touched:
                self.touched, self.watched_until = touched, now + FORGET_SECONDS
        return now < self.watched_until

    def show(self, state: dict[str, Any]) -> None:
        """Write ``state`` with the name of the latest field, and that field if it is due. Nothing here ends a training:
        a full disk is said by those whose files matter, a figure that is not finite by the loop, a field that no page
        shows by stage viewer."""
        if time.monotonic() >= self.next_snapshot:
            with suppress(OSError, ValueError, StageError):
                self._save_field()
        with suppress(OSError, ValueError):
            temporary = self.root / f"{STATE}.tmp"
            write_json(temporary, state | {"field": self.snapshots[-1].name if self.snapshots else None})
            temporary.replace(self.root / STATE)

    def _save_field(self) -> None:
        """A field that cannot be written whole leaves nothing behind, and is no reason to try again sooner."""
        started, folder = time.monotonic(), self.root / secrets.token_hex(8)
        try:
            folder.mkdir()
            self.save(folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            now = time.monotonic()
            self.next_snapshot = now + max(SNAPSHOT_SECONDS, (now - started) / MAX_FRACTION)
        self.snapshots.append(folder)
        while len(self.snapshots) > KEPT:
            shutil.rmtree(self.snapshots.pop(0), ignore_errors=True)

    def close(self) -> None:
        """The training has ended. Under another name first: then no watcher can add to it while it is removed."""
        gone = self.root.with_name(f"{LIVE}.gone")
        shutil.rmtree(gone, ignore_errors=True)
        with suppress(OSError):
            self.root.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


def touch(folder: Path) -> bool:
    """Say to the training in ``folder`` that somebody watches; False where none runs there."""
    try:
        os.utime(folder / LIVE / WATCHED)
    except OSError:  # also one of another user
        return False
    return True


def ask_to_finish(folder: Path) -> bool:
    """Ask the training in ``folder`` to end early; False where none runs there."""
    try:
        (folder / LIVE / FINISH).touch()
    except OSError:
        return False
    return True
