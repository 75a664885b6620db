"""Rays as straight lines in the space where they are marched, and distances back in the scene."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from nerf.geometry.rays import Rays

MIN_REST = 1e-6  # of a ray's depth at its start over that at a sample: no sample is mapped back to beyond 1e6 times it


class Line(NamedTuple):
    """A ray through normalised device coordinates (ndc.py): at the distance ``start`` its ``depth`` begins to change by
    ``slope`` per distance, and it moves at ``speed`` in d / (depth at d), d being the distance from there."""

    start: Float[Tensor, "*rays"]
    depth: Float[Tensor, "*rays"]
    slope: Float[Tensor, "*rays"]
    speed: Float[Tensor, "*rays"]


class MappedRays(NamedTuple):
    """``rays`` as straight lines in the space where they are marched, and the way back. ``line``: None where that is
    the scene itself."""

    rays: Rays
    line: Line | None = None

    def to_scene(self, t: Float[Tensor, "*samples"], ray: Int[Tensor, "samples"] | None = None) -> Tensor:
        """Distances in the scene of those along ``rays``: (rays, n), or packed ones with the ``ray`` of each."""
        if self.line is None:
            return t
        start, depth, slope, speed = (
            each[..., None] if ray is None else each.index_select(0, ray) for each in self.line
        )
        share = t / speed
        return start + share * depth / (1 - share * slope).clamp(min=MIN_REST)

    def scene_length(
        self, t: Float[Tensor, "samples"], ray: Int[Tensor, "samples"]
    ) -> float | Float[Tensor, "samples"]:
        """Length in the scene for a length along ``rays`` at packed samples: the derivative of :meth:`to_scene`."""
        if self.line is None:
            return 1.0
        depth, slope, speed = (each.index_select(0, ray) for each in self.line[1:])
        return depth / (speed * (1 - t / speed * slope).clamp(min=MIN_REST).square())

    def from_scene(self, distance: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """Distances along ``rays`` of those in the scene, one for each; 0 for what is before where they start."""
        if self.line is None:
            return distance
        start, depth, slope, speed = self.line
        beyond = (distance - start).clamp(min=0)
        return speed * beyond / (depth + slope * beyond).clamp(min=MIN_REST * depth)
