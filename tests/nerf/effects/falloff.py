"""A colour effect for tests, which no scene of ours calls for: light falls off from the middle of each photo."""

from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import HeldOutImages, Images
from nerf.effects.exposure import expose, expose_backward
from nerf.effects.statistics.statistic import Statistic, classify
from nerf.geometry.rays import Rays


class FalloffModel:
    """A :class:`nerf.effects.ColourEffect`: ``slope`` (a row per view) of the log gain over tan² of the angle to the
    optical ``axis``."""

    name: ClassVar = "falloff"
    learning_rate: ClassVar = 1e-2
    row_length: ClassVar = 1
    held_out_words: ClassVar = "as dark at its corners as the photos taken nearest by"

    def __init__(self, slope: Float[Tensor, "views 1"], axis: Float[Tensor, "views 3"]) -> None:
        self.slope, self.axis = slope.clone(), axis

    @classmethod
    def initial(cls, images: Images, measured: Tensor | None = None) -> "FalloffModel":
        axis = images.scene_from_camera[:, :, 2].contiguous()
        return cls(torch.zeros_like(axis[:, :1]) if measured is None else measured, axis)

    @classmethod
    def restored(cls, images: Images, rows: Tensor) -> "FalloffModel":
        return cls.initial(images, rows)

    @classmethod
    def of_new_view(cls, rows: Tensor) -> None:
        """Without falloff: a new view has no camera."""

    @classmethod
    def new_view_words(cls, rows: Tensor) -> str:
        return "without falloff"

    @property
    def parameters(self) -> dict[str, Tensor]:
        return {"slope": self.slope}

    @property
    def rows(self) -> Tensor:
        return self.slope

    def fix_gauge(self) -> None:
        """A field cannot take it up."""

    def of_held_out(self, held_out: HeldOutImages) -> "FalloffModel":
        return self.initial(held_out.images, held_out.weights.to(self.slope) @ self.slope)

    def forward(self, colour: Tensor, rays: Rays, view: Int[Tensor, "rays"]) -> Tensor:
        return expose(colour, (self.slope[view] * self._square(rays, view)).expand(-1, 3))

    def backward(
        self, colour: Tensor, rays: Rays, view: Int[Tensor, "rays"], grad: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        square = self._square(rays, view)
        of_colour, of_gain = expose_backward(colour, (self.slope[view] * square).expand(-1, 3), grad)
        of_slope = (of_gain * square).sum(1, keepdim=True)
        return of_colour, {"slope": torch.zeros_like(self.slope).index_add_(0, view, of_slope)}

    def _square(self, rays: Rays, view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 1"]:
        cosine = (rays.directions * self.axis[view]).sum(-1, keepdim=True).clamp(min=0.1)
        return cosine**-2 - 1


def statistic(seen: object) -> Statistic:
    """What a scene says of it: always enough."""
    return classify(1.0, 0.1, 0.5, "EV", "photos are darker at their corners")
