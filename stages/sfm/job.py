"""The job of the worker process and its state: what the parent asks for, what the strategies share, the time spent; how
a worker ends with its parent, and the next one waits for that."""

import ctypes
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import FileLock

from stages.io.files import write_durably
from stages.io.photos import Photo
from stages.sfm.colmap.database.features import Features, image_similarity, read_vocabulary
from stages.sfm.colmap.database.files import keep_open
from stages.sfm.colmap.database.images import NO_TURNS, turns_of_cameras
from stages.sfm.pairs import MAX_EXHAUSTIVE, Matcher
from stages.sfm.pairs.image_retrieval import CELLS
from stages.sfm.pairs.pair_selection import SimilarityMatrix
from stages.sfm.registration import MIN_MODEL_POINTS, MIN_REGISTERED
from stages.sfm.retry_strategies import MAX_SECONDS_LIMIT, STRATEGIES, TIME_GIVEN, Outcome, StrategyLog, read_kept

PHASE_SECONDS = "phase_seconds.json"
PR_SET_PDEATHSIG = 1  # of prctl(2)
SAVE_INTERVAL_SECONDS = 5.0  # whatever ends the process takes no more than these with it

Send = Callable[..., None]
"""Sends a message to the parent, its parts as keywords."""


@dataclass(frozen=True)
class Job:
    """What the parent asks for; ``photos`` are Photos as dicts in order of ``file``. ``folder`` gets ``sparse/``.

    ``camera_model`` None: SIMPLE_RADIAL for mapping, and in the end the one chosen by held-out observations.
    ``cluster``: the address of the one that extracts and matches features; None: this machine.
    """

    folder: str
    images: str
    database: str
    photos: list[dict[str, Any]]
    seed: int
    max_image_size: int
    max_features: int
    camera_model: str | None
    camera_params: list[float] | None
    matcher: Matcher
    neighbours: int
    max_strategies: int
    seconds: float | None
    max_seconds: float
    cluster: str | None = None


class JobState:
    """What the strategies share: the photos (numbered from 0, in order of ``file``), their pairs, the log."""

    def __init__(self, job: Job, send: Send) -> None:
        self.job, self.send = job, send
        self.photos = [Photo(**photo) for photo in job.photos]
        self.files = [photo.image_name for photo in self.photos]
        self.turns = NO_TURNS if job.camera_params else turns_of_cameras(self.photos)
        self.database, self.images = Path(job.database), Path(job.images)
        self.log = StrategyLog(Path(job.folder, "strategies"))
        self.held = keep_open(self.database)  # the parent reads in it how far we are
        self.timer, self.started = PhaseTimer(self.log.folder / PHASE_SECONDS), time.monotonic()
        self.strategy = STRATEGIES[0].name
        self.seconds: dict[str, float] = {}  # of this strategy's phases
        self._features: tuple[Path, Features] | None = None
        # Where pairs were chosen there are matches in plenty: mapping works on the best of them.
        self.thinned = len(self.photos) > MAX_EXHAUSTIVE

    def begin(self, phase: str, **more: Any) -> None:
        """Say that a phase begins. Of an interrupted run features and matches are kept, while mapping starts again."""
        if database := more.get("database"):
            self.held = keep_open(Path(database))
        if phase == "mapping":
            self._features = None  # nothing compares them again, and mapping needs memory
        self.timer.begin(f"{self.strategy}: {phase}", from_zero=phase == "mapping")
        self.send(phase=phase, **more)

    def end(self, phase: str) -> None:
        """Note what the phase took, in earlier runs too."""
        self.seconds[phase] = self.timer.end()

    def left_at_most(self) -> float:
        """Seconds until sfm is given up, in this run."""
        return self.started + self.job.max_seconds - time.monotonic()

    def left(self) -> tuple[float, str]:
        """Seconds that further strategies may take, and which limit says so: the time it is given, which is for all
        runs together, or the time after which it is given up, which counts from zero in each run."""
        limits = {
            TIME_GIVEN: (self.job.seconds or math.inf) - self.timer.earlier,
            MAX_SECONDS_LIMIT: self.job.max_seconds,
        }
        limit = min(limits, key=limits.__getitem__)
        return self.started + limits[limit] - time.monotonic(), limit

    def features(self, database: Path) -> Features:
        """How the features of a database are compared where pairs are chosen; kept from one round to the next."""
        if self._features is None or self._features[0] != database:
            words = read_vocabulary(self.database, len(self.photos), self.job.seed, CELLS)
            self._features = database, Features(words)
        return self._features[1]

    @cached_property
    def similarity(self) -> SimilarityMatrix:
        """How similar any two photos are."""
        return image_similarity(self.database, len(self.photos), self.job.seed)

    def missing(self) -> list[int]:
        """The photos that are not registered in the best model so far; all where it does not fit its matches."""
        best = self.usable()
        registered = set(best.groups[0]) if best and best.fits else set()
        return [number for number, file in enumerate(self.files) if file not in registered]

    def sibling(self, name: str) -> Path:
        """Another database in the folder of the first."""
        return self.database.with_name(f"{self.database.stem}-{name}.db")

    def usable(self) -> Outcome | None:
        """The best outcome, if its model is good enough to go on with."""
        best = self.log.best()
        good = best and len(best.groups[0]) >= MIN_REGISTERED and best.points >= MIN_MODEL_POINTS
        return best if good else None

    def latest(self) -> Path:
        """The database of the best outcome; as long as there is no model, the latest without fisheye cameras."""
        plain = [outcome for outcome in self.log.outcomes if outcome.name != "fisheye"]
        return self.database.with_name((self.usable() or plain[-1]).database)


