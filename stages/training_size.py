"""At what size to train: as large as the budget can make use of."""

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerf.paper import PaperSettings
    from nerf.ray_bank import RayBank
    from nerf.scene import Scene
    from nerf.training import TrainerSettings

LEAST_LONG_SIDE = 150  # pixels: below this a photo shows too little to judge anything by
TIMED_SECONDS = 1.0
MOST_TIMED_RAYS = {"cpu": 256, "cuda": 1 << 20}
"""A CPU is as fast on small batches, and a small one keeps the published model's steps short; a GPU is not."""


def chosen_downscale(scene: "Scene", rays: float) -> float:
    """How many times smaller than the photos to train, for a budget of ``rays``, in tenths rounded down.

    Every pixel of the training photos is then drawn about once: more pixels than rays would be decoded for
    nothing, and with fewer the run would see the same ones again while finer ones were to be had. The long side
    keeps LEAST_LONG_SIDE pixels, and photos are never enlarged.
    """
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    pixels = sum(camera.width * camera.height for camera in cameras)
    most = min(max(camera.width, camera.height) for camera in cameras) / LEAST_LONG_SIDE
    return max(1.0, math.floor(10 * min(math.sqrt(pixels / rays), most)) / 10)


def rays_per_second(scene: "Scene", field: "PaperSettings", trainer: "TrainerSettings", device: str) -> float:
    """Measured training speed: steps of a fresh field on a grey picture, for about a second."""
    from nerf.paper import PaperNerf
    from nerf.training import PaperTrainer

    batch_rays = min(trainer.batch_rays, MOST_TIMED_RAYS[device])
    model = PaperNerf(field, seed=0).to(device)
    timed = PaperTrainer(model, _grey_bank(scene).to(device), replace(trainer, batch_rays=batch_rays))
    timed.step(0, 0.0)  # the first step pays for memory and kernels
    started, steps = time.perf_counter(), 0
    while steps == 0 or time.perf_counter() - started < TIMED_SECONDS:
        steps += 1
        timed.step(steps, 0.0)
    return steps * batch_rays / (time.perf_counter() - started)


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
