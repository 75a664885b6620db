"""What stands between a radiance field and a photo of it, each part switched on only where a scene calls for it.

The trainers (nerf/training/hash_grid_trainer.py, nerf/training/trainer.py) know two places: where a photo's rays run
(:class:`PhotoRays`) and what the photo makes of the colours they meet (:class:`PhotoColours`). In each stands one part;
the neutral ones, :class:`AsGiven` and :class:`AsRendered`, have no parameters and compute nothing, so that an effect
that is off costs nothing and changes no bit.

Parameters have a row per view of the ray bank and are updated in place by the trainer. ``forward`` is plain torch,
which autograd may differentiate (the paper field's trainer does so); ``backward`` is its derivative by hand (the grid
field's trainer has no autograd) and gives dense gradients of the part's parameters by name.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays


class Seen(NamedTuple):
    """What rays of the views ``view`` met, rendered over ``background``."""

    rendering: Rendering
    background: Float[Tensor, "*#rays 3"]
    view: Int[Tensor, "rays"]


GradRays = Callable[[], tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]]
"""Computes the gradients of a loss by rays' origins and directions; costly, called only where they are wanted."""


@runtime_checkable
class PhotoRays(Protocol):
    """Where the rays of each photo run."""

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views _"]]:
        """What is learnt with the field."""
        ...

    @property
    def rate(self) -> float:
        """Adam's learning rate for them before the field's warm-up and decay."""
        ...

    def settle(self) -> None:
        """After an update: take out what the field could take up itself (the gauge)."""
        ...

    def forward(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """The rays along which to look, given those of the calibrated cameras."""
        ...

    def backward(self, rays: Rays, view: Int[Tensor, "rays"], grad: GradRays) -> dict[str, Tensor]:
        """Gradients of the parameters; ``rays`` as forward was given them."""
        ...


@runtime_checkable
class PhotoColours(Protocol):
    """What each photo makes of the colours of its rays."""

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views _"]]:
        """What is learnt with the field."""
        ...

    @property
    def rate(self) -> float:
        """Adam's learning rate for them before the field's warm-up and decay."""
        ...

    def settle(self) -> None:
        """After an update: take out what the field could take up itself (the gauge)."""
        ...

    def of_unseen(self, weights: Float[Tensor, "unseen views"]) -> "PhotoColours":
        """What photos that took no part are expected to make of colours, from what ``weights`` says of their neighbours
        among those that did (nerf/geometry/pose_distance.py)."""
        ...

    def residual(self, seen: Seen, target: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
        """By how much the photo would show more than its ``target`` colours; their squares are the loss."""
        ...

    def backward(self, seen: Seen, grad: Float[Tensor, "rays 3"]) -> tuple[Rendering, dict[str, Tensor]]:
        """Gradients of the rendering and of the parameters, given that of the residual."""
        ...


class AsGiven:
    """Rays as the calibrated cameras have them: a :class:`PhotoRays` without effect."""

    rate = 0.0

    @property
    def parameters(self) -> dict[str, Tensor]:
        """None."""
        return {}

    def settle(self) -> None:
        """Nothing to do."""

    def forward(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """The same rays."""
        return rays

    def backward(self, rays: Rays, view: Int[Tensor, "rays"], grad: GradRays) -> dict[str, Tensor]:
        """Nothing to learn, and so nothing is computed."""
        return {}


class AsRendered:
    """Photos that show what is rendered: a :class:`PhotoColours` without effect."""

    rate = 0.0

    @property
    def parameters(self) -> dict[str, Tensor]:
        """None."""
        return {}

    def settle(self) -> None:
        """Nothing to do."""

    def of_unseen(self, weights: Float[Tensor, "unseen views"]) -> "AsRendered":
        """The same."""
        return self

    def residual(self, seen: Seen, target: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
        """Rendered less shown."""
        return seen.rendering.colour - target

    def backward(self, seen: Seen, grad: Float[Tensor, "rays 3"]) -> tuple[Rendering, dict[str, Tensor]]:
        """The same gradient."""
        none = torch.zeros(len(grad), device=grad.device)
        return Rendering(grad, none, none), {}


AS_GIVEN, AS_RENDERED = AsGiven(), AsRendered()
