"""What the steps of structure-from-motion share in its child process: the job, the photos, the journal, the clock."""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from stages.io.photos import Photo
from stages.sfm import Matcher
from stages.sfm.clock import NAME as CLOCK
from stages.sfm.clock import Clock
from stages.sfm.colmap.matching import Features, hold_open, look_alike, read_vocabulary
from stages.sfm.pairs.image_retrieval import CELLS
from stages.sfm.pairs.pair_selection import MAX_EXHAUSTIVE, Likeness
from stages.sfm.registration import FEWEST_POINTS, FEWEST_REGISTERED
from stages.sfm.retry_strategies import ATTEMPTS, GIVEN, GIVEN_UP, Journal, Tried

Say = Callable[..., None]


@dataclass(frozen=True)
class Job:
    """What the parent asks for; ``photos`` are Photos as dicts in order of ``file``. ``folder`` gets ``sparse/``.

    ``camera_model`` None: SIMPLE_RADIAL for mapping, and in the end what held-out observations speak for.
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
    attempts: int
    seconds: float | None
    max_seconds: float


class Work:
    """What the attempts share: the photos (numbered from 0, in order of ``file``), their pairs, the journal."""

    def __init__(self, job: Job, say: Say) -> None:
        self.job, self.say = job, say
        self.photos = [Photo(**photo) for photo in job.photos]
        self.files = [photo.image_name for photo in self.photos]
        self.database, self.images = Path(job.database), Path(job.images)
        self.journal = Journal(Path(job.folder, "attempts"))
        self.held = hold_open(self.database)  # the parent reads in it how far we are
        self.clock, self.started = Clock(self.journal.folder / CLOCK), time.monotonic()
        self.attempt = ATTEMPTS[0].name
        self.seconds: dict[str, float] = {}  # of this attempt's phases
        self._features: tuple[Path, Features] | None = None
        # Where pairs were chosen there are matches in plenty: mapping works on the best of them.
        self.thinned = len(self.photos) > MAX_EXHAUSTIVE

    def begin(self, phase: str, **more: Any) -> None:
        """Say that a phase begins. Of an interrupted run features and matches are kept, while mapping starts again."""
        if database := more.get("database"):
            self.held = hold_open(Path(database))
        self.clock.begin(f"{self.attempt}: {phase}", anew=phase == "mapping")
        self.say(phase=phase, **more)

    def end(self, phase: str) -> None:
        """Note what the phase took, in earlier runs too."""
        self.seconds[phase] = self.clock.end()

    def left(self) -> tuple[float, str]:
        """Seconds that further attempts may take, and which limit says so: the time it is given, which is for all runs
        together, or when it is given up, which is counted in each anew."""
        limits = {GIVEN: (self.job.seconds or math.inf) - self.clock.earlier, GIVEN_UP: self.job.max_seconds}
        limit = min(limits, key=limits.__getitem__)
        return self.started + limits[limit] - time.monotonic(), limit

    def features(self, database: Path) -> Features:
        """How the features of a database are compared where pairs are chosen; kept from one round to the next."""
        if self._features is None or self._features[0] != database:
            words = read_vocabulary(self.database, len(self.photos), self.job.seed, CELLS)
            self._features = database, Features(words)
        return self._features[1]

    @cached_property
    def similarity(self) -> Likeness:
        """How much any two photos look alike."""
        return look_alike(self.database, len(self.photos), self.job.seed)

    def missing(self) -> list[int]:
        """The photos that have no place in the best model so far."""
        best = self.usable()
        placed = set(best.groups[0]) if best else set()
        return [number for number, file in enumerate(self.files) if file not in placed]

    def beside(self, name: str) -> Path:
        """Another database, beside the first."""
        return self.database.with_name(f"{self.database.stem}-{name}.db")

    def usable(self) -> Tried | None:
        """The best attempt, if its model is good enough to go on with."""
        best = self.journal.best()
        good = best and len(best.groups[0]) >= FEWEST_REGISTERED and best.points >= FEWEST_POINTS
        return best if good else None

    def latest(self) -> Path:
        """The database of the best attempt; as long as there is no model, the latest with the lens as it was."""
        plain = [tried for tried in self.journal.tried if tried.name != "fisheye"]
        return self.database.with_name((self.usable() or plain[-1]).database)


def end_with_parent() -> None:
    """End this process when stdin does: the parent is gone."""
    while os.read(0, 1):
        pass
    os._exit(1)
