"""A budget of wall time for a whole run: what each stage may take of what is left, and what was promised and spent.

Nothing is shared out once for all. Just before a stage begins, what is really left is divided among it and those after
it, so that what one stage took more or less than it was promised is made good by the others: a slower machine, a
quicker structure from motion, a kill. Structure from motion cannot be planned to the second, so it comes first of all
that the rest is fitted around; training gets most of what is left.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import ON_REQUEST
from stages.amounts import duration
from stages.contract import StageConfig
from stages.hardware.device import processors
from stages.io.photos import read_photos
from stages.io.stopwatch import kept

# Of the time that is left once what cannot be planned has its own. A user waits for the field; figures, a video and a
# mesh are there to see it by, and gain little beyond MOST_SECONDS. A training of less than half a minute is worth none.
SHARES = {"train": 0.68, "evaluate": 0.05, "render": 0.15, "mesh": 0.12}
LEAST_SECONDS = {"train": 30.0, "evaluate": 2.0, "render": 4.0, "mesh": 8.0}
MOST_SECONDS = {"evaluate": 60.0, "render": 300.0, "mesh": 60.0}
SFM_SHARE = 0.5  # of the budget: what structure from motion may take before it searches fewer features
EFFECTS_SHARE = 0.15  # of the run: what stage effects may take, and of what is left of a budget no more than
EFFECTS_OF_LEFT = 0.25  # this: a pilot has to leave a training that is worth it
# Of that, beside reading the photos: statistics take one or two seconds (docs/experiments/effects.md), timing a pilot
# as much.
BESIDE_PILOTS = 4.0
LARGEST_SHARE = 0.35  # of the budget: what a stage other than train may take where all before it is there already
# Training's own seconds count steps alone. Beside reading the photos, timing the first steps takes about STARTING,
# probing and checkpoints 1.5 to 2 % (fox, fountain_p11 and sceaux_castle, three minutes each).
STARTING, BESIDE_STEPS = 4.0, 0.02
# Seconds that a core takes to decode a million pixels and to shrink or examine them. Decoding alone takes 0.01 to 0.02
# for JPEG, 0.03 for PNG (fox, banana, fountain_p11), all of stage ingest 0.03; large photos take longer.
READING = 0.04
ALIVE = ".alive"  # in the workspace: what the stage at work has cost so far (stages/io/stopwatch.py)


def reading_seconds(megapixels: float, cores: int) -> float:
    """Seconds that it takes to decode photos of so many million pixels in all, which several stages do once each."""
    return READING * megapixels / cores


def reading_of(ingest: Path) -> float:
    """:func:`reading_seconds` on this machine, of the photos that stage ingest left in a folder."""
    megapixels = sum(photo.width * photo.height for photo in read_photos(ingest)) / 1e6
    return reading_seconds(megapixels, processors())


def for_pilots(total: float, reading: float, most: float = math.inf) -> float:
    """Seconds of a run of ``total`` that pilots may take: EFFECTS_SHARE, and ``most`` at most, less what stage effects
    takes without any."""
    return max(0.0, min(EFFECTS_SHARE * total, most) - BESIDE_PILOTS - reading)


def allotted(stage: str, left: float, to_come: Mapping[str, float | None], total: float, reading: float = 0.0) -> float:
    """Seconds that ``stage`` may take when ``left`` seconds of a budget of ``total`` are left.

    ``to_come`` are the stages after it: what one is expected to take, None where it takes what it is given. Training
    and effects, whose seconds are those of its pilots, take ``reading`` seconds before they begin. Never less than the
    least that makes sense, whatever is left.
    """
    least = LEAST_SECONDS | {"train": LEAST_SECONDS["train"] + reading}
    open_ended = [name for name, seconds in to_come.items() if seconds is None and name in SHARES]
    free = left - sum(seconds or 0.0 for seconds in to_come.values())
    if stage == "sfm":
        return max(1.0, min(SFM_SHARE * total, free - sum(least[name] for name in open_ended)))
    if stage == "effects":
        return for_pilots(total, reading, EFFECTS_OF_LEFT * free)
    whole = SHARES[stage] + sum(SHARES[name] for name in open_ended)
    reserved = sum(_reserved(name, free * SHARES[name] / whole) for name in open_ended)
    most = total if stage == "train" else LARGEST_SHARE * total
    return max(least[stage], min(free - reserved, most))


def _reserved(stage: str, share: float) -> float:
    return min(max(share, LEAST_SECONDS[stage]), MOST_SECONDS.get(stage, share))


def training_seconds(wall: float, reading: float = 0.0) -> float:
    """Seconds of training steps in a stage train that takes ``wall`` seconds in all, at least half of these, and
    ``reading`` of them to read the photos."""
    return max(wall / 2, (wall - STARTING - reading) / (1 + BESIDE_STEPS))


def least_total(expected: Mapping[str, float | None], reading: float = 0.0) -> float:
    """The smallest budget that can be kept: everything that is expected, and the least of all that can give way."""
    least = LEAST_SECONDS | {"train": LEAST_SECONDS["train"] + reading}
    return sum(least.get(name, 0.0) if seconds is None else seconds for name, seconds in expected.items())


def most_total(expected: Mapping[str, float | None], total: float) -> float:
    """What all that is expected can take at most of a budget of ``total``: only training takes all that there is."""
    most = {"train": total}
    return sum(most.get(name, LARGEST_SHARE * total) if s is None else s for name, s in expected.items())


def takes_what_it_is_given(options: StageConfig) -> bool:
    """Whether nothing else says how long the stage works: neither seconds nor steps, nor those of ``--more``."""
    open_ended = getattr(options, "seconds", 0.0) is None
    return open_ended and all(getattr(options, name, None) is None for name in ("steps", "after"))


def has_its_own_time(stage: str, settings: Settings) -> bool:
    """Whether ``stage`` is charged to no run's budget: a study, and training that goes on (``--more``)."""
    return stage in ON_REQUEST or (stage == "train" and settings.train.after is not None)


