"""The hash-grid field on a GPU: PSNR against seconds of training, where a step's time goes, and frames a second.

    python -m benchmarks.gpu_field prepare WORKSPACE FILE
    python -m benchmarks.gpu_field run FILE --photos FOLDER --seconds 10 30 [--profile] [--out JSON]

``prepare`` needs a workspace whose stages are done up to normalise, and writes its rays; ``run`` needs torch, Warp and
Pillow alone, so that a machine with a GPU needs nothing else. ``--photos`` is the folder of the workspace's own photos
(``output/images``). Training starts afresh for each number of seconds, with the sizes a GPU has by default; the first
steps, which compile kernels, are not counted.
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
from safetensors.torch import save_file

from benchmarks.record import Record, add_out
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.rays import Rays
from nerf.kernels import warp
from nerf.rendering.images import render_image
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.metrics import mean_squared_error, psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import over

DEVICE = torch.device("cuda")
SHOWN = {"ingest": "images", "normalise": "scene.json"}  # by what output/ links to, the folder of a stage
TARGET_SAMPLES, LEARNING_RATE = 1 << 18, 2e-2  # of a step on a GPU, as stages/train chooses them
WARMUP_STEPS, PROFILED_STEPS = 30, 20


def prepare(workspace: Path, file: Path) -> None:
    """Write what training needs of a workspace, but for the pixels of its photos."""
    # Here alone: they read cameras by pycolmap, which the machine with the GPU may lack.
    from stages.io.files import read_scene
    from stages.train.data import guided_dataset, training_dataset

    class Silent:
        def update(self, message: str, done: float | None = None) -> None: ...
        def note(self, message: str) -> None: ...

    folders = {name: (workspace / "output" / shown).resolve().parent for name, shown in SHOWN.items()}
    scene = read_scene(folders["normalise"])
    train = guided_dataset(folders, scene, 1.0, Silent())
    test = training_dataset(folders["ingest"], scene, "test", 1.0, Silent())
    views = {split: [view.file for view in scene.of_split(split)] for split in ("train", "test")}
    tables = {
        f"{split}.{name}": table.contiguous()
        for split, dataset in (("train", train), ("test", test))
        for name, table in dataset._asdict().items()
        if name != "pixels" and table is not None
    }
    facts = {"files": views, "alpha": scene.has_alpha, "bounded": scene.bounded}
    save_file(tables, file, {"facts": json.dumps(facts)})


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
        sizes |= {"max_res": 2048, "base_res": 8, "contracted": True, "min_step_size": step, "cone_angle": step / 0.25}
    settings = HashGridSettings(**sizes, background_model=not bounded and not alpha)
    field = HashGridField(settings, 0, warp).to(DEVICE)
    losses = {"depth_loss": 0.1} | ({} if bounded else {"distortion": 2e-3, "least_photos": 3})
    how = HashGridTrainerSettings(
        0, "random" if alpha else (0.0, 0.0, 0.0), target_samples, rate=LEARNING_RATE, **losses
    )
    return HashGridTrainer(field, dataset, how)


def train(trainer: HashGridTrainer, seconds: float) -> dict[str, float]:
    """Train for so many seconds; steps, and rays and colours a second."""
    for step in range(WARMUP_STEPS):
        trainer.step(step, 0.0)
    torch.cuda.synchronize()
    started, step, rays, samples, densities = time.perf_counter(), WARMUP_STEPS, 0, 0, 0
    while (elapsed := time.perf_counter() - started) < seconds:
        done = trainer.step(step, elapsed / seconds)
        step, rays, samples, densities = step + 1, rays + done.rays, samples + done.samples, densities + done.densities
    torch.cuda.synchronize()
    elapsed, steps = time.perf_counter() - started, step - WARMUP_STEPS
    return {
        "steps": steps,
        "step_ms": round(1000 * elapsed / steps, 2),
        "rays_per_second": round(rays / elapsed),
        "colours_per_ray": round(samples / rays, 1),
        "densities_per_ray": round(densities / rays, 1),
    }


def score(field: HashGridField, dataset: RayDataset) -> dict[str, float]:
    """Mean PSNR (dB) of the test photos, and the seconds that one takes."""
    white, values = torch.full((3,), float(dataset.pixels.shape[1] == 4), device=DEVICE), []
    for view in (0, *range(len(dataset.near))):  # the first once more, beforehand: it compiles kernels
        if len(values) == 1:
            torch.cuda.synchronize()
            started = time.perf_counter()
        first, end = int(dataset.first_pixel[view]), int(dataset.first_pixel[view + 1])
        width = int(dataset.layout[1, view])
        rays, colour, alpha, _ = dataset.lookup(torch.arange(first, end, device=DEVICE))
        whole = Rays(*(part.reshape(-1, width, *part.shape[1:]) for part in rays))
        seen = render_image(field, whole, white).colour.clamp(0, 1)
        values.append(psnr(mean_squared_error(seen, over(colour, alpha, white).view_as(seen))))
    torch.cuda.synchronize()
    seconds, frames = time.perf_counter() - started, len(values) - 1
    return {
        "psnr": round(sum(values[1:]) / frames, 2),
        "frame_ms": round(1000 * seconds / frames, 1),
        "pixels_per_second": round(frames * (end - first) / seconds),
    }


def profile(trainer: HashGridTrainer, test: RayDataset, step: int) -> None:
    """Print the kernels that take most of a step, and of a rendered photo, with the host's share of both."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    one_photo = test._replace(first_pixel=test.first_pixel[:2], geometry=test.geometry[:, :1])
    for name, runs, run in (
        ("step", PROFILED_STEPS, lambda: [trainer.step(step + each, 0.9) for each in range(PROFILED_STEPS)]),
        ("frame", 1, lambda: score(trainer.model, one_photo)),
    ):
        with torch.profiler.profile(activities=activities) as seen:
            run()
            torch.cuda.synchronize()
        events = [event for event in seen.events() if event.device_type == torch.autograd.DeviceType.CUDA]
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
    for seconds in given.seconds:
        trainer = new_trainer(datasets["train"], bounded, given.target_samples)
        trained = train(trainer, seconds)
        record.add(
            set=given.file.stem,
            train_seconds=seconds,
            matmul=given.matmul,
            **score(trainer.model, datasets["test"]),
            **trained,
        )
        if given.profile and seconds == given.seconds[-1]:
            profile(trainer, datasets["test"], WARMUP_STEPS + int(trained["steps"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    preparing = commands.add_parser("prepare")
    preparing.add_argument("workspace", type=Path)
    preparing.add_argument("file", type=Path)
    running = commands.add_parser("run")
    running.add_argument("file", type=Path)
    running.add_argument("--photos", type=Path, required=True)
    running.add_argument("--seconds", type=float, nargs="+", default=[10.0])
    running.add_argument("--target-samples", type=int, default=TARGET_SAMPLES)
    running.add_argument("--matmul", choices=("highest", "high", "medium"), default="highest")
    running.add_argument("--profile", action="store_true", help="kernels of a step and of a frame, after the last run")
    add_out(running)
    given = parser.parse_args()
    if given.command == "prepare":
        prepare(given.workspace, given.file)
    else:
        run(given)


if __name__ == "__main__":
    main()
