"""Where the time of a training run goes, span by span, and how near that is to what this machine can do.

One step in PROFILE_INTERVAL is profiled (nerf/runtime/profiler.py): the same kernels in the same order, so on a CPU the
result does not depend on it; on a GPU they are launched one by one for it, with more time between them. At the end the
machine's own rates are measured and compared with the work of each span.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from nerf.runtime.machine_rates import Rates, measure_rates
from nerf.runtime.parallel import workers
from nerf.runtime.profiler import Profiler, WorkCounts, is_profiling, profiling
from nerf.training.trainer import StepResult
from stages.io.files import write_json
from stages.train.config import Config
from stages.train.fields.field_list import field_of

PROFILE_INTERVAL, FIRST_PROFILED_STEP = 32, 8  # the very first steps are unlike the others
RATES_SECONDS = 0.5  # to measure the machine's rates in, once training has ended
PROFILE_FILE = "profile.json"
IDLE = "idle"


def profiled_step(
    take: Callable[[], StepResult], step: int, timings: dict[str, Any], device: torch.device
) -> StepResult:
    """Take a step. Profile it if it is due, and add its profile to ``timings``: JSON values, empty at first."""
    if step % PROFILE_INTERVAL != FIRST_PROFILED_STEP or is_profiling():  # another training of this process, in tests
        return take()
    profiler = Profiler(device)
    profiler.now()  # a GPU may still be busy with the step before
    started = time.perf_counter()
    with profiling(profiler):
        result = take()
    seconds = time.perf_counter() - started
    cores = workers() if device.type == "cpu" else 1
    amounts = {
        "steps": 1,
        "rays": result.rays,
        "colour_evaluations": result.colour_evaluations,
        "density_evaluations": result.density_evaluations,
    }
    for name, amount in (amounts | {"seconds": seconds, "core_seconds": cores * seconds}).items():
        timings[name] = timings.get(name, 0) + amount
    spans = timings.setdefault("spans", {})
    for name, total in profiler.spans.items():
        spans[name] = [a + b for a, b in zip(spans.get(name, [0.0] * 4), (total.seconds, *total.work), strict=True)]
    return result


def profile_table(timings: dict[str, Any], rates: Rates) -> dict[str, Any]:
    """The content of profile.json, from the ``timings`` of at least one :func:`profiled_step`.

    Each span's ``share`` is of the cores' time; shares sum to 1, the time in which no core computed being ``idle``.
    ``min_seconds`` is the time that a span's work takes at ``rates``; null for spans without counted work.
    ``efficiency`` is the sum of all min_seconds over the time computed.
    """
    spans = {name: (seconds, rates.seconds(WorkCounts(*work))) for name, (seconds, *work) in timings["spans"].items()}
    busy, minimum = (sum(column) for column in zip(*spans.values(), strict=True))
    total = max(timings["core_seconds"], busy)
    spans[IDLE] = (total - busy, 0.0)
    ordered = sorted(spans.items(), key=lambda entry: -entry[1][0])
    return {
        "profiled_steps": timings["steps"],
        **{name: timings[name] for name in ("rays", "colour_evaluations", "density_evaluations")},
        "seconds": round(timings["seconds"], 4),
        "core_seconds": round(total, 4),
        "rates": {name: round(rate) for name, rate in rates._asdict().items()},
        "spans": [_row(name, seconds, least, total) for name, (seconds, least) in ordered],
        "efficiency": round(minimum / busy, 4),
        "max_rays_per_second": round(timings["rays"] / timings["seconds"] * total / minimum, 1) if minimum else None,
    }


def write_profile(folder: Path, timings: dict[str, Any], config: Config, device: torch.device) -> list[str]:
    """Measure the machine and write profile.json; the names of the files written: none where no step was timed."""
    if not timings:
        return []
    field = field_of(config)
    rates = measure_rates(device, field.matmul_width(config), field.table_rows(config), RATES_SECONDS)
    write_json(folder / PROFILE_FILE, profile_table(timings, rates))
    return [PROFILE_FILE]


def _row(name: str, seconds: float, min_seconds: float, total: float) -> dict[str, Any]:
    row = {"span": name, "seconds": round(seconds, 4), "share": round(seconds / total, 4)}
    return row | {"min_seconds": round(min_seconds, 4) if min_seconds else None}