class Budget:
    """The budget of a run as run.json keeps it: ``total`` seconds, and of each stage what was promised and spent.

    ``spent`` counts every attempt of the present run, also those that were killed, as far as their last sign of life
    (ALIVE); what is found finished costs nothing. Once a run is over, well or not, the next one that
    finds work to do begins a new account; so does one with other options or photos.
    """

    def __init__(self, state: dict[str, Any]) -> None:
        self.state = state

    @staticmethod
    def new(total: float, of: str) -> dict[str, Any]:
        """A new account, for run.json; ``of`` tells runs with other options apart."""
        return {"seconds": total, "of": of, "photos": None} | {
            "promised": {},
            "spent": {},
            "running": None,
            "over": False,
        }

    @property
    def total(self) -> float:
        return self.state["seconds"]

    @property
    def over(self) -> bool:
        return self.state["over"]

    @property
    def spent(self) -> float:
        return sum(self.state["spent"].values())

    @property
    def left(self) -> float:
        return self.total - self.spent

    def continue_as(self, of: str, photos: str) -> None:
        """Work begins in a run ``of`` these options on ``photos`` (their digest): a new account, unless it goes on with
        one that is not over."""
        if not self.is_of(of, photos):
            self.state.update(self.new(self.total, of))
        self.state["photos"] = photos

    def is_of(self, of: str, photos: str) -> bool:
        """Whether this is the account of an unfinished run ``of`` these options and photos."""
        return not self.over and self.state["of"] == of and self.state.get("photos") in (None, photos)

    def begin(self, stage: str) -> None:
        """Note that work on ``stage`` has begun now."""
        self.state["running"] = {"stage": stage}

    def promise(self, stage: str, seconds: float) -> None:
        """Note what ``stage`` is given, or expected to take; the first word counts, later attempts go on under it."""
        self.state["promised"].setdefault(stage, round(seconds, 1))

    def give(self, stage: str, to_come: Mapping[str, float | None], reading: float) -> float:
        """Seconds of work that ``stage`` is given of what is left, which is promised; see :func:`allotted`."""
        wall = allotted(stage, self.left, to_come, self.total, reading)
        self.promise(stage, wall)
        return round(training_seconds(wall, reading) if stage == "train" else wall, 1)

    def shortage(self, to_come: Mapping[str, float | None], reading: float) -> str | None:
        """Why the budget cannot be kept with training and all that is ``to_come``; None where it can."""
        least = least_total({"train": None, **to_come}, reading)
        if least <= self.left:
            return None
        left = f"{duration(max(0.0, self.left))} of {duration(self.total)} are left"
        return f"{left}, the smallest of all that is to come takes about {duration(least)}"

    def end(self, stage: str, seconds: float) -> None:
        """Note that an attempt at ``stage`` ended, well or not, after ``seconds``."""
        spent = self.state["spent"]
        spent[stage] = round(spent.get(stage, 0.0) + seconds, 1)
        self.state["running"] = None

    def recover(self, root: Path) -> None:
        """Count an attempt that was killed: until its last sign of life in the workspace ``root``."""
        if (running := self.state["running"]) is not None:
            self.end(running["stage"], kept(root / ALIVE))

    def close(self) -> None:
        """The run has come to its end: what is done from now on is another one."""
        self.state["over"] = True

    def account(self) -> dict[str, Any]:
        """Total, promised and spent, for the report, which cannot know what it takes itself."""
        kept = {name: {s: v for s, v in self.state[name].items() if s != "report"} for name in ("promised", "spent")}
        return {"seconds": self.total, **kept}
