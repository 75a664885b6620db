"""A budget of wall time for a whole run: what each stage may take of what is left, what was allocated and spent.

Nothing is shared out once for all. Just before a stage begins, what is really left is divided among it and those after
it, so that what one stage took more or less than it was allocated is made good by the others: a slower machine, a
quicker structure from motion, a kill. What each stage takes is its own to declare (stages/contract.py).
"""

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from stages.contract import BudgetLeft, Flexible, Stage
from stages.io.amounts import duration, least_duration
from stages.io.stopwatch import elapsed

RUNNING = ".alive"  # in the workspace: what the running stage has cost so far (stages/io/stopwatch.py)

Stages = Mapping[str, Stage]
Times = Mapping[str, float | None]  # expected seconds by stage; None: flexible, or unknown


def allocated_seconds(stages: Stages, stage: str, left: float, to_come: Times, total: float, reading: float) -> float:
    """Seconds that ``stage`` may take when ``left`` seconds of a budget of ``total`` are left.

    ``to_come`` are the stages after it: what one is expected to take, None where it is flexible. Never less than the
    least that makes sense, whatever is left.
    """
    flexible = (stages[name].flexible for name, seconds in to_come.items() if seconds is None)
    after = [how for how in flexible if how is not None]
    free = left - sum(seconds or 0.0 for seconds in to_come.values())
    how, budget_seconds = stages[stage].flexible, stages[stage].budget_seconds
    if how is None:
        assert budget_seconds is not None, f"{stage} has no share of a budget"
        reserved = sum(_min_seconds(later, reading) for later in after)
        return budget_seconds(BudgetLeft(total, free, reserved, reading))
    shares = how.share + sum(later.share for later in after)
    reserved = sum(_reserved(later, free * later.share / shares) for later in after)
    return max(_min_seconds(how, reading), min(free - reserved, how.max_share * total))


def _min_seconds(how: Flexible, reading: float) -> float:
    return how.min_seconds + (reading if how.reads_photos else 0.0)


def _reserved(how: Flexible, share: float) -> float:
    return min(max(share, how.min_seconds), how.max_seconds)


def min_total(stages: Stages, times: Times, reading: float) -> float:
    """The smallest budget that can be kept: everything that is expected, and the least of all that is flexible."""

    def least(stage: str) -> float:
        how = stages[stage].flexible
        return _min_seconds(how, reading) if how else 0.0

    return sum(least(stage) if seconds is None else seconds for stage, seconds in times.items())


def max_total(stages: Stages, times: Times, total: float) -> float:
    """What all that is expected can take at most of a budget of ``total``."""

    def most(stage: str) -> float:
        how = stages[stage].flexible
        return how.max_share * total if how else 0.0

    return sum(most(stage) if seconds is None else seconds for stage, seconds in times.items())


class Account(BaseModel):
    """The budget of a run as run.json keeps it: ``total`` seconds, and of each stage what was allocated and spent.

    ``run`` is the digest of the run's options, ``photos`` that of its photos. ``spent`` counts every attempt of the
    present run, also those that were killed, as far as their last sign of life (RUNNING); what is found finished costs
    nothing. Once a run is over, well or not, the next one that finds work to do begins a new account; so does one with
    other options or photos.
    """

    model_config = ConfigDict(extra="forbid")

    total: float
    run: str
    photos: str | None = None
    allocated: dict[str, float] = {}
    spent: dict[str, float] = {}
    running: str | None = None
    over: bool = False

    @property
    def seconds_spent(self) -> float:
        return sum(self.spent.values())

    @property
    def left(self) -> float:
        return self.total - self.seconds_spent

    def continue_as(self, run: str, photos: str) -> None:
        """Work begins in a ``run`` of these options on ``photos`` (digests): a new account, unless it goes on with one
        that is not over."""
        if not self.is_of(run, photos):
            self.run, self.allocated, self.spent, self.running, self.over = run, {}, {}, None, False
        self.photos = photos

    def is_of(self, run: str, photos: str) -> bool:
        """Whether this is the account of an unfinished ``run`` of these options and photos."""
        return not self.over and self.run == run and self.photos in (None, photos)

    def allocate(self, stage: str, seconds: float) -> None:
        """Note what ``stage`` is given, or expected to take; the first word counts, later attempts go on under it."""
        self.allocated.setdefault(stage, round(seconds, 1))

    def give(self, stages: Stages, stage: str, to_come: Times, reading: float) -> float:
        """The option ``seconds`` of ``stage`` by what is left, which is allocated; see :func:`allocated_seconds`."""
        wall = allocated_seconds(stages, stage, self.left, to_come, self.total, reading)
        self.allocate(stage, wall)
        how = stages[stage].flexible
        return round(how.work(wall, reading) if how else wall, 1)

    def shortage(self, stages: Stages, times: Times, reading: float) -> str | None:
        """Why the budget cannot be kept with all that is still to be done; None where it can."""
        least = min_total(stages, times, reading)
        if least <= self.left:
            return None
        left = f"{duration(max(0.0, self.left))} of {duration(self.total)} are left"
        return f"{left}, and the remaining stages need at least about {least_duration(least)}"

    def end(self, stage: str, seconds: float) -> None:
        """Note that an attempt at ``stage`` ended, well or not, after ``seconds``."""
        self.spent[stage] = round(self.spent.get(stage, 0.0) + seconds, 1)
        self.running = None

    def recover(self, root: Path) -> None:
        """Count an attempt that was killed: until its last sign of life in the workspace ``root``."""
        if self.running is not None:
            self.end(self.running, elapsed(root / RUNNING))

    def shown(self, stages: Stages) -> dict[str, object]:
        """Total, allocated and spent, for a summary, which cannot know what it takes itself."""

        def others(seconds: Mapping[str, float]) -> dict[str, float]:
            return {s: v for s, v in seconds.items() if s not in stages or not stages[s].summary}

        return {"seconds": self.total, "allocated": others(self.allocated), "spent": others(self.spent)}
