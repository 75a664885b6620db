"""What photos cost before the first step and in every one: time and memory of the pixel store, time of a batch.

    python -m benchmarks.pixel_store [--photos 500] [--downscale 1] [--folder DIR]

Makes synthetic photos of 12 megapixels (JPEG), builds their store, trains on it, draws batches from it, and prints
seconds, bytes and peak memory. ``file`` memory is the mapped store: the system takes it back when it needs it; ``own``
memory is not given back. Training has a process of its own, whose memory is told: the first steps that stage train
would take, of a field as large as it makes them. ``from the disk`` is a batch right after the store was dropped from
memory: what every batch costs, at worst, where the store is much larger than memory. The last lines take the same
batches from plain memory, for comparison.
"""

import argparse
import itertools
import math
import mmap
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.record import Record, add_out
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.training.pixel_sampler import PixelSampler
from nerf.training.ray_dataset import RayDataset
from pipeline.cli.terminal import PlainDisplay
from stages.hardware.backend import chosen_backend
from stages.hardware.device import compute_device
from stages.hardware.memory import available_bytes
from stages.io import pixel_store
from stages.train import Config
from stages.train.data import training_dataset
from stages.train.fields.field_list import field_of, make_trainer, with_defaults
from stages.train.fields.hash_grid_options import HashGridOptions

WIDTH, HEIGHT = 4000, 3000
DIFFERENT = 4  # photos that are painted; the others are copies
BATCHES = (4096, 8192)
REPEATS = 100
STEPS = 50  # of training


def paint(folder: Path, photos: int) -> Scene:
    """Photos with as much detail as a JPEG of a real one has, in an ingest folder, and their scene."""
    (folder / "images").mkdir(parents=True)
    views, camera = [], Camera("OPENCV", WIDTH, HEIGHT, (3000.0, 3000.0, WIDTH / 2, HEIGHT / 2, 0.1, -0.05, 0.0, 0.0))
    for index in range(photos):
        path = folder / f"images/{index:04d}.jpg"
        if index < DIFFERENT:
            coarse = np.random.default_rng(index).integers(0, 256, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
            Image.fromarray(coarse).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC).save(path, quality=92)
        else:
            path.write_bytes((folder / f"images/{index % DIFFERENT:04d}.jpg").read_bytes())
        views.append(View(path.name, f"images/{path.name}", index, np.eye(3, 4), 1.0, 9.0, "train"))
    frame = Similarity(1.0, np.eye(3), np.zeros(3))
    return Scene((camera,) * photos, tuple(views), frame, False, False, "inside-out", True)


def memory() -> dict[str, float]:
    """Peak of this process, and what it holds now, split into what is its own and what is mapped files; in GB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    now = {line.split(":")[0]: int(line.split()[1]) / 1e6 for line in lines if line.startswith("Rss")}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"peak_gb": round(peak, 2), "own_gb": round(now["RssAnon"], 2), "file_gb": round(now["RssFile"], 2)}


def milliseconds(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median and lowest duration."""
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - started))
    return {"median_ms": round(statistics.median(taken), 2), "lowest_ms": round(min(taken), 2)}


def draw(dataset: RayDataset, where: str, record: Record, repeats: int = REPEATS) -> None:
    """Time batches of rays."""
    order = PixelSampler(dataset.unmasked_count, 0, dataset.device)
    for count in BATCHES:
        places = itertools.count(step=count)
        taken = milliseconds(
            lambda n=count, p=places: dataset.lookup(dataset.unmasked_pixels(order.take(next(p), n))), repeats
        )
        record.add(what=f"{count} rays, {where}", **taken, **memory())


def train(ingest: Path, scene: Scene, downscale: float) -> dict[str, Any]:
    """The time of a step of training on a store that has been made, and the memory of the process that took it."""
    device = compute_device()
    grid = HashGridOptions(backend=chosen_backend(device, PlainDisplay()))
    config = with_defaults(Config(grid=grid, space="contracted", view_dependence=True, downscale=downscale))
    config = field_of(config).with_sizes(config, scene, rays=math.inf)
    dataset = training_dataset(ingest, scene, "train", downscale, PlainDisplay()).to(device)
    trainer, step = make_trainer(config, scene, dataset, config.seed), itertools.count()
    taken = milliseconds(lambda: trainer.step(next(step), 0.0, 1.0), STEPS)
    grid = config.grid
    sizes = f"{grid.num_levels} grids of 2^{grid.log2_hashmap_size} rows, {grid.target_samples:,} colours in a step"
    return {"what": f"a step of training: {sizes}", **taken, **memory()}


def drop_from_memory(store: Path) -> None:
    """Let the system forget a file that nobody has mapped."""
    descriptor = os.open(store, os.O_RDONLY)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(descriptor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=6)
    parser.add_argument("--downscale", type=float, default=1.0)
    parser.add_argument("--folder", type=Path, default=None, help="where to work; default: a temporary folder")
    add_out(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        measure(Path(folder) / "ingest", given.photos, given.downscale, Record(given.out))


def measure(ingest: Path, photos: int, downscale: float, record: Record) -> None:
    """Build, draw, record."""
    scene = paint(ingest, photos)
    print(f"{photos} photos of {WIDTH} x {HEIGHT}, each with its own camera, at 1/{downscale:g}")

    def opened(what: str) -> RayDataset:
        started = time.perf_counter()
        dataset = training_dataset(ingest, scene, "train", downscale, PlainDisplay())
        taken = round(1e3 * (time.perf_counter() - started))
        record.add(what=f"{what} of {photos} photos", median_ms=taken, lowest_ms=taken, **memory())
        return dataset

    opened("making the store")
    (store,) = (path for path in ingest.with_name("ingest.pixels").iterdir() if not path.suffix)
    print(f"the store: {store.stat().st_size / 1e9:.2f} GB")
    with ProcessPoolExecutor(1, get_context("spawn")) as alone:
        record.add(**alone.submit(train, ingest, scene, downscale).result())
    warm(opened("opening the store"), record)
    drop_from_memory(store)
    pixel_store.FITS = 0.0  # as if memory were too small for it
    draw(opened("opening the store from the disk"), "from the disk", record, 5)


def warm(dataset: RayDataset, record: Record) -> None:
    """Batches from a store that memory holds, and from a copy in plain memory."""
    draw(dataset, "first ones", record, 5)
    dataset.pixels.view(-1)[:: mmap.PAGESIZE].sum()
    draw(dataset, "mapped", record)
    if dataset.pixels.numel() > pixel_store.FITS * available_bytes():
        print("left out: the same from plain memory, which has no room for them")
    else:
        draw(dataset._replace(pixels=dataset.pixels.clone()), "plain memory", record)


if __name__ == "__main__":
    main()
