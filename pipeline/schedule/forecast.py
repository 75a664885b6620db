"""How long a run is expected to take, said before it begins: each stage's own estimate, and what a budget leaves."""

import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, NamedTuple

from pipeline.schedule.budget import Stages, Times, max_total, min_total
from stages.contract import BudgetLeft, Photos, Stage, StageConfig, StageError, Workload
from stages.ingest.auxiliary_files import pair_masks
from stages.ingest.sources import find_source
from stages.io.amounts import duration, least_duration, rough_duration

if TYPE_CHECKING:
    from stages.ingest import Config as IngestConfig

UNREADABLE_PIXELS = 2_000_000  # that a photo is taken to have until ingest says what is wrong with it


def photos_of(config: "IngestConfig") -> Photos | None:
    """What is to be seen of the photos without decoding any; None where they are gone or cannot be used."""
    from stages.ingest.decoding import pixel_count
    from stages.ingest.video.frames import expected_frames

    try:
        source = find_source(config.photos, config.cameras, config.photo_list)
        if source.kind == "video":
            number, width, height = expected_frames(source.files[0], config.frames)
            return Photos(number, width * height / 1e6)
    except StageError:  # ingest says what is wrong with them, where it has to run at all
        return None
    pixels = pixel_count(source.files[len(source.files) // 2]) or UNREADABLE_PIXELS
    masks, _ = pair_masks([source.name(file) for file in source.files], source.masks)
    return Photos(len(source.files), pixels / 1e6, len(masks))


def expected_times(stages: Stages, workload: Workload, budgeted: bool) -> dict[str, float | None]:
    """Seconds by stage; None where nobody can tell and, in a run with a budget, of those that fill what they get."""
    return {
        name: None if budgeted and stage.fills_its_time(workload.options[name]) else _own(stage, workload)
        for name, stage in stages.items()
        if not stage.on_request
    }


def _own(stage: Stage, workload: Workload) -> float | None:
    return stage.expected_seconds(workload.options[stage.name], workload)


def limited_seconds(stage: Stage, options: Mapping[str, StageConfig], times: Times, reading: float) -> float | None:
    """The option ``seconds`` of a stage that has a limit in a run without a budget as well, by what the run takes; None
    for no limit, also where nothing is known of the run."""
    if not times or stage.budget_seconds is None or stage.limiting_seconds(options) is None:
        return None
    total = sum(seconds or 0.0 for seconds in times.values())
    return stage.budget_seconds(BudgetLeft(total, total, 0.0, reading))


def time_behind_plan(stage: Stage, options: Mapping[str, StageConfig], total: float | None) -> dict[str, float]:
    """The time that a plan of a stage rests on: the budget of ``total`` seconds, the stage's own option, or what limits
    it without a budget; {} without. It is part of no key; with another one the stage plans anew."""
    own = options[stage.name]
    if not own.time_is_open:
        seconds = getattr(own, "seconds", None)
        return {} if seconds is None else {"seconds": seconds}
    if total is not None:
        return {"budget": total}
    limit = stage.limiting_seconds(options)
    return {} if limit is None else {"limit": limit}


class Forecast(NamedTuple):
    """What is said at the start of a run, and the seconds that its stages are expected to take; None of those that fill
    what a budget gives them, and where nobody can tell."""

    messages: list[str]
    times: Times


class Left(NamedTuple):
    """A budget of ``total`` seconds, ``left`` of them not spent."""

    total: float
    left: float


def forecast_run(stages: Stages, to_run: Collection[str], workload: Workload, budget: Left | None) -> Forecast:
    """How long the stages ``to_run`` take: a message where that can be told, and seconds by stage."""
    exempt = [name for name in to_run if stages[name].is_exempt(workload.options[name])]
    if exempt and all(name in exempt or stages[name].summary for name in to_run):
        budget = None
    whole = workload._replace(partial=lambda _: None)  # a report and limits of later stages count all of a stage
    times = expected_times(stages, whole, budget is not None)
    left = expected_times(stages, workload, budget is not None)
    ahead = {name: left[name] if name in left else _own(stages[name], workload) for name in stages if name in to_run}
    known = [seconds for seconds in ahead.values() if seconds is not None]
    unknown = [name for name in ahead.keys() - exempt if ahead[name] is None]
    if budget is None:
        total = sum(known)
        message = f"done in about {rough_duration(total)}, about {_clock(total)}"
        return Forecast([message] if len(known) == len(ahead) else [], times)
    if not all(stages[name].fills_its_time(workload.options[name]) for name in unknown) or any(
        ahead[name] is None for name in exempt
    ):
        return Forecast([], times)
    extra = sum(ahead.pop(name) or 0.0 for name in exempt)
    reading = workload.photos.reading_seconds(workload.cores)
    return Forecast([budget_message(stages, budget, ahead, reading, extra)], times)


def budget_message(stages: Stages, budget: Left, times: Times, reading: float, extra: float = 0.0) -> str:
    """When a run with a budget is done; ``times`` of what has to run by it, and ``extra`` the seconds of what is exempt
    from it."""
    total, left = budget
    least, most = min_total(stages, times, reading), max_total(stages, times, total)
    given = f"budget {duration(total)}" + (f" and {rough_duration(extra)} on top" if extra else "")
    if least > left and left < total:
        needed = (
            f"it takes at least about {least_duration(least)}: give a larger --budget, or every stage does its minimum"
        )
        return f"{given}, of which {duration(max(0.0, left))} are left; {needed}"
    if least > left:
        soonest = f"it takes at least about {least_duration(least)}"
        return f"{given}, too short for these photos: {soonest}; every stage does its minimum"
    finish = _clock(min(left, most) + extra)
    # Others have no use for more than a share, and may well be done sooner.
    uses_all = any(s is None and (how := stages[n].flexible) and how.max_share >= 1 for n, s in times.items())
    return f"{given}, done at {f'about {finish}' if uses_all else f'{finish} at the latest'}"


def _clock(seconds: float) -> str:
    """The time of day in so many seconds."""
    return time.strftime("%H:%M", time.localtime(time.time() + seconds))
