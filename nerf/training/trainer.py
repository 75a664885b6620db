"""The interface that every field trains behind.

A step is a function of (state, step number, progress of the run): its random numbers come from the seed and the step
number, so a run that resumes from a saved state repeats exactly what it would have done.
"""

from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf.effects import ImageEffects
from nerf.fields.interface import RadianceModel
from nerf.geometry.rays import Rays


class StepResult(NamedTuple):
    """What one step did: its loss, the PSNR (dB) of the final rendering on its batch, the number of rays, and the
    number of points on them at which it evaluated colour and density."""

    loss: float
    psnr: float
    rays: int
    colour_evaluations: int
    density_evaluations: int


class FieldTrainer(Protocol):
    """What the training loop needs of a field's trainer. The state's tensors carry everything that a step changes."""

    @property
    def model(self) -> RadianceModel:
        """The field in training."""
        ...

    @property
    def effects(self) -> ImageEffects:
        """The effects between the field and the images."""
        ...

    def step(self, step: int, progress: float, lr_scale: float) -> StepResult:
        """Take step number ``step``, ``progress`` of the run being done. Raises NonFinite and changes nothing. Where
        that would make a GPU wait, it does so one step late, and results are those of the step before."""
        ...

    def state(self) -> dict[str, Tensor]:
        """The tensors of model and optimiser themselves; copy them to keep them."""
        ...

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore a saved state."""
        ...


class NonFinite(Exception):
    """A loss or gradient is infinite or NaN. ``batch`` holds the tensors that led to it."""

    def __init__(self, quantity: str, step: int, batch: dict[str, Tensor]) -> None:
        super().__init__(f"the {quantity} of step {step} is not finite")
        self.quantity, self.step, self.batch = quantity, step, batch


RAY_GEOMETRY = "geometry of rays"


def all_finite(rays: Rays) -> Bool[Tensor, ""]:
    """Whether all rays are finite. NaN would drop out of the comparisons that clip a ray to the box, and the ray would
    count as empty."""
    return torch.cat([each.flatten() for each in rays]).isfinite().all()


def composite_over(
    colour: Float[Tensor, "*rays 3"], alpha: Float[Tensor, "*rays"] | None, background: Float[Tensor, "3"]
) -> Float[Tensor, "*rays 3"]:
    """Composite colours with straight alpha over a background; without alpha, return the colours."""
    if alpha is None:
        return colour
    return background + alpha[..., None] * (colour - background)
