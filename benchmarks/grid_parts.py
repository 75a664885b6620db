"""Where a training step of the grid field spends its time, beside what this machine can do.

    python -m benchmarks.grid_parts ../shared/data/lego_400 [--downscale 2]

One core; every function of the kernels and the networks is timed from outside. The floor of a step is its arithmetic at
the measured rate of matrix products of these shapes, plus its gathers (twice on the way back) at the measured rate of
random rows from a table of this size, plus Adam's bytes at the measured rate of copying.
"""

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from benchmarks.grid_field import read_bank
from nerf import grid_mlp
from nerf.grid_field import GridField, GridSettings
from nerf.grid_training import GridTrainer, GridTrainerSettings
from nerf.kernels import reference, warp
from nerf.parallel import take_over_cores

WARM_STEPS, TIMED_STEPS = 300, 60
NETWORKS = ("density_forward", "colour_forward", "colour_backward", "density_backward")


def timed(name: str, function: Callable[..., Any], spent: dict[str, float]) -> Callable[..., Any]:
    """``function``, adding what it takes to ``spent``."""

    @wraps(function)
    def wrapper(*arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments, **named)
        spent[name] += time.perf_counter() - start
        return result

    return wrapper


def best_of(work: Callable[[], object], times: int = 30) -> float:
    """Seconds of the fastest of several runs."""
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def machine(rows: int) -> tuple[float, float, float]:
    """FLOP/s of (8192, 64) x (64, 64), random rows of 16 bytes per second from ``rows``, bytes per second of a copy."""
    a, b, out = torch.randn(8192, 64), torch.randn(64, 64), torch.empty(8192, 64)
    product = 2 * 8192 * 64 * 64 / best_of(lambda: torch.mm(a, b, out=out))
    table, index, found = torch.randn(rows, 4), torch.randint(rows, (1 << 17,)), torch.empty(1 << 17, 4)
    gather = len(index) / best_of(lambda: torch.index_select(table, 0, index, out=found))
    much, there = torch.randn(1 << 22), torch.empty(1 << 22)
    return product, gather, 8 * len(much) / best_of(lambda: there.copy_(much))


def floor(trainer: GridTrainer, kept: float, marched: float) -> dict[str, float]:
    """Seconds that the arithmetic, gathers and moments of a step take at the machine's own rates."""
    layout = trainer.model.layout
    product, gather, copy = machine(layout.rows)
    density = 2 * grid_mlp.HIDDEN * (layout.width + grid_mlp.GEOMETRY)
    colour = 2 * grid_mlp.HIDDEN * (grid_mlp.GEOMETRY + 3)
    corners = 8 * len(layout.resolutions)
    return {
        "products": (marched * density + kept * (colour + 2 * (density + colour))) / product,
        "gathers": corners * (marched + 2 * kept) / gather,
        "Adam": 7 * 4 * trainer.model.table.numel() / copy,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--downscale", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(1)
    take_over_cores()
    spent: dict[str, float] = defaultdict(float)
    kernels: Any = SimpleNamespace(**{name: timed(name, getattr(warp, name), spent) for name in reference.__all__})
    for name in NETWORKS:
        setattr(grid_mlp, name, timed(name, getattr(grid_mlp, name), spent))
    bank = read_bank(given.folder, "train", given.downscale, 1)
    model = GridField(GridSettings(5, 4, 18, 16, 384), 0, kernels)
    trainer = GridTrainer(model, bank, GridTrainerSettings(0, "random", chunks=2))
    for step in range(WARM_STEPS):
        trainer.step(step, 0.1)
    spent.clear()
    counts: Counter[str] = Counter()
    forward = model.forward

    def counted(*arguments: Any) -> Any:
        done = forward(*arguments)
        counts.update(marched=done.marched, kept=len(done.points))
        return done

    setattr(model, "forward", counted)  # noqa: B010 - a plain assignment is no method to a type checker
    start, rays = time.perf_counter(), 0
    for step in range(WARM_STEPS, WARM_STEPS + TIMED_STEPS):
        rays += trainer.step(step, 0.1).rays
    report(trainer, spent, counts, rays, time.perf_counter() - start)


def report(trainer: GridTrainer, spent: dict[str, float], counts: Counter[str], rays: int, seconds: float) -> None:
    """Print the table."""
    kept, marched = counts["kept"] / TIMED_STEPS, counts["marched"] / TIMED_STEPS
    least = floor(trainer, kept, marched)
    print(f"{kept / seconds * TIMED_STEPS:,.0f} samples/s, {rays / seconds:,.0f} rays/s on one core")
    print(f"a step: {1e3 * seconds / TIMED_STEPS:.1f} ms for {kept:,.0f} samples out of {marched:,.0f} looked at")
    for name, value in sorted(spent.items(), key=lambda part: -part[1]):
        print(f"  {name:24s} {1e3 * value / TIMED_STEPS:6.2f} ms  {100 * value / seconds:4.1f} %")
    rest = seconds - sum(spent.values())
    print(f"  {'everything else':24s} {1e3 * rest / TIMED_STEPS:6.2f} ms  {100 * rest / seconds:4.1f} %")
    whole = sum(least.values())
    parts = ", ".join(f"{name} {1e3 * value:.1f} ms" for name, value in least.items())
    print(f"floor: {1e3 * whole:.1f} ms ({parts}); reached {100 * whole / (seconds / TIMED_STEPS):.0f} % of it")


if __name__ == "__main__":
    main()
