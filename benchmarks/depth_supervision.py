"""What depth supervision is worth: pairs of trainings of equal steps, with the depth maps of stage depth and without.

    pipeline run PHOTOS --until depth
    python -m benchmarks.depth_supervision PHOTOS.nerf … --downscale 2 --steps 600 1500 --seeds 0 1 2
    python -m benchmarks.depth_supervision PHOTOS.nerf --downscale 1 --seconds 60 180 300 --depth-seconds 12

With --seconds trainings have equal time instead, the depth maps paid for: --depth-seconds is what `pipeline depth`
said; with --cpu all are of the cores together, for a machine where others work. A row for each workspace, number of
steps or seconds, finest grid, seed and arm. Everything but the depth maps is the same, and as stage train has it, with
view dependence and a background model. PSNR and SSIM are of --tiles tiles of the test photos at full size.
``early_rays_percent``: rays of a step in the first tenth of the steps over those in the last tenth, at equal colour
evaluations; ``early_rays_per_second_percent``: rays of the first ten seconds over those of the last ten.
``cpu_seconds`` are of all cores, without scoring; what stage depth took is not in them.
"""

import argparse
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import Record, add_out
from nerf.rendering.images import render_image
from nerf.runtime.parallel import take_over_cores
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.psnr import psnr
from nerf.training.ray_dataset import RayDataset
from pipeline.engine.workspace import Workspace
from stages.contract import Inputs, SilentProgress
from stages.effects.decisions import Decisions
from stages.effects.image_effects import image_effects
from stages.hardware.backend import chosen_backend
from stages.hardware.device import compute_device
from stages.io.files import read_scene
from stages.tradeoff.benchmark import Benchmark, make_benchmark
from stages.train.config import Config
from stages.train.data import dataset_with_depths
from stages.train.fields.field_list import make_trainer, with_defaults
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.space import chosen_space

DECISIONS = Decisions({"view_dependence": {}, "background": {}})
MICRO_BATCHES = 2  # fixed, so that results of equal steps do not depend on the machine
TIMED_SECONDS = 10.0  # at the beginning and at the end


def config_of(scene: Any, given: argparse.Namespace, run: dict[str, Any]) -> Config:
    """What stage train would be given."""
    grid = HashGridOptions(
        backend=chosen_backend(compute_device()),
        micro_batches=MICRO_BATCHES,
        num_levels=given.num_levels,
        log2_hashmap_size=given.log2_hashmap_size,
        max_res=run["max_res"],
        target_samples=given.samples,
    )
    space, _ = chosen_space(DECISIONS, scene)
    return with_defaults(
        Config(
            steps=run["steps"],
            seconds=run["seconds"],
            downscale=given.downscale,
            space=space,
            view_dependence=True,
            grid=grid,
        )
    )


def scores(trainer: HashGridTrainer, benchmark: Benchmark) -> tuple[float, float]:
    """Mean PSNR and SSIM over the test photos."""
    black, values = torch.zeros(3), []
    for crop in benchmark.crops:
        seen = render_image(trainer.model, crop.rays, black).colour
        error = (seen - crop.truth).square()
        values.append((psnr(float((error if crop.mask is None else error[crop.mask]).mean())), crop.ssim(seen) or 0.0))
    both = torch.tensor(values, dtype=torch.float64).mean(0)
    return float(both[0]), float(both[1])


def train(
    config: Config,
    scene: Any,
    dataset: RayDataset,
    run: dict[str, Any],
    benchmark: Benchmark,
    clock: Callable[[], float],
) -> dict[str, Any]:
    """One run's figures, its seconds by this clock."""
    effects = image_effects(DECISIONS, scene, scene.of_split("train"), dataset)
    trainer = make_trainer(config, scene, dataset, run["seed"], effects)
    assert isinstance(trainer, HashGridTrainer)
    cpu, began = time.process_time(), clock()
    rays, ends, colours, densities = list[int](), list[float](), 0, 0
    while (progress := _progress(run, len(rays), clock() - began)) < 1:
        result = trainer.step(len(rays), progress)
        rays.append(result.rays)
        ends.append(clock() - began)
        colours, densities = colours + result.colour_evaluations, densities + result.density_evaluations
    cpu = time.process_time() - cpu
    tenth = max(1, len(rays) // 10)
    early, late = (
        sum(r for r, end in zip(rays, ends, strict=True) if low < end <= low + TIMED_SECONDS)
        for low in (0, ends[-1] - TIMED_SECONDS)
    )
    of_psnr, of_ssim = scores(trainer, benchmark)
    return {
        "psnr": round(of_psnr, 3),
        "ssim": round(of_ssim, 4),
        "trained_steps": len(rays),
        "million_rays": round(sum(rays) / 1e6, 3),
        "early_rays_percent": round(100 * sum(rays[:tenth]) / sum(rays[-tenth:])),
        "early_rays_per_second_percent": round(100 * early / late) if run["seconds"] else None,
        "million_colours": round(colours / 1e6, 1),
        "million_densities": round(densities / 1e6, 1),
        "cpu_seconds": round(cpu, 1),
    }


def _progress(run: dict[str, Any], step: int, elapsed: float) -> float:
    """How much of the run is over."""
    return step / run["steps"] if run["steps"] else elapsed / run["seconds"]


def datasets(inputs: Inputs, scene: Any, downscale: float) -> dict[str, RayDataset]:
    """By the arm what it is trained on."""
    on = dataset_with_depths(inputs, scene, downscale, SilentProgress(), inputs["depth"])
    return {"off": on._replace(depth_maps=None), "on": on}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--downscale", type=float, default=2.0)
    amount = parser.add_mutually_exclusive_group(required=True)
    amount.add_argument("--steps", type=int, nargs="+")
    amount.add_argument("--seconds", type=float, nargs="+", help="of depth maps and training together")
    parser.add_argument("--cpu", action="store_true", help="count seconds of CPU, of all cores together")
    parser.add_argument("--depth-seconds", type=float, help="of the depth maps, with --seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--max-res", type=int, nargs="+", default=[1024])
    parser.add_argument("--num-levels", type=int, default=6)
    parser.add_argument("--log2-hashmap-size", type=int, default=18)
    parser.add_argument("--samples", type=int, default=1 << 14, help="colour evaluations of a step")
    parser.add_argument("--tiles", type=int, default=384)
    add_out(parser)
    given = parser.parse_args()
    if (given.seconds is None) != (given.depth_seconds is None):
        parser.error("--seconds and --depth-seconds go together")
    record = Record(given.out)
    take_over_cores()
    for root in given.workspaces:
        workspace = Workspace(root)
        keys = workspace.read_run().keys
        inputs = {stage: workspace.folder(stage, keys[stage]) for stage in ("ingest", "normalise", "depth")}
        scene = read_scene(inputs["normalise"])
        arms = datasets(inputs, scene, given.downscale)
        benchmark = make_benchmark(inputs["ingest"], scene, None, given.tiles, 4.0)
        for amount, max_res, seed, arm in product(given.steps or given.seconds, given.max_res, given.seeds, arms):
            paid = given.depth_seconds if given.seconds and arm == "on" else 0.0
            run = {"depth": arm, "seed": seed, "max_res": max_res}
            run |= {"steps": amount if given.steps else None, "seconds": amount - paid if given.seconds else None}
            config, clock = config_of(scene, given, run), time.process_time if given.cpu else time.perf_counter
            figures = train(config, scene, arms[arm], run, benchmark, clock)
            record.add(set=root.stem, **run, **figures)


if __name__ == "__main__":
    main()
