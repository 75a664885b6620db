"""At what size to train, photos and field: as large as the budget can make use of."""

import math
import time
from collections.abc import Mapping
from statistics import median
from typing import TYPE_CHECKING

from stages.amounts import bytes_in_words, short_count
from stages.contract import Progress
from stages.effects.decisions import image_effects
from stages.hardware.device import compute_device, cores
from stages.hardware.memory import available_on
from stages.train.setup import field_bytes, make_trainer

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from nerf.training.ray_dataset import RayDataset
    from stages.effects.decisions import Decisions
    from stages.train import Config

LEAST_LONG_SIDE = 150  # pixels: below this a photo shows too little to judge anything by
MOST_PIXELS = 400e6  # of many photos, which are held in memory: 1.2 GB
MOST_PHOTOS = 48  # of 240 photos of one scene, 0.2 rays a pixel are best (docs/experiments/many_photos.md)
TIMED_SECONDS = 1.0
MOST_TIMED_RAYS = {"cpu": 256, "cuda": 1 << 20}
"""For each core: one chunk of a batch. More keep a CPU no busier and make the published model's steps long; a GPU needs
many."""
SAMPLES_PER_RAY = {"bounded": 3, "contracted": 10}
"""Colours that the grid field computes for a ray, over a run: measured on lego_400 and five photo sets
(docs/results.md)."""
GRID_SIZES = {
    "bounded": ((50e6, 5, 18, 512), (0, 4, 17, 256)),
    "contracted": ((30e6, 6, 18, 1024), (0, 5, 17, 512)),
}
"""(computed colours from which on it pays, levels, log2 of rows, most cells along an axis), the largest first."""
# The same on a GPU, which reads a large table as fast as a small one.
GPU_GRID_SIZES = {"bounded": (200e6, 8, 20, 1024), "contracted": (200e6, 8, 20, 2048)}
LEAST_FINEST = 128
MOST_OF_MEMORY = 0.5  # that is free: what training the field may take of it, and what the pixels may take on a GPU


def chosen_downscale(
    scene: "Scene", rays: float, used: "Mapping[str, float] | None" = None, progress: Progress | None = None
) -> float:
    """How many times smaller than the photos to train, for a budget of ``rays``, in tenths rounded down. ``used`` says
    by name which share of its pixels a photo's mask leaves; of others all count.

    Every pixel of the training photos is then drawn about once: of larger photos some pixels would never be drawn, and
    of smaller ones all would be drawn again and again. More than MOST_PHOTOS photos show the same things several times.
    Each of them keeps the pixels that it would have as one of MOST_PHOTOS, though not all are drawn then, up to
    MOST_PIXELS in all. Long sides keep LEAST_LONG_SIDE pixels in the median, and photos are never enlarged. On a GPU,
    which holds all pixels, they are made smaller still where its memory asks for that; then ``progress`` is told.
    """
    views, used = scene.of_split("train"), used or {}
    cameras = [scene.cameras[view.camera] for view in views]
    shares = [used.get(view.name, 1.0) for view in views]
    pixels = sum(share * camera.width * camera.height for share, camera in zip(shares, cameras, strict=True))
    drawn = max(rays, min(rays * len(views) / MOST_PHOTOS, MOST_PIXELS))
    most = median(max(camera.width, camera.height) for camera in cameras) / LEAST_LONG_SIDE
    wanted = max(1.0, math.floor(10 * min(math.sqrt(pixels / drawn), most)) / 10)
    if compute_device() == "cpu":  # maps the photos from the disk
        return wanted
    free = available_on("cuda")
    table = (4 if scene.has_alpha else 3) * sum(camera.width * camera.height for camera in cameras)
    least = math.ceil(10 * math.sqrt(table / max(1.0, MOST_OF_MEMORY * free))) / 10
    if least > wanted and progress:
        progress.note(
            f"photos at 1/{least:g} of their size: at 1/{wanted:g}, which the budget could make use of, their pixels "
            f"take {bytes_in_words(table / wanted**2)}, and of the GPU's memory {bytes_in_words(free)} are free"
        )
    return max(wanted, least)


