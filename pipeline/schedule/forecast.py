"""How long a run is expected to take, said before it begins: from the photos' number and size and measured rates."""

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from pipeline.engine import manifests
from pipeline.engine.manifests import BadManifest
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import ON_REQUEST
from pipeline.schedule.budget import (
    READING,
    STARTING,
    Budget,
    for_pilots,
    has_its_own_time,
    least_total,
    most_total,
    reading_seconds,
    takes_what_it_is_given,
)
from stages.amounts import duration, rough_duration
from stages.contract import StageError
from stages.hardware.device import processors
from stages.train.config import SECONDS
from stages.train.config import Config as TrainConfig

if TYPE_CHECKING:
    from pipeline.engine.runner import Runner

UNREADABLE_PIXELS = 2_000_000  # that a photo is taken to have until ingest says what is wrong with it


class Photos(NamedTuple):
    """How many, and how large each is in millions of pixels."""

    number: int
    megapixels: float

    def reading(self, cores: int) -> float:
        """Seconds that it takes to decode all of them once."""
        return reading_seconds(self.number * self.megapixels, cores)


def photos_of(settings: Settings) -> Photos | None:
    """What is to be seen of the photos without decoding any; None where they are gone or cannot be used."""
    from stages.ingest.decoding import pixel_count
    from stages.ingest.sources import find_source
    from stages.ingest.video_frames import expected_frames

    try:
        source = find_source(settings.ingest.photos, settings.ingest.cameras)
        if source.kind == "video":
            number, width, height = expected_frames(source.files[0], settings.ingest.frames)
            return Photos(number, width * height / 1e6)
    except StageError:  # ingest says what is wrong with them, where it has to run at all
        return None
    pixels = pixel_count(source.files[len(source.files) // 2]) or UNREADABLE_PIXELS
    return Photos(len(source.files), pixels / 1e6)


def expected(settings: Settings, photos: Photos | None) -> dict[str, float | None]:
    """Seconds by stage; None of those that take what a budget gives them, and of a training in steps, which nobody has
    timed yet. Nothing where the photos are gone.

    Rates were measured on two cores, on fox, fountain_p11, fern, banana, herzjesu_p8 and the demo (docs/results.md):
    sfm took 0.6 to 1.8 times as long, and more where photos found no place at once.
    """
    if photos is None:
        return {}
    cores = processors()
    seconds: dict[str, float | None] = {
        "ingest": 0.5 + photos.reading(min(cores, 8)),
        "sfm": 0.2 if settings.sfm.cameras is not None else sfm_seconds(photos, cores),
        "normalise": 0.3,
        "effects": 10.0 + photos.reading(cores),  # two or three, and half a minute where a pilot has to decide
        "report": 2.0 + READING * photos.megapixels * min(15, photos.number / settings.normalise.test_every),
    }
    given = settings.train.seconds if settings.train.after is None else settings.train.more_seconds
    seconds["train"] = given and given + STARTING + photos.reading(cores)
    return seconds | {stage: getattr(settings, stage).seconds for stage in ("evaluate", "render", "mesh")}


def counts_steps(train: TrainConfig) -> bool:
    """Whether the training ends after so many steps, however long they take."""
    return (train.steps if train.after is None else train.more_steps) is not None


def sfm_seconds(photos: Photos, cores: int) -> float:
    """Reading, features of each photo, matches of each pair or of 30 partners each, and mapping, which has one core."""
    pairs = photos.number * min(photos.number - 1, 60) / 2
    features = 0.25 * photos.number * min(photos.megapixels, 1.7)
    return 4.0 + photos.reading(cores) + (features + 0.02 * pairs) * 2 / cores + 0.4 * photos.number


def trained_in_all(runner: "Runner", trains: bool) -> float | None:
    """Seconds of training steps behind the field that the later stages will meet, by which they give themselves time:
    to come where the run ``trains``, else those of the finished training. None where nobody can tell."""
    train = runner.settings.train
    if not trains:
        finished = runner.found("train")
        return finished and finished.facts["train_seconds"]
    if counts_steps(train):
        return None
    if train.after is None:
        return trained_seconds(train)
    try:
        before = manifests.read(runner.workspace.folder("train", train.after))
    except (FileNotFoundError, BadManifest):  # stage train says why it cannot go on
        return None
    assert train.more_seconds is not None, "one of the two is given"
    return before.facts["train_seconds"] + train.more_seconds


def without_budget(
    train: TrainConfig, times: Mapping[str, float | None], reading: float, trained: float | None
) -> dict[str, float | None]:
    """``times`` of a run without a budget, after ``trained`` seconds of training in all; None where nobody can tell."""
    usual: dict[str, float] = {}
    if not counts_steps(train):
        usual["train"] = trained_seconds(train) + STARTING + reading
    if trained is not None:
        # What a training of three minutes is followed by (fox, fountain_p11, the demo; drawing scaled to its share).
        usual |= {"evaluate": 0.05 * trained, "render": 0.27 * trained, "mesh": 5.0 + 0.15 * trained}
    return {stage: usual.get(stage) if seconds is None else seconds for stage, seconds in times.items()}


def trained_seconds(train: TrainConfig) -> float:
    """Of a training from the beginning that counts no steps: those asked for, or the preset's."""
    return train.seconds or SECONDS[train.preset or "standard"]


def pilots_seconds(settings: Settings, times: Mapping[str, float | None], reading: float) -> float | None:
    """Seconds that pilots may take in a run without a budget, whose stages take ``times``: their part of what it is
    expected to take. None, for as long as they take, where that is not known: a run that counts steps is to end the
    same on every machine."""
    if not times or settings.train.steps is not None:
        return None
    whole = without_budget(settings.train, times, reading, trained_seconds(settings.train))
    return for_pilots(sum(seconds or 0.0 for seconds in whole.values()), reading)


def reckoned_with(stage: str, settings: Settings, budget: Budget | None) -> dict[str, float]:
    """The time that a plan of ``stage`` rests on: the run's budget, the stage's own seconds or, for pilots, training's;
    {} without. It is part of no key; with another one the stage plans anew."""
    options = getattr(settings, stage)
    if not takes_what_it_is_given(options):
        seconds = getattr(options, "seconds", None)
        return {} if seconds is None else {"seconds": seconds}
    if budget is not None:
        return {"budget": budget.total}
    # What --more adds changes no pilot: the field that goes on stands on their decisions.
    limited = stage == "effects" and settings.train.steps is None
    return {"training": trained_seconds(settings.train)} if limited else {}


class Forecast(NamedTuple):
    """What is said at the start of a run, and the seconds that its stages are expected to take; None of those that a
    budget gives their time, and where nobody can tell."""

    words: list[str]
    times: Mapping[str, float | None]


def foretell(runner: "Runner", stages: Sequence[str], anew: frozenset[str], photos: Photos | None) -> Forecast:
    """How long a run of ``stages`` takes, ``anew`` those of them that may run though they have a result: in words,
    where anything may have to run and it can be told, and by stage. Nothing where the photos or a file that a setting
    names cannot be read: the stage that reads it says so."""
    try:
        return _foretold(runner, stages, anew, photos) if photos else Forecast([], {})
    except StageError:
        return Forecast([], {})


def _foretold(runner: "Runner", stages: Sequence[str], anew: frozenset[str], photos: Photos) -> Forecast:
    train, times, reading = runner.settings.train, expected(runner.settings, photos), photos.reading(processors())
    left = [name for name in stages if name in anew or runner.found(name) is None]
    trains = "train" in left
    apart = [name for name in left if has_its_own_time(name, runner.settings)]
    budget = None if apart and set(left) <= {*apart, "report"} else runner.budget
    if budget is None:
        unknown = None in (times[name] for name in stages if name in times)
        times = without_budget(train, times, reading, trained_in_all(runner, trains) if unknown else None)
    if set(left) <= {"report"} or (trains and counts_steps(train)):
        return Forecast([], times)
    studies = {name: getattr(runner.settings, name).seconds for name in ON_REQUEST}  # words alone: no run pays for them
    of_left = {name: seconds for name, seconds in {**times, **studies}.items() if name in left}
    if budget is not None:
        beside = sum(of_left.pop(name) or 0.0 for name in apart)
        return Forecast([in_words(budget.total, runner.time_left(budget), of_left, reading, beside)], times)
    known = [seconds for seconds in of_left.values() if seconds is not None]
    words = f"done in about {rough_duration(sum(known))}, about {_clock(sum(known))}"
    return Forecast([words] if len(known) == len(left) else [], times)


def in_words(total: float, left: float, times: Mapping[str, float | None], reading: float, beside: float = 0.0) -> str:
    """The promise of a budget of ``total`` seconds, ``left`` of them not spent; ``times`` of what has to run by it, and
    ``beside`` it the seconds of what has a time of its own."""
    least, most = least_total(times, reading), most_total(times, total)
    given = f"budget {duration(total)}" + (f" and {rough_duration(beside)} beside it" if beside else "")
    if least > left and left < total:
        needed = f"about {rough_duration(least)} is needed: give a larger --budget, or all is made as small as can be"
        return f"{given}, {duration(max(0.0, left))} of it left by what was spent before; {needed}"
    if least > left:
        soonest = f"about {rough_duration(least)} is the least that would do"
        return f"{given}, too short for these photos: {soonest}; all is made as small as can be"
    finish = _clock(min(left, most) + beside)
    # Only training takes all that there is; the rest may well be done sooner.
    trains = times.get("train", 0.0) is None
    return f"{given}, done at {f'about {finish}' if trains else f'{finish} at the latest'}"


def _clock(seconds: float) -> str:
    """The time of day in so many seconds."""
    return time.strftime("%H:%M", time.localtime(time.time() + seconds))
