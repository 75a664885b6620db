"""Scene contraction: all of space into a cube, and its inverse.

Points within the unit cube stay where they are; a point at infinity-norm distance r > 1 goes to 2 - 1/r along its
own ray from the origin. (mip-NeRF 360, Barron et al. 2022, eq. 10, with the infinity norm of nerfacto in place of
the Euclidean one, so that the image fills a cube.)
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.mapped_rays import MappedRays


def contract(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Map scene points to (-2, 2)^3: (2 - 1/r) x/r with r = max(1, max|x_i|), the identity where r = 1.

    Finite in value and gradient for every finite point; beyond r = 1e8 float32 rounds onto the faces at 2.
    """
    r = points.abs().amax(-1, keepdim=True).clamp(min=1)
    return (2 - 1 / r) * (points / r)


def uncontract(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The inverse of :func:`contract` inside the open cube (-2, 2)^3: y/m · 1/(2 - m) with m = max(1, max|y_i|)."""
    m = points.abs().amax(-1, keepdim=True).clamp(min=1)
    return points / (m * (2 - m))


@dataclass(frozen=True)
class Contraction:
    """All of space in (-2, 2)³."""

    kind: Literal["contraction"] = "contraction"
    half: ClassVar[float] = 2.0
    bends_rays: ClassVar[bool] = True
    unbounded: ClassVar[bool] = True

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Contracted points."""
        return contract(points)

    def inverse(self, mapped: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """The scene points again."""
        return uncontract(mapped)

    def map_rays(self, rays: Rays) -> MappedRays:
        """Rays as they are marched."""
        return MappedRays(rays)
