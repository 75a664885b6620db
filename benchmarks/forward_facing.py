"""Trains a hash-grid field on forward-facing photos under each space map, for equal colour evaluations.

python -m benchmarks.forward_facing fern.nerf --steps 1500 --out benchmarks/results/forward_facing.json
python -m benchmarks.forward_facing fern.nerf --device cuda --steps 4000 --maps ndc contraction --max-res 1024 2048

A workspace needs its stages up to normalise, and ingest's images. Photos are trained and scored at their full size:
PSNR over --pixels pixels of each test photo, drawn once. What is not given is as stage train has it. ``cpu_seconds``
is the time of all cores together, without scoring.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import Record, add_out
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.contraction import Contraction
from nerf.rendering.images import render_image
from nerf.runtime.parallel import take_over_cores, workers
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.psnr import psnr
from nerf.training.ray_dataset import RayDataset
from stages.contract import SilentProgress
from stages.effects.decisions import Space
from stages.hardware.backend import load_backend
from stages.io.files import read_json, read_scene
from stages.train.data import dataset_with_depths, training_dataset
from stages.train.fields.hash_grid import (
    BASE_RES,
    DEPTH_LOSS,
    DISTORTION,
    EVEN_UNTIL,
    LEARNING_RATES,
    LONG_STEPS_UNTIL,
    MAX_STEPS,
    MIN_PHOTOS,
    NDC_STEPS_PER_CELL,
)
from stages.train.fields.space import enclosing_pyramid

SPACES: dict[str, Space] = {"box": "bounded", "contraction": "contracted", "ndc": "ndc"}
BLACK = (0.0, 0.0, 0.0)
STEPS_ACROSS = 1536  # of contracted space, as stage train has them
RECORDED = (1 / 8, 1 / 4, 1 / 2, 1)  # shares of a run at which it is scored


def variants(given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Every run that the options ask for."""
    names = ("map", "num_levels", "max_res", "distortion", "diagonal_steps", "learning_rate", "seed")
    choices = (
        *(given.maps, given.num_levels, given.max_res, given.distortion),
        *(given.diagonal_steps, given.learning_rate, given.seeds),
    )
    for values in product(*choices):
        run: dict[str, Any] = dict(zip(names, values, strict=True))
        space = SPACES[run["map"]]
        usual = {
            "distortion": DISTORTION[space],
            "diagonal_steps": round(NDC_STEPS_PER_CELL * run["max_res"]) if space == "ndc" else MAX_STEPS,
            "learning_rate": LEARNING_RATES[space],
        }
        unused = {"contraction": {"diagonal_steps": None}, "box": {"distortion": None}}.get(run["map"], {})
        yield {name: usual[name] if value is None else value for name, value in run.items()} | unused


def settings_of(run: dict[str, Any], space: SpaceMap, log2_hashmap_size: int) -> HashGridSettings:
    """Sizes of the field of one run."""
    shortest = 2 * Contraction.half / STEPS_ACROSS
    return HashGridSettings(
        num_levels=run["num_levels"],
        log2_hashmap_size=log2_hashmap_size,
        base_res=BASE_RES[SPACES[space.kind]],
        max_res=run["max_res"],
        space=space,
        diagonal_steps=run["diagonal_steps"] or MAX_STEPS,
        min_step_size=shortest,
        cone_angle=shortest / EVEN_UNTIL,
        background_model=space.unbounded,
    )


def score(model: HashGridField, test: RayDataset, pixels: int) -> float:
    """Mean PSNR over the test photos, at the same ``pixels`` of each every time."""
    values = []
    for view in range(len(test.near)):
        first, end = test.first_pixel[view : view + 2].tolist()
        at = torch.randint(first, end, (min(pixels, end - first),), generator=torch.Generator().manual_seed(view))
        rays, colour, _, _ = test.lookup(at.to(test.device))
        seen = render_image(model, Rays(*(part[None] for part in rays)), torch.tensor(BLACK, device=test.device)).colour
        values.append(psnr(float((seen[0] - colour).square().mean())))
    return sum(values) / len(values)


