"""A colour effect for tests, which no scene of ours calls for: stray light lies over each photo like a veil."""

from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.effects import HeldOutImages, Images
from nerf.effects.statistics.statistic import Statistic, classify
from nerf.geometry.rays import Rays


class VeilModel:
    """A :class:`nerf.effects.ColourEffect`: ``level`` is added to what a photo shows. The least one is 0."""

    name: ClassVar = "veil"
    learning_rate: ClassVar = 1e-3
    row_length: ClassVar = 1
    held_out_words: ClassVar = "veiled as the photos taken nearest by"

    def __init__(self, level: Float[Tensor, "views 1"]) -> None:
        self.level = level.clone()

    @classmethod
    def initial(cls, images: Images, measured: Tensor | None) -> "VeilModel":
        return cls(torch.zeros_like(images.scene_from_camera[:, :1, 3]) if measured is None else measured)

    @classmethod
    def restored(cls, images: Images, rows: Tensor) -> "VeilModel":
        return cls(rows)

    @classmethod
    def of_new_view(cls, rows: Tensor) -> "VeilModel":
        return cls(rows.amin(0)[None])

    @classmethod
    def new_view_words(cls, rows: Tensor) -> str:
        return "as little veiled as the clearest photo"

    @property
    def parameters(self) -> dict[str, Tensor]:
        return {"level": self.level}

    @property
    def rows(self) -> Tensor:
        return self.level

    def fix_gauge(self) -> None:
        self.level -= self.level.amin(0)

    def of_held_out(self, held_out: HeldOutImages) -> "VeilModel":
        return VeilModel(held_out.weights.to(self.level) @ self.level)

    def forward(self, colour: Tensor, rays: Rays, view: Tensor) -> Tensor:
        return colour + self.level[view]

    def inverse(self, shown: Tensor, rays: Rays, view: Tensor) -> Tensor:
        return shown - self.level[view]

    def backward(self, colour: Tensor, rays: Rays, view: Tensor, grad: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return grad, {"level": torch.zeros_like(self.level).index_add_(0, view, grad.sum(1, keepdim=True))}


def statistic(seen: object) -> Statistic:
    """What a scene says of it: always enough."""
    return classify(1.0, 0.1, 0.5, "of white", "photos are veiled")
