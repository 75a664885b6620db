"""The one interface between a radiance field and everything that uses it: renderer, evaluation, mesh, video."""

from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from nerf.geometry.rays import Rays


class Rendering(NamedTuple):
    """What a batch of rays sees.

    ``colour`` is composited over the background; ``depth`` is the expected distance along the unit ray,
    sum(w_i t_i) + (1 - opacity) far, finite for empty rays too; ``opacity`` is sum(w_i) in [0, 1].
    """

    colour: Float[Tensor, "*rays 3"]
    depth: Float[Tensor, "*rays"]
    opacity: Float[Tensor, "*rays"]


@runtime_checkable
class RadianceModel(Protocol):
    """A trained field. Points are in the scene frame, densities per scene unit, colours in [0, 1].

    ``chunk_rays``: how many a CPU core best renders at once (docs/experiments/early_termination.md).
    """

    chunk_rays: int

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Volume density sigma at points."""
        ...

    def density_and_colour(
        self, points: Float[Tensor, "*points 3"], directions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points 3"]]:
        """The same density, and the colour emitted at points towards -directions (those of the viewing rays, unit);
        without meaning where the density is zero."""
        ...

    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """Render rays without randomness and without gradient."""
        ...