def train(run: dict[str, Any], model: HashGridField, data: tuple[RayDataset, RayDataset], given, record: Record):
    """One run, scored on its way."""
    dataset, test = data
    trainer = HashGridTrainer(
        model,
        dataset,
        HashGridTrainerSettings(
            seed=run["seed"],
            background=BLACK,
            target_samples=given.samples,
            micro_batches=1 if given.device == "cuda" else workers(),
            learning_rate=run["learning_rate"],
            distortion_weight=run["distortion"] or 0.0,
            depth_weight=DEPTH_LOSS,
            min_photos=MIN_PHOTOS,
            long_steps_until=LONG_STEPS_UNTIL[SPACES[run["map"]]] if given.device == "cpu" else 0.0,
        ),
    )
    marks = {round(share * given.steps) for share in RECORDED}
    wall, cpu = time.perf_counter(), time.process_time()
    rays = colours = densities = 0
    errors: list[float] = []
    for step in range(given.steps):
        result = trainer.step(step, step / given.steps)
        rays, colours = rays + result.rays, colours + result.colour_evaluations
        densities += result.density_evaluations
        errors = [*errors[-49:], result.psnr]
        if step + 1 in marks:
            seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
            quality = score(model, test, given.pixels)
            record.add(
                set=given.workspace.stem,
                **run,
                steps=step + 1,
                psnr=quality,
                train_psnr=round(sum(errors) / len(errors), 2),
                million_rays=round(rays / 1e6, 2),
                million_colours=round(colours / 1e6, 1),
                colours_per_ray=round(colours / rays, 2),
                densities_per_ray=round(densities / rays, 1),
                seconds=round(seconds, 1),
                cpu_seconds=round(cpu_seconds, 1),
            )
            wall, cpu = time.perf_counter() - seconds, time.process_time() - cpu_seconds


def arguments() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--backend", choices=("warp", "torch"), default="warp")
    parser.add_argument(
        "--maps", nargs="+", choices=("box", "contraction", "ndc"), default=["contraction", "box", "ndc"]
    )
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--samples", type=int, default=None, help="colours in a step")
    parser.add_argument("--num-levels", type=int, nargs="+", default=[6])
    parser.add_argument("--log2-hashmap-size", type=int, default=18)
    parser.add_argument("--max-res", type=int, nargs="+", default=[1024])
    parser.add_argument("--distortion", type=float, nargs="+", default=[None])
    parser.add_argument("--diagonal-steps", type=int, nargs="+", default=[None], help="of box and ndc")
    parser.add_argument("--learning-rate", type=float, nargs="+", default=[None])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--pixels", type=int, default=20_000, help="of each test photo that are scored")
    add_out(parser)
    given = parser.parse_args()
    given.samples = given.samples or (1 << 18 if given.device == "cuda" else workers() << 14)
    return given


def main() -> None:
    given = arguments()
    take_over_cores()
    keys = read_json(given.workspace / "run.json")["keys"]
    inputs = {stage: given.workspace / stage / keys[stage][:16] for stage in ("ingest", "normalise")}
    scene = read_scene(inputs["normalise"])
    data = (
        dataset_with_depths(inputs, scene, 1.0, SilentProgress()),
        training_dataset(inputs["ingest"], scene, "test", 1.0, SilentProgress()),
    )
    dataset, test = (each.to(given.device) for each in data)
    ndc, record = enclosing_pyramid(scene), Record(given.out)
    print(ndc)
    maps: dict[str, SpaceMap | None] = {"box": Box(), "contraction": Contraction(), "ndc": ndc}
    backend = load_backend(given.backend, given.device)
    done = set()
    for run in variants(given):
        space = maps[run["map"]]
        if space is None or str(run) in done:
            continue
        done.add(str(run))
        model = HashGridField(settings_of(run, space, given.log2_hashmap_size), run["seed"], backend).to(given.device)
        train(run, model, (dataset, test), given, record)


if __name__ == "__main__":
    main()
