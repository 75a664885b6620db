"""Where a training step of the grid field spends its time, beside what this machine can do.

    python -m benchmarks.grid_parts ../shared/data/lego_400 [--downscale 2] [--cores 1]

The same account as every run keeps (stages/training_parts.py), of more steps one after another.
"""

import argparse
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.grid_field import read_bank
from nerf.grid_field import GridField, GridSettings
from nerf.grid_training import GridTrainer, GridTrainerSettings
from nerf.kernels import warp
from nerf.parallel import take_over_cores
from stages.training_parts import FIRST_TIMED, observed, parts_table, rates_for

CPU = torch.device("cpu")
WARM_STEPS, TIMED_STEPS = 300, 60
SHARE = 0.1  # of the run: the learning rate is still whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--cores", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.cores)
    take_over_cores()
    model = GridField(GridSettings(5, 4, 18, 16, 384), 0, warp)
    bank = read_bank(given.folder, "train", given.downscale, 1)
    trainer = GridTrainer(model, bank, GridTrainerSettings(0, "random", chunks=2))
    for step in range(WARM_STEPS):
        trainer.step(step, SHARE)
    timings: dict[str, Any] = {}
    started = time.perf_counter()
    for step in range(WARM_STEPS, WARM_STEPS + TIMED_STEPS):
        observed(partial(trainer.step, step, SHARE), FIRST_TIMED, timings, CPU)
    seconds = time.perf_counter() - started
    report(parts_table(timings, rates_for(model, CPU)), seconds)


def report(table: dict[str, Any], seconds: float) -> None:
    """Print the table."""
    print(f"{table['rays'] / seconds:,.0f} rays/s, {1e3 * seconds / TIMED_STEPS:.1f} ms a step")
    for row in table["parts"]:
        least = f"{1e3 * row['floor'] / TIMED_STEPS:6.2f} ms at the machine's rates" if row["floor"] else ""
        print(f"  {row['part']:10s} {1e3 * row['seconds'] / TIMED_STEPS:6.2f} ms {100 * row['share']:5.1f} %  {least}")
    print(f"{100 * table['floor_share']:.0f} % of the computed time at the machine's rates")
    print(f"at most {table['most_rays_per_second']:,.0f} rays/s")


if __name__ == "__main__":
    main()
