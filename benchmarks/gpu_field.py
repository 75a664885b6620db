"""The hash-grid field on a GPU: PSNR against seconds of training, where a step's time goes, and frames a second.

    python -m benchmarks.gpu_dataset WORKSPACE FILE
    python -m benchmarks.gpu_field FILE --photos FOLDER --seconds 10 30 [--profile] [--out JSON]

The first command writes the rays of a workspace; the second needs torch, Warp and Pillow alone, so that a machine
with a GPU needs nothing else. ``--photos`` is the folder of the workspace's own photos (``output/images``). Training
starts afresh for each number of seconds, with the sizes a GPU has by default; the first steps, which compile kernels,
are not counted. With ``--exchange``, under ``torchrun --nproc-per-node 1 -m``, every step takes the way of several
GPUs, over NCCL: what that costs beside the way of one.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import safe_open
from torch.distributed.rendezvous import rendezvous

from benchmarks.record import Record, add_out
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.interface import RadianceModel
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.contraction import Contraction
from nerf.kernels import warp
from nerf.rendering.images import render_image
from nerf.runtime.ranks import Ranks
from nerf.training.data_parallel import LeadingTrainer
from nerf.training.graph_trainer import GraphTrainer
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.psnr import mean_squared_error, psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import FieldTrainer, composite_over

DEVICE = torch.device("cuda")
TARGET_SAMPLES, LEARNING_RATE = 1 << 18, 2e-2  # of a step on a GPU, as stages/train chooses them
WARMUP_STEPS, PROFILED_STEPS = 30, 20


def load(file: Path, photos: Path) -> tuple[dict[str, RayDataset], bool]:
    """The datasets of training and test photos on the GPU, and whether the scene is bounded."""
    with safe_open(file, "pt") as prepared:
        facts = json.loads(prepared.metadata()["facts"])
        tables = {name: prepared.get_tensor(name) for name in prepared.keys()}  # noqa: SIM118  # no dict
    mode, datasets = "RGBA" if facts["alpha"] else "RGB", {}
    for split, names in facts["files"].items():
        images = [np.asarray(Image.open(photos.parent / name).convert(mode)).reshape(-1, len(mode)) for name in names]
        own = {name.removeprefix(f"{split}."): table for name, table in tables.items() if name.startswith(split)}
        datasets[split] = RayDataset(pixels=torch.from_numpy(np.concatenate(images)), **own).to(DEVICE)
    return datasets, facts["bounded"]


def new_trainer(dataset: RayDataset, bounded: bool, target_samples: int) -> HashGridTrainer:
    """A fresh field and its trainer, with the sizes that stages/train gives a large budget on a GPU."""
    alpha = dataset.pixels.shape[1] == 4
    sizes: dict[str, Any] = {"num_levels": 8, "log2_hashmap_size": 20}
    if bounded:
        sizes |= {"max_res": 1024, "diagonal_steps": 576}
    else:
        step = 4 / (1.5 * 2048)
        sizes |= {
            "max_res": 2048,
            "base_res": 8,
            "space": Contraction(),
            "min_step_size": step,
            "cone_angle": step / 0.25,
        }
    settings = HashGridSettings(**sizes, background_model=not bounded and not alpha)
    field = HashGridField(settings, 0, warp).to(DEVICE)
    losses: dict[str, Any] = {"depth_weight": 0.1} | ({} if bounded else {"distortion_weight": 2e-3, "min_photos": 3})
    how = HashGridTrainerSettings(
        0, "random" if alpha else (0.0, 0.0, 0.0), target_samples, learning_rate=LEARNING_RATE, **losses
    )
    return HashGridTrainer(field, dataset, how)


def joined() -> Ranks:
    """The ranks that torchrun has started."""
    store, rank, size = next(rendezvous("env://"))
    return Ranks.join(store, rank, size, DEVICE)


def train(trainer: FieldTrainer, seconds: float) -> dict[str, float]:
    """Train for so many seconds; steps, and rays and colours a second."""
    for step in range(WARMUP_STEPS):
        trainer.step(step, 0.0, 1.0)
    torch.cuda.synchronize()
    started, step, rays, colours, densities = time.perf_counter(), WARMUP_STEPS, 0, 0, 0
    while (elapsed := time.perf_counter() - started) < seconds:
        done = trainer.step(step, elapsed / seconds, 1.0)
        step, rays = step + 1, rays + done.rays
        colours, densities = colours + done.colour_evaluations, densities + done.density_evaluations
    torch.cuda.synchronize()
    elapsed, steps = time.perf_counter() - started, step - WARMUP_STEPS
    return {
        "steps": steps,
        "step_ms": round(1000 * elapsed / steps, 2),
        "rays_per_second": round(rays / elapsed),
        "colours_per_ray": round(colours / rays, 1),
        "densities_per_ray": round(densities / rays, 1),
    }


def score(field: RadianceModel, dataset: RayDataset) -> dict[str, float]:
    """Mean PSNR (dB) of the test photos, and the seconds that one takes."""
    white = torch.full((3,), float(dataset.pixels.shape[1] == 4), device=DEVICE)

    def psnr_of(view: int) -> float:
        pixels = torch.arange(int(dataset.first_pixel[view]), int(dataset.first_pixel[view + 1]), device=DEVICE)
        rays, colour, alpha, _ = dataset.lookup(pixels)
        whole = Rays(*(part.reshape(-1, int(dataset.width[view]), *part.shape[1:]) for part in rays))
        seen = render_image(field, whole, white).colour.clamp(0, 1)
        return psnr(mean_squared_error(seen, composite_over(colour, alpha, white).view_as(seen)))

    psnr_of(0)  # compiles kernels
    started, views = time.perf_counter(), len(dataset.near)
    values = [psnr_of(view) for view in range(views)]
    seconds = time.perf_counter() - started
    return {
        "psnr": round(sum(values) / views, 2),
        "frame_ms": round(1000 * seconds / views, 1),
        "pixels_per_second": round(int(dataset.first_pixel[views]) / seconds),
    }


def profile(trainer: FieldTrainer, test: RayDataset, step: int) -> None:
    """Print the kernels that take most of a step, and of a rendered photo, with the host's share of both."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    one_photo = test._replace(first_pixel=test.first_pixel[:2], view_geometry=test.view_geometry[:, :1])
    for name, runs, run in (
        ("step", PROFILED_STEPS, lambda: [trainer.step(step + each, 0.9, 1.0) for each in range(PROFILED_STEPS)]),
        ("frame", 1, lambda: score(trainer.model, one_photo)),
    ):
        with torch.profiler.profile(activities=activities) as seen:
            run()
            torch.cuda.synchronize()
        events = [event for event in seen.events() or [] if event.device_type.name == "CUDA"]
        totals: dict[str, tuple[float, int]] = {}
        for event in events:
            time_us, count = totals.get(event.name, (0.0, 0))
            totals[event.name] = time_us + event.device_time_total, count + 1
        busy = sum(time_us for time_us, _ in totals.values())
        print(f"{name}: {busy / runs / 1000:.2f} ms of the GPU in {len(events) / runs:.0f} kernels and copies")
        for kernel, (time_us, count) in sorted(totals.items(), key=lambda each: -each[1][0])[:28]:
            print(f"  {time_us / runs:9.1f} us  {count / runs:6.1f} x  {kernel[:110]}")


