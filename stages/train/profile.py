"""Where the time of a training run goes, part by part, and how near that is to what this machine can do.

One step in a few is timed as it is taken (nerf/runtime/profiler.py): the same kernels in the same order, so nothing of
the result depends on it. At the end the machine's own rates are measured, and the work of each part set against them.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from nerf.runtime.machine_rates import Rates, measure_rates
from nerf.runtime.parallel import workers
from nerf.runtime.profiler import Profiler, WorkCounts, profiling
from nerf.training.trainer import StepResult
from stages.io.files import write_json
from stages.train.config import Config
from stages.train.fields.field_list import field_of

TIMED_EVERY, FIRST_TIMED = 32, 8  # steps: one of so many is timed; the very first ones are unlike the others
RATES_SECONDS = 0.5  # to measure the machine's rates in, once training has ended
PARTS_FILE = "profile.json"
WAITING = "waiting"


def observed(take: Callable[[], StepResult], step: int, timings: dict[str, Any], device: torch.device) -> StepResult:
    """Take a step; if its turn has come, add what it did to ``timings``: JSON values, empty at first."""
    if step % TIMED_EVERY != FIRST_TIMED:
        return take()
    profiler, started = Profiler(device), time.perf_counter()
    with profiling(profiler):
        result = take()
    seconds = time.perf_counter() - started
    cores = workers() if device.type == "cpu" else 1
    amounts = {"steps": 1, "rays": result.rays, "samples": result.samples, "densities": result.densities}
    for name, amount in (amounts | {"seconds": seconds, "core_seconds": cores * seconds}).items():
        timings[name] = timings.get(name, 0) + amount
    parts = timings.setdefault("parts", {})
    for name, spent in profiler.spans.items():
        parts[name] = [a + b for a, b in zip(parts.get(name, [0.0] * 4), (spent.seconds, *spent.work), strict=True)]
    return result


def parts_table(timings: dict[str, Any], rates: Rates) -> dict[str, Any]:
    """The content of profile.json, from what :func:`observed` noted of at least one step.

    ``samples`` are points whose colour was computed, ``densities`` points whose density was asked for.
    Shares are of the cores' time, and sum to 1: what no core computed is ``waiting``. ``floor`` is the time that a
    part's work takes at ``rates``; null for parts whose work is not of that kind. ``floor_share`` is of what was
    computed.
    """
    spent = {name: (seconds, rates.seconds(WorkCounts(*work))) for name, (seconds, *work) in timings["parts"].items()}
    busy, floor = (sum(column) for column in zip(*spent.values(), strict=True))
    whole = max(timings["core_seconds"], busy)
    spent[WAITING] = (whole - busy, 0.0)
    ordered = sorted(spent.items(), key=lambda entry: -entry[1][0])
    return {
        "steps_timed": timings["steps"],
        **{name: timings[name] for name in ("rays", "samples", "densities")},
        "seconds": round(timings["seconds"], 4),
        "core_seconds": round(whole, 4),
        "rates": {name: round(rate) for name, rate in rates._asdict().items()},
        "parts": [_row(name, seconds, least, whole) for name, (seconds, least) in ordered],
        "floor_share": round(floor / busy, 4),
        "most_rays_per_second": round(timings["rays"] / timings["seconds"] * whole / floor, 1) if floor else None,
    }


def write_parts(folder: Path, timings: dict[str, Any], config: Config, device: torch.device) -> list[str]:
    """Measure the machine and write profile.json; the names of the files written: none where no step was timed."""
    if not timings:
        return []
    field = field_of(config)
    rates = measure_rates(device, field.matmul_width(config), field.table_rows(config), RATES_SECONDS)
    write_json(folder / PARTS_FILE, parts_table(timings, rates))
    return [PARTS_FILE]


def _row(name: str, seconds: float, floor: float, whole: float) -> dict[str, Any]:
    row = {"part": name, "seconds": round(seconds, 4), "share": round(seconds / whole, 4)}
    return row | {"floor": round(floor, 4) if floor else None}
