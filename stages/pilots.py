"""Short paired trainings that tell what an effect is worth, on photos kept back from the training photos.

Both arms have the same seed, rays and number of steps and differ in nothing but the effect. The photos kept back have
an exposure (and, where poses are at stake, a pose) of their own, which neither arm knows: both are fitted to the left
half of such a photo and judged on its right half.
"""

import time
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, NamedTuple

from stages.contract import Progress
from stages.effect_decisions import Decisions, photo_parts

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.ray_bank import RayBank
    from nerf.rays import Rays
    from nerf.scene import Scene, View
    from stages.train import Config as TrainConfig

LONG_SIDE = 200  # pixels of the photos in a pilot
KEPT_EVERY = 8  # of the training photos one is kept back,
MOST_KEPT = 4  # but no more than these,
FEWEST_LEFT = 4  # and with fewer left to train on there is no pilot
SEEDS = 3
CHUNKS = 4  # fixed, so that a pilot ends the same whatever the machine
SURE = 2.0  # standard errors by which a gain must exceed 0


class Pilot(NamedTuple):
    """What switching an effect on gained on the photos kept back, in dB: mean and standard error over the seeds, and
    the seconds it took. ``cost`` is the share by which it made training slower."""

    gain_db: float
    noise_db: float
    cost: float
    seconds: float

    @property
    def pays(self) -> bool:
        """Whether the gain is more than its noise."""
        return self.gain_db > SURE * self.noise_db


class _Photo(NamedTuple):
    """A photo kept back: (height, width) rays, colours and which pixels count."""

    rays: "Rays"
    colours: "Tensor"
    used: "Tensor | None"


class PilotScene(NamedTuple):
    """What every pilot of a scene shares; make it with :func:`pilot_scene`."""

    scene: "Scene"
    bank: "RayBank"
    kept: "tuple[_Photo, ...]"


def pilot_scene(ingest: Path, scene: "Scene", progress: Progress) -> PilotScene | None:
    """Small photos to train on and to judge by, both from the training photos; None where there are too few."""
    from stages.device import compute_device
    from stages.training_data import training_bank, view_mask, view_pixels, view_rays

    views = scene.of_split("train")
    count = min(MOST_KEPT, len(views) // KEPT_EVERY) or 1
    if len(views) - count < FEWEST_LEFT:
        return None
    chosen = {views[(2 * i + 1) * len(views) // (2 * count)].name for i in range(count)}
    split = replace(scene, views=tuple(replace(v, split="test" if v.name in chosen else "train") for v in views))
    downscale = max(1.0, max(max(camera.width, camera.height) for camera in scene.cameras) / LONG_SIDE)
    bank = training_bank(ingest, split, "train", downscale, progress).to(compute_device())
    kept = tuple(
        _Photo(
            view_rays(split, view, downscale),
            view_pixels(ingest, split, view, downscale, (0.0, 0.0, 0.0)),
            view_mask(ingest, split, view, downscale),
        )
        for view in split.of_split("test")
    )
    return PilotScene(split, bank, kept)


def run_pilot(trial: PilotScene, off: Decisions, on: Decisions, steps: int, seed: int, progress: Progress) -> Pilot:
    """Train both arms for each seed and compare."""
    started, gains, seconds = time.perf_counter(), [], [0.0, 0.0]
    poses = off.pose_refinement != on.pose_refinement
    for number in range(SEEDS):
        scores = []
        for index, arm in enumerate((off, on)):
            progress.update(f"pilot training {2 * number + index + 1} of {2 * SEEDS}", (2 * number + index) / (2 * SEEDS))
            trained = time.perf_counter()
            field = _trained(trial, arm, steps, seed + number)
            seconds[index] += time.perf_counter() - trained
            scores.append(mean(_score(field, photo, poses, seed) for photo in trial.kept))
        gains.append(scores[1] - scores[0])
    noise = stdev(gains) / SEEDS**0.5
    return Pilot(mean(gains), noise, seconds[1] / seconds[0] - 1, time.perf_counter() - started)


def _trained(trial: PilotScene, arm: Decisions, steps: int, seed: int):
    """A grid field after ``steps`` steps under the decisions of one arm."""
    from stages.training_setup import make_trainer

    device = trial.bank.device
    parts = photo_parts(arm, trial.scene.of_split("train"), device)
    trainer = make_trainer(_config(arm, steps, device.type), trial.scene, trial.bank, seed, parts)
    for step in range(steps):
        trainer.step(step, step / steps, 1.0)
    return trainer.model


def _config(arm: Decisions, steps: int, device: str) -> "TrainConfig":
    """A small grid field with what stage train would choose."""
    from stages.backend import chosen_backend
    from stages.train import Config, with_habits

    return with_habits(
        Config(
            field="grid",
            steps=steps,
            contracted=arm.unbounded,
            view_dependence=arm.view_dependence,
            backend=chosen_backend(device),
            chunks=CHUNKS,
            levels=4,
            log2_rows=17,
            finest=256,
        )
    )


def _score(field, photo: _Photo, poses: bool, seed: int) -> float:
    """PSNR on the right half of a photo whose exposure (and pose) is fitted on its left half."""
    import torch

    from nerf.effects.exposure import expose, fit_log_gain
    from nerf.effects.pose_fit import fit_pose
    from nerf.metrics import mean_squared_error, psnr
    from nerf.rays import Rays
    from nerf.rendering import render_image

    black = torch.zeros(3)
    left, right = _halves(photo)
    rays = photo.rays

    def seen(rays: Rays) -> torch.Tensor:
        return render_image(field, rays, black).colour

    picture = seen(rays)
    gain = fit_log_gain(picture[left], photo.colours[left])
    if poses:
        from nerf.effects.exposures import Exposures

        pixels = Rays(*(part[left] for part in rays))
        pose = fit_pose(field, pixels, photo.colours[left], black, Exposures(gain[None]), seed)
        flat = Rays(*(part.flatten(0, 1) for part in rays))
        moved = pose.forward(flat, torch.zeros(len(flat.near), dtype=torch.int64))
        picture = seen(Rays(*(part.view_as(whole) for part, whole in zip(moved, rays, strict=True))))
        gain = fit_log_gain(picture[left], photo.colours[left])
    exposed = expose(picture[right], gain).clamp(0, 1)
    return psnr(mean_squared_error(exposed, photo.colours[right]))


def _halves(photo: _Photo) -> "tuple[Tensor, Tensor]":
    """(height, width) masks of the used pixels on the left and on the right."""
    import torch

    height, width = photo.colours.shape[:2]
    used = torch.ones(height, width, dtype=torch.bool) if photo.used is None else photo.used
    left = (torch.arange(width) < width // 2).expand(height, width)
    return used & left, used & ~left
