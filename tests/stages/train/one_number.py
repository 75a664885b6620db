"""A field that is one number and a training run of it, so that every kind of trouble can be staged."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from nerf.effects import NO_EFFECTS, HeldOutImages, Images
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.training.evaluation_pixels import EvaluationPatches, EvaluationPixels
from nerf.training.trainer import StepResult
from stages.train.loop import TrainingRun
from stages.train.state import EvaluationSets, TrainingBudget, TrainingLog
from stages.train.validation_images import HeldOutEvaluation, Target


class Killed(BaseException):
    """Stands for kill -9: nothing in the loop may handle it."""


class OneNumber:
    """Trains one number; ``trouble(step, lr_scale)`` may raise. Its model paints ``shown``, 20 dB from the truth."""

    chunk_rays = 64
    effects = NO_EFFECTS

    def __init__(self, seed: int, trouble: Callable[[int, float], None]) -> None:
        self.seed, self.trouble = seed, trouble
        self.value = torch.tensor(float(seed))
        self.history: list[tuple[int, float, float]] = []
        self.opacity, self.shown = 1.0, pixels().colours + 0.1

    @property
    def model(self) -> "OneNumber":
        return self

    def step(self, step: int, progress: float, lr_scale: float) -> StepResult:
        self.trouble(step, lr_scale)
        self.history.append((step, progress, lr_scale))
        self.value = self.value * 0.9 + lr_scale * (1 - progress) * torch.sin(torch.tensor(float(step)))
        return StepResult(float(self.value), 20.0, rays=4, colour_evaluations=12, density_evaluations=20)

    def state(self) -> dict[str, Tensor]:
        return {"value": self.value}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.value = state["value"].clone()

    def density(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def density_and_colour(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def render(self, rays: Rays, background: Tensor) -> Rendering:
        return Rendering(self.shown.expand(*rays.near.shape, 3), rays.far, torch.full_like(rays.far, self.opacity))


def quiet(step: int, lr_scale: float) -> None:
    """No trouble."""


def slow(step: int, lr_scale: float) -> None:
    """Steps long enough for a clock."""
    time.sleep(0.003)


def pixels() -> EvaluationPixels:
    """Two rays, one to see black and one grey: a flat colour leaves a mean error of 1/16."""
    rays = Rays(torch.zeros(2, 3), torch.ones(2, 3), torch.ones(2), torch.ones(2))
    return EvaluationPixels(rays, torch.tensor([[0.0] * 3, [0.5] * 3]), torch.zeros(3), torch.tensor([0, 1]))


def held_out() -> HeldOutEvaluation:
    """The same rays; their patches are too small for SSIM."""
    photos = HeldOutImages(Images(torch.zeros(2, 3, 4), torch.zeros(2, dtype=torch.int64), torch.ones(2)), torch.eye(2))
    patches = EvaluationPatches(pixels(), torch.ones(2, 1, 1, dtype=torch.bool))
    return HeldOutEvaluation(pixels(), patches, photos)


def run_in(
    folder: Path,
    progress,
    budget: TrainingBudget | None = None,
    make=None,
    target: Target | None = None,
    checkpoint_seconds: float | None = 1e-9,
) -> TrainingRun:
    folder.mkdir(exist_ok=True)
    maker, evaluation_sets = (
        make or (lambda attempt: OneNumber(attempt, quiet)),
        EvaluationSets(pixels(), held_out(), target),
    )
    budget, log = budget or TrainingBudget(40, None), TrainingLog(folder, False)
    return TrainingRun(maker, evaluation_sets, budget, folder, checkpoint_seconds, log, progress)


def number_of(run: TrainingRun) -> OneNumber:
    assert isinstance(run.trainer, OneNumber)
    return run.trainer


def events(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def killed_at(step: int) -> Callable[[int], OneNumber]:
    def trouble(now: int, lr_scale: float) -> None:
        if now == step:
            raise Killed
        slow(now, lr_scale)

    return lambda attempt: OneNumber(attempt, trouble)
