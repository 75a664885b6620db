"""How fast this machine trains a field, measured for about a second."""

import time
from typing import TYPE_CHECKING

import torch

from nerf.runtime.matmul_precision import products_at
from nerf.training.ray_dataset import RayBank, build_ray_bank
from stages.effects.decisions import Decisions, photo_parts
from stages.hardware.device import compute_device
from stages.train.config import Config
from stages.train.data import MIN_LONG_SIDE, camera_directions
from stages.train.fields import field_of, make_trainer

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene

TIMED_SECONDS = 1.0


def rays_per_second(config: Config, scene: "Scene", decisions: Decisions) -> float:
    """Measured training speed."""
    device = compute_device()
    config = field_of(config).timed(config, device)
    return field_of(config).rays_per_step(config) / seconds_per_step(config, scene, decisions, device)


def seconds_per_step(config: Config, scene: "Scene", decisions: Decisions, device: str) -> float:
    """Measured: steps of a fresh field of known sizes, with its effects, on a grey picture, for about a second."""
    bank = _grey_bank(scene).to(device)
    parts = photo_parts(decisions, scene.of_split("train")[:1], bank)
    trainer = make_trainer(config, scene, bank, seed=0, photo_parts=parts)
    with products_at(config.matmul):
        trainer.step(0, 0.0, 1.0)  # the first step pays for memory and kernels
        started, steps = time.perf_counter(), 0
        while steps == 0 or time.perf_counter() - started < TIMED_SECONDS:
            steps += 1
            trainer.step(steps, 0.0, 1.0)
        return (time.perf_counter() - started) / steps


def _grey_bank(scene: "Scene") -> RayBank:
    """The rays of the first training view, of a picture that is grey all over."""
    view = scene.of_split("train")[0]
    camera = scene.cameras[view.camera]
    directions = camera_directions(camera, max(1.0, max(camera.width, camera.height) / MIN_LONG_SIDE))
    grey = torch.full((*directions.shape[:2], 3), 128, dtype=torch.uint8)
    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return build_ray_bank([grey], [0], [directions], pose[None], torch.tensor([view.near]), torch.tensor([view.far]))
