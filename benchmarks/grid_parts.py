"""Where a training step of the hash-grid field spends its time, beside what this machine can do.

    python -m benchmarks.grid_parts ../shared/data/lego_400 --workspace /tmp/lego.nerf [--seconds 300] [--downscale 1]

The steps are those of `pipeline train WORKSPACE --train.seconds S --train.downscale D`: photos, cameras and effects are
those of the workspace, sizes, colours in a step and its parts what stage train chooses here. The same account as every
run keeps (stages/train/profile.py), of more steps one after another; samples are points whose colour was computed.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.nerfacto import pipeline, stage_folder
from benchmarks.record import Record, add_out
from nerf.geometry.scene import Scene
from nerf.runtime.machine_rates import measure_rates
from nerf.runtime.matmul_precision import use_matmul_precision
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import FieldTrainer
from pipeline.cli.terminal import PlainDisplay
from stages import train
from stages.contract import plan_stage
from stages.effects.decisions import Decisions, read_decisions
from stages.effects.image_effects import image_effects
from stages.hardware.device import compute_device, cores
from stages.io.files import read_scene
from stages.train import Config
from stages.train.data import dataset_with_depths
from stages.train.fields.field_list import field_of, make_trainer
from stages.train.profile import FIRST_PROFILED_STEP, RATES_SECONDS, profile_table, profiled_step

LINKED = {"ingest": "photos.json", "normalise": "scene.json", "effects": "effects.json"}
WARM_STEPS, TIMED_STEPS = 300, 60
PROGRESS = 0.5  # the learning rate is still whole, steps along rays are short


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--workspace", type=Path, required=True, help="made if it is not there")
    parser.add_argument("--seconds", type=float, help="of training that sizes are for; none: the standard preset's")
    parser.add_argument("--downscale", type=float, help="photo width / trained width; none: as the seconds allow")
    parser.add_argument("--cores", type=int, help="none: all")
    add_out(parser)
    given = parser.parse_args()
    workspace = given.workspace.absolute()
    pipeline("run", given.photos.absolute(), "-o", workspace, "--until", "effects")
    if given.cores:
        torch.set_num_threads(given.cores)
    config, trainer = prepared(workspace, Config(seconds=given.seconds, downscale=given.downscale))
    timings: dict[str, Any] = {}
    device = torch.device(compute_device())
    with use_matmul_precision(config.matmul):
        for step in range(WARM_STEPS):
            trainer.step(step, PROGRESS, 1.0)
        for step in range(WARM_STEPS, WARM_STEPS + TIMED_STEPS):
            profiled_step(partial(trainer.step, step, PROGRESS, 1.0), FIRST_PROFILED_STEP, timings, device)
        field = field_of(config)
        rates = measure_rates(device, field.matmul_width(config), field.table_rows(config), RATES_SECONDS)
        table = profile_table(timings, rates)
    report(table)
    Record(given.out).add(
        set=given.photos.name,
        downscale=config.downscale,
        seconds=given.seconds,
        colours_per_step=config.grid.target_samples,
        step_ms=round(1e3 * table["seconds"] / TIMED_STEPS, 1),
        at_machine_rates_percent=round(100 * table["efficiency"]),
        **{f"{row['span']}_percent": round(100 * row["share"]) for row in table["spans"]},
    )


def prepared(workspace: Path, asked: Config) -> tuple[Config, FieldTrainer]:
    """A fresh field with all that its first step needs, as stage train makes it, and the settings that the stage chose,
    which are printed."""
    config, scene, dataset, decisions = loaded(workspace, asked)
    return config, make_trainer(
        config, scene, dataset, config.seed, image_effects(decisions, scene, scene.of_split("train"), dataset)
    )


def loaded(workspace: Path, asked: Config) -> tuple[Config, Scene, RayDataset, Decisions]:
    """What a fresh field is made of: the settings that stage train chose, which are printed, and its inputs."""
    inputs = {stage: stage_folder(workspace, output) for stage, output in LINKED.items()}
    scene, config = read_scene(inputs["normalise"]), plan_stage(train.STAGE, asked, inputs, PlainDisplay())
    assert config.downscale, "plan() chooses it"
    grid = config.grid
    sizes = f"{grid.num_levels} grids of 2^{grid.log2_hashmap_size} rows to {grid.max_res}³"
    sizes += f", photos at 1/{config.downscale:g}"
    of_step = (
        f"{grid.target_samples:,} colours in a step of {grid.micro_batches} micro-batches, {cores()} cores at work"
    )
    print(f"{sizes}, {of_step}", flush=True)
    dataset = dataset_with_depths(inputs, scene, config.downscale, PlainDisplay()).to(compute_device())
    return config, scene, dataset, read_decisions(inputs["effects"])


def report(table: dict[str, Any]) -> None:
    """Print the table."""
    speeds = "  ".join(
        f"{table[name] / table['seconds']:,.0f} {name}/s"
        for name in ("rays", "colour_evaluations", "density_evaluations")
    )
    print(f"{speeds}  {1e3 * table['seconds'] / TIMED_STEPS:.1f} ms a step, of {cores()} cores:")
    for row in table["spans"]:
        least = f"{1e3 * row['min_seconds'] / TIMED_STEPS:6.2f} ms at the machine's rates" if row["min_seconds"] else ""
        print(f"  {row['span']:10s} {1e3 * row['seconds'] / TIMED_STEPS:6.2f} ms {100 * row['share']:5.1f} %  {least}")
    print(f"{100 * table['efficiency']:.0f} % of the computed time at the machine's rates")
    print(f"at most {table['max_rays_per_second']:,.0f} rays/s")


if __name__ == "__main__":
    main()
