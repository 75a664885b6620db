"""Trains the grid field for one budget of steps after the other, measures each run on its way, keeps all in a file.

python -m benchmarks.budget_runs fox.nerf lego_400.nerf --runs runs.json
python -m benchmarks.budget_runs fox.nerf --constant 0.2 --schedule more --runs runs.json

A workspace needs its stages up to effects. A run that the file holds already is not made again. All runs of a set have
one size of field and of photos, those that stage train chooses where 1,000 steps draw every pixel about once; test
photos are measured at the size at which they are scored. Beside the field itself a running mean of its weights is
measured, over the last tenth of the run (Karras et al. 2024, section 3.1). benchmarks.prediction reads the file.
"""

import argparse
import json
import math
import time
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch

from nerf.effects import HeldOutImages
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.scene import Scene
from nerf.training import learning_rate
from nerf.training.evaluation_pixels import EvaluationPixels, evaluate, sample_evaluation_pixels
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.ray_dataset import RayDataset
from nerf.training.step_schedule import new_schedule
from nerf.training.trainer import FieldTrainer
from pipeline.cli.terminal import PlainDisplay
from stages.effects.decisions import Decisions, read_decisions
from stages.effects.image_effects import held_out_images, image_effects
from stages.hardware.backend import chosen_backend, load_backend
from stages.hardware.device import compute_device
from stages.io.files import read_json, read_scene
from stages.train import Config
from stages.train.data import dataset_with_depths, field_background, training_dataset
from stages.train.fields.field_list import field_of, make_trainer, with_defaults
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.space import chosen_space
from stages.train.planning import chosen_downscale

BUDGETS = (125, 250, 500, 1000, 2000)
ONCE = 1000  # steps that draw every pixel of the training photos once: it is their number that gives the photos' size
MICRO_BATCHES = 2
EVALUATION_PIXELS = 2048
PER_DOUBLING = 2  # measurements
FIRST = 32  # steps
MEAN_EVERY = 8  # steps
MEANS = {"mean_10": 6.94}  # the exponent whose profile is 10 % of the run wide
SCHEDULES = ("whole", "more")
"""more: half of the steps as a run of their own, then the other half on top (`--more`)."""


class Bench(NamedTuple):
    """What all runs of one set share."""

    config: Config
    scene: Scene
    decisions: Decisions
    dataset: RayDataset
    pixels: EvaluationPixels
    held_out: HeldOutImages


def bench_of(workspace: Path) -> Bench:
    """The photos, cameras and decisions of a workspace."""
    keys = read_json(workspace / "run.json")["keys"]
    inputs = {stage: workspace / stage / keys[stage][:16] for stage in ("ingest", "normalise", "effects")}
    scene, decisions = read_scene(inputs["normalise"]), read_decisions(inputs["effects"])
    config = with_defaults(
        Config(
            space=chosen_space(decisions, scene)[0],
            view_dependence="view_dependence" in decisions.on,
            grid=HashGridOptions(backend=chosen_backend(compute_device(), PlainDisplay()), micro_batches=MICRO_BATCHES),
        )
    )
    rays = ONCE * field_of(config).rays_per_step(config)
    downscale = chosen_downscale(scene, rays)
    config = config.model_copy(update={"downscale": downscale})
    config = field_of(config).with_sizes(config, scene, rays)
    train = dataset_with_depths(inputs, scene, downscale, PlainDisplay())
    test = training_dataset(inputs["ingest"], scene, "test", None, PlainDisplay())
    shown_over = torch.tensor(field_background(config, scene))
    pixels = sample_evaluation_pixels(test, EVALUATION_PIXELS, shown_over, seed=0)
    return Bench(
        config, scene, decisions, train, pixels, held_out_images(scene, scene.of_split("train"), scene.of_split("test"))
    )


class RunningMean:
    """A mean of the weights of which the last ones count most, over a constant share of the run."""

    def __init__(self, trainer: FieldTrainer, exponent: float) -> None:
        model = trainer.model
        assert isinstance(model, HashGridField)
        self.of, self.exponent = model, exponent
        self.model = HashGridField(model.settings, 0, model.backend)

    def add(self, step: int) -> None:
        new = 1 - max(0.0, 1 - MEAN_EVERY / step) ** (self.exponent + 1)
        for name, tensor in self.of.state_dict().items():
            if name in ("occupancy_bits", "empty_distance"):
                self.model.state_dict()[name].copy_(tensor)
            else:
                self.model.state_dict()[name].lerp_(tensor, new)


def train_run(bench: Bench, seed: int, steps: int, schedule: str) -> dict[str, Any]:
    """One run, measured at geometric steps."""
    effects = image_effects(bench.decisions, bench.scene, bench.scene.of_split("train"), bench.dataset)
    trainer = make_trainer(bench.config, bench.scene, bench.dataset, seed, effects)
    assert isinstance(trainer, HashGridTrainer)
    means = {name: RunningMean(trainer, exponent) for name, exponent in MEANS.items()}
    due = {round(steps / 2 ** (k / PER_DOUBLING)) for k in range(PER_DOUBLING * int(math.log2(steps / FIRST)) + 1)}
    plan = new_schedule(steps) if schedule == "whole" else new_schedule(steps // 2).extended_to(steps)
    points, speed, rays = [], 0.0, 0
    for step in range(steps):
        result = trainer.step(step, plan.progress(step))
        speed += (result.psnr - speed) * max(1 / (step + 1), 0.02)
        rays += result.rays
        if (step + 1) % MEAN_EVERY == 0:
            for mean in means.values():
                mean.add(step + 1)
        if step + 1 in due:
            as_expected = trainer.effects.of_held_out(bench.held_out)
            models = {"probe_psnr": trainer.model} | {name: mean.model for name, mean in means.items()}
            psnr = {name: evaluate(model, bench.pixels, as_expected).psnr for name, model in models.items()}
            points.append({"step": step + 1, "train_psnr": speed, **psnr})
    return {"rays": rays, "pixels": bench.dataset.unmasked_count, "points": points}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=int, nargs="+", default=BUDGETS)
    parser.add_argument("--schedule", choices=SCHEDULES, default="whole")
    parser.add_argument(
        "--constant", type=float, default=learning_rate.LR_HOLD_FRACTION, help="share before the rate falls"
    )
    given = parser.parse_args()
    runs = json.loads(given.runs.read_text()) if given.runs.exists() else []
    for workspace in given.workspaces:
        bench = None
        for seed, steps in product(given.seeds, given.steps):
            run = {"set": workspace.stem, "seed": seed, "steps": steps, "schedule": given.schedule}
            run["constant"] = learning_rate.LR_HOLD_FRACTION = given.constant
            if any(run.items() <= made.items() for made in runs):
                continue
            bench = bench or bench_of(workspace)
            load_backend(bench.config.grid.backend or "warp", compute_device(), PlainDisplay())
            clock = time.process_time()
            run |= train_run(bench, seed, steps, given.schedule)
            last = run["points"][-1]
            psnr = " ".join(f"{name} {last[name]:.2f}" for name in ("train_psnr", "probe_psnr", *MEANS))
            what = f"{workspace.stem} {seed} {steps} {given.schedule} {given.constant}"
            print(what, psnr, f"{time.process_time() - clock:.0f} s", flush=True)
            runs.append(run)
            given.runs.write_text(json.dumps(runs))


if __name__ == "__main__":
    main()