def run(given: argparse.Namespace) -> None:
    record = Record(given.out)
    datasets, bounded = load(given.file, given.photos)
    torch.set_float32_matmul_precision(given.matmul)
    ranks = joined() if given.exchange else None
    for seconds in given.seconds:
        trainer: FieldTrainer
        trainer = new_trainer(datasets["train"], bounded, given.target_samples)
        if ranks is not None:
            trainer = LeadingTrainer(trainer, 0, ranks)
        elif given.graph:
            trainer = GraphTrainer(trainer)
        trained = train(trainer, seconds)
        record.add(
            set=given.file.stem,
            train_seconds=seconds,
            matmul=given.matmul,
            refused=trainer.refused if isinstance(trainer, GraphTrainer) else None,
            graph=given.graph and not given.exchange,
            exchange="" if ranks is None else ranks.backend,
            **score(trainer.model, datasets["test"]),
            **trained,
        )
        if given.profile and seconds == given.seconds[-1]:
            profile(trainer, datasets["test"], WARMUP_STEPS + int(trained["steps"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--seconds", type=float, nargs="+", default=[10.0])
    parser.add_argument("--target-samples", type=int, default=TARGET_SAMPLES)
    parser.add_argument("--matmul", choices=("highest", "high", "medium"), default="highest")
    parser.add_argument("--no-graph", dest="graph", action="store_false", help="launch operations one by one")
    parser.add_argument("--exchange", action="store_true", help="by torchrun's ranks, as several GPUs do")
    parser.add_argument("--profile", action="store_true", help="kernels of a step and of a frame, after the last run")
    add_out(parser)
    run(parser.parse_args())


if __name__ == "__main__":
    main()
