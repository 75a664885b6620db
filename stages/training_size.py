"""At what size to train, photos and field: as large as the budget can make use of."""

import math
import time
from collections.abc import Mapping
from statistics import median
from typing import TYPE_CHECKING

from stages.device import compute_device, cores
from stages.effect_decisions import photo_parts
from stages.training_setup import make_trainer

if TYPE_CHECKING:
    from nerf.ray_bank import RayBank
    from nerf.scene import Scene
    from stages.effect_decisions import Decisions
    from stages.train import Config

LEAST_LONG_SIDE = 150  # pixels: below this a photo shows too little to judge anything by
MOST_PIXELS = 400e6  # of many photos, which are held in memory: 1.2 GB
MOST_PHOTOS = 48  # of 240 photos of one scene, 0.2 rays a pixel are best (docs/numbers.md)
TIMED_SECONDS = 1.0
MOST_TIMED_RAYS = {"cpu": 256, "cuda": 1 << 20}
"""For each core: one chunk of a batch. More keep a CPU no busier and make the published model's steps long; a GPU needs
many."""
SAMPLES_PER_RAY = {"bounded": 8, "contracted": 12}
"""Colours that the grid field computes for a ray, over a run: measured on lego_400 and five photo sets
(docs/numbers.md)."""
GRID_SIZES = {
    "bounded": ((50e6, 5, 18, 512), (0, 4, 17, 256)),
    "contracted": ((200e6, 6, 18, 1024), (60e6, 5, 18, 512), (0, 5, 17, 512)),
}
"""(computed colours from which on it pays, levels, log2 of rows, most cells along an axis), the largest first."""
# The same on a GPU, which reads a large table as fast as a small one.
GPU_GRID_SIZES = {"bounded": (200e6, 8, 20, 1024), "contracted": (200e6, 8, 20, 2048)}
LEAST_FINEST = 128


def chosen_downscale(scene: "Scene", rays: float, used: "Mapping[str, float] | None" = None) -> float:
    """How many times smaller than the photos to train, for a budget of ``rays``, in tenths rounded down. ``used`` says
    by name which share of its pixels a photo's mask leaves; of others all count.

    Every pixel of the training photos is then drawn about once: of larger photos some pixels would never be drawn, and
    of smaller ones all would be drawn again and again. More than MOST_PHOTOS photos show the same things several times.
    Each of them keeps the pixels that it would have as one of MOST_PHOTOS, though not all are drawn then, up to
    MOST_PIXELS in all. Long sides keep LEAST_LONG_SIDE pixels in the median, and photos are never enlarged.
    """
    views, used = scene.of_split("train"), used or {}
    cameras = [scene.cameras[view.camera] for view in views]
    shares = [used.get(view.name, 1.0) for view in views]
    pixels = sum(share * camera.width * camera.height for share, camera in zip(shares, cameras, strict=True))
    drawn = max(rays, min(rays * len(views) / MOST_PHOTOS, MOST_PIXELS))
    most = median(max(camera.width, camera.height) for camera in cameras) / LEAST_LONG_SIDE
    return max(1.0, math.floor(10 * min(math.sqrt(pixels / drawn), most)) / 10)


def grid_size(config: "Config", scene: "Scene", rays: float) -> dict[str, int]:
    """Sizes of a grid field that sees ``rays`` at ``config.downscale``: more and larger tables where there are enough
    to fill them. The finest cells are about as wide as a pixel where the region of interest fills the photo."""
    from nerf.kernels import BOX, CONTRACTED_BOX

    assert config.downscale is not None
    samples = rays * SAMPLES_PER_RAY[config.space]
    sizes = GRID_SIZES[config.space]
    if compute_device() == "cuda":
        sizes = (GPU_GRID_SIZES[config.space], *sizes)
    levels, log2_rows, most = next(row[1:] for row in sizes if samples >= row[0])
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    pixels = max(max(camera.width, camera.height) for camera in cameras) / config.downscale
    across = pixels * (CONTRACTED_BOX / BOX if config.contracted else 1)
    finest = max(LEAST_FINEST, min(most, 2 ** math.ceil(math.log2(across))))
    return {"levels": levels, "log2_rows": log2_rows, "finest": finest}


def rays_in_budget(config: "Config", scene: "Scene", decisions: "Decisions") -> float:
    """How many rays the run will draw: counted for a budget of steps, from measured speed for one of seconds."""
    if config.steps is not None:
        return config.steps * rays_per_step(config)
    assert config.seconds is not None, "one of the two is given"
    return config.seconds * rays_per_second(config, scene, decisions)


def rays_per_second(config: "Config", scene: "Scene", decisions: "Decisions") -> float:
    """Measured training speed."""
    config = timed_settings(config, compute_device())
    return rays_per_step(config) / seconds_per_step(config, scene, decisions)


def seconds_per_step(config: "Config", scene: "Scene", decisions: "Decisions") -> float:
    """Measured: steps of a fresh field of known sizes, with its effects, on a grey picture, for about a second."""
    device = compute_device()
    bank = _grey_bank(scene).to(device)
    parts = photo_parts(decisions, scene.of_split("train")[:1], bank.device)
    trainer = make_trainer(config, scene, bank, seed=0, photo_parts=parts)
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
    sizes = {"levels": config.levels or 5, "log2_rows": config.log2_rows or 18, "finest": config.finest or 512}
    return config.model_copy(update=sizes)


def rays_per_step(config: "Config") -> float:
    """Rays of one step: as set for the paper field, for the grid field expected from the colours it computes."""
    if config.field == "paper":
        assert config.batch_rays is not None
        return config.batch_rays
    assert config.batch_samples is not None
    return config.batch_samples / SAMPLES_PER_RAY[config.space]


def _grey_bank(scene: "Scene") -> "RayBank":
    """The rays of the first training view, of a picture that is grey all over."""
    import torch

    from nerf.ray_bank import build_ray_bank
    from stages.training_data import camera_directions

    view = scene.of_split("train")[0]
    camera = scene.cameras[view.camera]
    directions = camera_directions(camera, max(1.0, max(camera.width, camera.height) / LEAST_LONG_SIDE))
    grey = torch.full((*directions.shape[:2], 3), 128, dtype=torch.uint8)
    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return build_ray_bank([grey], [0], [directions], pose[None], torch.tensor([view.near]), torch.tensor([view.far]))