def grid_size(config: "Config", scene: "Scene", rays: float, progress: Progress | None = None) -> dict[str, int]:
    """Sizes of a grid field that sees ``rays`` at ``config.downscale``: more and larger tables where there are enough
    to fill them, and MOST_OF_MEMORY holds what their training takes; else the next smaller ones, and ``progress`` is
    told. The finest cells are about as wide as a pixel where the region of interest fills the photo."""
    from nerf.kernels import BOX, CONTRACTED_BOX

    assert config.downscale is not None
    samples, device = rays * SAMPLES_PER_RAY[config.space], compute_device()
    sizes = GRID_SIZES[config.space]
    if device == "cuda":
        sizes = (GPU_GRID_SIZES[config.space], *sizes)
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    pixels = max(max(camera.width, camera.height) for camera in cameras) / config.downscale
    across = 2 ** math.ceil(math.log2(pixels * (CONTRACTED_BOX / BOX if config.contracted else 1)))
    wanted, *smaller = (
        {"levels": levels, "log2_rows": log2_rows, "finest": max(LEAST_FINEST, min(most, across))}
        for least, levels, log2_rows, most in sizes
        if samples >= least
    )
    free = available_on(device)
    fitting = (size for size in (wanted, *smaller) if _bytes_of(config, size) <= MOST_OF_MEMORY * free)
    chosen = next(fitting, [wanted, *smaller][-1])
    if chosen is not wanted and progress:
        taken = bytes_in_words(_bytes_of(config, wanted))
        progress.note(
            f"{_grids(chosen)}: {_grids(wanted)}, which the budget could fill, take {taken} while they are trained, "
            f"and {bytes_in_words(free)} of memory are free"
        )
    return chosen


def _bytes_of(config: "Config", size: dict[str, int]) -> float:
    """What training takes with these sizes, where ``config`` has none of its own."""
    own = {name: value for name in size if (value := getattr(config, name)) is not None}
    return field_bytes(config.model_copy(update=size | own), cores())


def _grids(size: dict[str, int]) -> str:
    return f"{size['levels']} grids of up to 2^{size['log2_rows']} rows"


def reason_words(config: "Config", rays: float) -> str:
    """What sizes that were left open are chosen for."""
    budget = f"{config.seconds:g} s on this machine" if config.steps is None else f"{config.steps:,} steps"
    colours = f" and compute {short_count(rays * SAMPLES_PER_RAY[config.space])} colours"
    computed = colours if config.field == "grid" else ""
    return f"{budget} draw about {short_count(rays)} rays{computed}: sizes left open are chosen for that"


def rays_in_budget(config: "Config", scene: "Scene", decisions: "Decisions") -> float:
    """How many rays the run will draw: counted for a budget of steps, from measured speed for one of seconds."""
    if config.steps is not None:
        return config.steps * rays_per_step(config)
    assert config.seconds is not None, "one of the two is given"
    return config.seconds * rays_per_second(config, scene, decisions)


def rays_per_second(config: "Config", scene: "Scene", decisions: "Decisions") -> float:
    """Measured training speed."""
    device = compute_device()
    config = timed_settings(config, device)
    return rays_per_step(config) / seconds_per_step(config, scene, decisions, device)


def seconds_per_step(config: "Config", scene: "Scene", decisions: "Decisions", device: str) -> float:
    """Measured: steps of a fresh field of known sizes, with its effects, on a grey picture, for about a second."""
    from nerf.runtime.matmul_precision import use_matmul_precision

    dataset = _grey_dataset(scene).to(device)
    effects = image_effects(decisions, scene.of_split("train")[:1], dataset)
    trainer = make_trainer(config, scene, dataset, seed=0, effects=effects)
    with use_matmul_precision(config.matmul):
        trainer.step(0, 0.0, 1.0)  # the first step pays for memory and kernels
        started, steps = time.perf_counter(), 0
        while steps == 0 or time.perf_counter() - started < TIMED_SECONDS:
            steps += 1
            trainer.step(steps, 0.0, 1.0)
        return (time.perf_counter() - started) / steps


def timed_settings(config: "Config", device: str) -> "Config":
    """Settings under which speed is measured before the grids' sizes are known."""
    if config.field == "paper":
        assert config.batch_rays is not None
        return config.model_copy(update={"batch_rays": min(config.batch_rays, MOST_TIMED_RAYS[device] * cores())})
    _, levels, log2_rows, finest = GRID_SIZES[config.space][0]  # which most budgets get
    sizes = {"levels": levels, "log2_rows": log2_rows, "finest": finest}
    return config.model_copy(update={name: value for name, value in sizes.items() if getattr(config, name) is None})


def rays_per_step(config: "Config") -> float:
    """Rays of one step: as set for the paper field, for the grid field expected from the colours it computes."""
    if config.field == "paper":
        assert config.batch_rays is not None
        return config.batch_rays
    assert config.batch_samples is not None
    return config.batch_samples / SAMPLES_PER_RAY[config.space]


def _grey_dataset(scene: "Scene") -> "RayDataset":
    """The rays of the first training view, of a picture that is grey all over."""
    import torch

    from nerf.training.ray_dataset import ray_dataset_from_images
    from stages.train.data import camera_directions

    view = scene.of_split("train")[0]
    camera = scene.cameras[view.camera]
    directions = camera_directions(camera, max(1.0, max(camera.width, camera.height) / LEAST_LONG_SIDE))
    grey = torch.full((*directions.shape[:2], 3), 128, dtype=torch.uint8)
    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return ray_dataset_from_images(
        [grey], [0], [directions], pose[None], torch.tensor([view.near]), torch.tensor([view.far])
    )
