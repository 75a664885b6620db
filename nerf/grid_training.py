"""One optimisation step of a grid field, behind the same interface as the paper's (nerf/training.py)."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.density_cache import DensityCache
from nerf.grid_field import GridField, GridGradients, GridPass
from nerf.metrics import psnr
from nerf.model import Rendering
from nerf.randomness import generator
from nerf.ray_bank import RayBank
from nerf.rays import Rays
from nerf.training import NonFinite, StepResult

WARM_UP_STEPS = 20
CONSTANT_SHARE = 0.2  # of the run, before the rate begins to fall
FINAL_RATE = 0.05  # of the rate at first
FIRST_SAMPLES_PER_RAY = 128.0
MEMORY = 0.9  # how much of the mean of samples per ray remains after each step


@dataclass(frozen=True)
class GridTrainerSettings:
    """How to train. ``samples``: colours to compute in a step; its rays are as many as are expected to need them, at
    most ``most_rays``. ``background`` is what lies behind the scene: a colour, or another random one for each ray
    (only for photos with alpha, where it shows the field which space is empty). ``distortion``: weight of the
    distortion loss, for scenes without a known background."""

    seed: int
    background: tuple[float, float, float] | Literal["random"]
    samples: int = 1 << 14
    most_rays: int = 1 << 13
    rate: float = 2e-2
    distortion: float = 0.0


class GridBatch(NamedTuple):
    """Rays with the colour each should see over its background, and where its samples stand in their intervals."""

    rays: Rays
    target: Float[Tensor, "rays 3"]
    background: Float[Tensor, "rays 3"]
    jitter: Float[Tensor, "rays"]


class Loss(NamedTuple):
    """A loss, the mean squared error in it, and the gradients of rendering and weights."""

    value: Tensor
    squared_error: Tensor
    grad: Rendering
    grad_weights: Float[Tensor, "samples"]


def rate_factor(step: int, share: float) -> float:
    """The learning rate over its base: a linear warm-up, then constant, then falling exponentially."""
    fallen = max(0.0, share - CONSTANT_SHARE) / (1 - CONSTANT_SHARE)
    return min(1.0, (step + 1) / WARM_UP_STEPS) * FINAL_RATE**fallen


class GridTrainer:
    """Trains a grid field on the squared error of colours by Adam, and keeps its density cache."""

    def __init__(self, model: GridField, bank: RayBank, settings: GridTrainerSettings) -> None:
        self.model, self.bank, self.settings = model, bank, settings
        self.cache = DensityCache(model)
        self.parameters = {"table": model.table, **model.weights._asdict()}
        self.mean = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.square = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.grad_table = torch.zeros_like(model.table)
        self.samples_per_ray = torch.tensor(FIRST_SAMPLES_PER_RAY, dtype=torch.float64)

    def step(self, step: int, share: float, rate_scale: float = 1.0) -> StepResult:
        """One batch, one update. Raises NonFinite before the update, leaving model and optimiser as they were."""
        batch = self._batch(step)
        done = self.model.forward(batch.rays, batch.jitter, batch.background)
        loss = self._loss(done, batch.target)
        gradients = self.model.backward(done, loss.grad, loss.grad_weights)
        loss_now, error_now = self._finite(step, batch, loss, gradients)
        self._update(step, done, gradients, rate_scale * self.settings.rate * rate_factor(step, share))
        self.cache.raise_to(done.points, done.density.sigma * done.samples.dt)
        self.cache.refresh(step, generator(self.bank.device, self.settings.seed, step, 1))
        rays = len(batch.jitter)
        self.samples_per_ray.mul_(MEMORY).add_((1 - MEMORY) * len(done.samples.t) / rays)
        return StepResult(loss_now, psnr(error_now), rays)

    def state(self) -> dict[str, Tensor]:
        """Weights and cache bits as ``model.<name>``, Adam's moments as ``mean.<name>`` and ``square.<name>``, the
        cache's thickness and the mean number of samples per ray."""
        return (
            {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
            | {f"mean.{name}": tensor for name, tensor in self.mean.items()}
            | {f"square.{name}": tensor for name, tensor in self.square.items()}
            | {"thickness": self.cache.thickness, "samples_per_ray": self.samples_per_ray}
        )

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go back to what :meth:`state` gave. Raises RuntimeError for the state of another architecture."""
        mine = self.state()
        if {name: tensor.shape for name, tensor in mine.items()} != {name: t.shape for name, t in state.items()}:
            different = sorted(
                n
                for n in mine.keys() | state.keys()
                if n not in mine or n not in state or mine[n].shape != state[n].shape
            )
            raise RuntimeError(f"this state belongs to another field: {', '.join(different)} differ")
        for name, tensor in mine.items():
            tensor.copy_(state[name])

    def _batch(self, step: int) -> GridBatch:
        random, device = generator(self.bank.device, self.settings.seed, step), self.bank.device
        wanted = int(self.settings.samples / max(1e-3, float(self.samples_per_ray)))
        count = max(1, min(wanted, self.settings.most_rays))
        rays, colour, alpha = self.bank.sample(count, random)
        if self.settings.background == "random":
            background = torch.rand(count, 3, generator=random, device=device)
        else:
            background = torch.tensor(self.settings.background, device=device).expand(count, 3)
        target = colour if alpha is None else torch.lerp(background, colour, alpha[:, None])
        return GridBatch(rays, target, background, torch.rand(count, generator=random, device=device))

    def _loss(self, done: GridPass, target: Float[Tensor, "rays 3"]) -> Loss:
        error, rays = done.rendering.colour - target, len(target)
        squared_error = error.square().mean()
        none = torch.zeros(rays, device=error.device)
        grad = Rendering(error * (2 / error.numel()), none, none)
        if not self.settings.distortion:
            return Loss(squared_error, squared_error, grad, torch.zeros_like(done.weights))
        backend, lattice = self.model.backend, self.model.lattice
        each = none + self.settings.distortion / rays
        spread = (each * backend.distortion(done.samples, done.weights, lattice)).sum()
        grad_weights = backend.distortion_backward(done.samples, done.weights, lattice, each)
        return Loss(squared_error + spread, squared_error, grad, grad_weights)

    def _finite(self, step: int, batch: GridBatch, loss: Loss, gradients: GridGradients) -> tuple[float, float]:
        """Loss and squared error as numbers, once they and all gradients are known to be finite.

        The table's gradient is a sum of the features' gradients with weights up to 1: finite if their norm is.
        """
        norm = torch.nn.utils.get_total_norm([*gradients.weights, gradients.features])
        loss_now, error_now, norm_now = torch.stack([loss.value, loss.squared_error, norm]).tolist()
        for quantity, value in {"loss": loss_now, "gradient": norm_now}.items():
            if not abs(value) < float("inf"):
                rest = {"target": batch.target, "background": batch.background, "jitter": batch.jitter}
                raise NonFinite(quantity, step, batch.rays._asdict() | rest)
        return loss_now, error_now

    def _update(self, step: int, done: GridPass, gradients: GridGradients, rate: float) -> None:
        self.grad_table.zero_()
        self.model.table_backward(done, gradients, self.grad_table)
        for name, gradient in {"table": self.grad_table, **gradients.weights._asdict()}.items():
            parameter, mean, square = self.parameters[name], self.mean[name], self.square[name]
            self.model.backend.adam(parameter, gradient, mean, square, rate, step + 1)