class PhaseTimer:
    """Seconds of each phase and of everything together, those of earlier runs with the same file included.

    ``earlier``: the seconds of all runs before this one.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._lock = file, threading.Lock()
        self.total, self.phases = read_kept(file) or (0.0, {})
        self.earlier: float = self.total
        self._phase: str | None = None
        self._counted = time.monotonic()

    def begin(self, phase: str, from_zero: bool) -> None:
        """A phase begins; unless it begins ``from_zero``, it goes on where an earlier run left it."""
        with self._lock:
            self._count()
            self._phase = phase
            if from_zero:
                self.phases[phase] = 0.0

    def end(self) -> float:
        """The phase is over: the seconds that it took."""
        with self._lock:
            self._count()
            assert self._phase, "one has begun"
            phase, self._phase = self._phase, None
            return self.phases[phase]

    def save(self) -> None:
        """Write down what was counted until now."""
        with self._lock:
            self._count()
            write_durably(self.file, json.dumps([self.total, self.phases]).encode())

    def save_regularly(self) -> None:
        """Write it down again and again, as long as the process lives."""
        threading.Thread(target=self._save_regularly, daemon=True).start()

    def _save_regularly(self) -> None:
        while True:
            time.sleep(SAVE_INTERVAL_SECONDS)
            with suppress(OSError):  # a full disk is reported by those whose files matter
                self.save()

    def _count(self) -> None:
        now = time.monotonic()
        passed, self._counted = now - self._counted, now
        self.total += passed
        if self._phase is not None:
            self.phases[self._phase] = self.phases.get(self._phase, 0.0) + passed


def worker_lock(folder: Path) -> FileLock:
    """Held by a worker process as long as it works in this folder. It may outlive its parent for a while, and two at
    work would write the same files."""
    return FileLock(folder / "worker.lock")


def end_with_parent() -> None:
    """End this process when stdin does: the parent is gone. Native code that holds the interpreter, as bundle
    adjustment does for seconds or minutes, delays that; Linux does not wait for it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    while os.read(0, 1):
        pass
    os._exit(1)
