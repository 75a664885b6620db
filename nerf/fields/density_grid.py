"""A field's density on a regular, vertex-centred grid, and what rays meet there.

Naming: ``values[i, j, k]`` lies at ``low + (i, j, k) * spacing``; the first and last vertices lie on the box.
``t`` are ``samples`` distances along each unit ray, evenly spaced over the part of [near, far] inside the box.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf.geometry.rays import Rays, clip_to_box, points_on
from nerf.runtime.parallel import in_order


@runtime_checkable
class DensityField(Protocol):
    """What a grid is filled from; a RadianceModel is one."""

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """At points of the grid's space, per unit length there."""
        ...


class DensityGrid(NamedTuple):
    """Values at the vertices of a box; ``low`` and ``high`` are its corners in the scene, or in another space whose
    points and rays are then meant everywhere below."""

    values: Float[Tensor, "nx ny nz"]
    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    def spacing(self) -> Float[Tensor, "3"]:
        """Distance between neighbouring vertices along each axis."""
        return (self.high - self.low) / (torch.tensor(self.values.shape, device=self.low.device) - 1)


def sample_density_grid(
    field: DensityField,
    resolution: int | tuple[int, int, int],
    low: Float[Tensor, "3"],
    high: Float[Tensor, "3"],
    chunk: int = 1 << 16,
    on_chunk: Callable[[float], None] = lambda done: None,
) -> DensityGrid:
    """Sample the density with ``resolution`` vertices along the longest edge and nearly cubic voxels, or with so many
    along each edge.

    Points go to the field in chunks of fixed size, so the result does not depend on threads; ``on_chunk`` hears
    the finished share after each. Raises ValueError for an empty box or fewer than two vertices along an edge.
    """
    edges = high - low
    least = min(resolution) if isinstance(resolution, tuple) else resolution
    if least < 2 or not bool((edges > 0).all()):
        raise ValueError(f"a grid needs a box and two vertices per edge, got {edges.tolist()} and {resolution}")
    counts = resolution if isinstance(resolution, tuple) else _nearly_cubic(edges, resolution)
    axes = [torch.linspace(float(a), float(b), n, device=low.device) for a, b, n in zip(low, high, counts, strict=True)]
    total = math.prod(counts)

    def density(start: int) -> Tensor:
        index = torch.arange(start, min(start + chunk, total), device=low.device)
        # Not torch.unravel_index: its first call imports sympy, for most of a second.
        column, k = index // counts[2], index % counts[2]
        i, j = column // counts[1], column % counts[1]
        with torch.no_grad():  # a property of the thread
            return field.density(torch.stack([axes[0][i], axes[1][j], axes[2][k]], dim=-1)).float()

    values = torch.empty(total, device=low.device)
    for number, part in enumerate(in_order(density, range(0, total, chunk), low.device)):
        values[number * chunk : (number + 1) * chunk] = part
        on_chunk(min((number + 1) * chunk, total) / total)
    return DensityGrid(values.reshape(counts), low, high)


def _nearly_cubic(edges: Float[Tensor, "3"], resolution: int) -> tuple[int, int, int]:
    """Vertices along the edges of a box, ``resolution`` along the longest."""
    x, y, z = (max(2, round(float(edge / edges.max()) * (resolution - 1)) + 1) for edge in edges)
    return x, y, z


def occupancy(grid: DensityGrid, level: float) -> DensityGrid:
    """Map density to 1 - 2^(-density / level), which is 1/2 at ``level`` and stays within [0, 1].

    Density spans many decades, so linear interpolation of it puts every level set of a sharp surface within a
    sliver of the empty vertex; interpolating this bounded value puts it between the two.
    """
    return grid._replace(values=-torch.expm1(grid.values * (-math.log(2) / level)))


def smoothed(grid: DensityGrid, passes: int) -> DensityGrid:
    """Average every value with its neighbours along each axis, by 1/4, 1/2, 1/4; beyond the box all is as at its side.

    ``passes`` of it are a Gaussian of sqrt(passes / 2) vertices' distance. Values stay within their range, and the
    middle of a step where it is.
    """
    values = grid.values
    for axis in passes * [0, 1, 2]:
        values = _averaged(values.transpose(0, axis)).transpose(0, axis)
    return grid._replace(values=values)


def _averaged(values: Float[Tensor, "n _ _"]) -> Float[Tensor, "n _ _"]:
    result = values / 2
    for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None)), (0, 0), (-1, -1)):
        result[here].add_(values[there], alpha=0.25)
    return result


def trilinear(grid: DensityGrid, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
    """Interpolate inside the box; the value is zero beyond it."""
    scaled = 2 * (points - grid.low) / (grid.high - grid.low) - 1
    locations = scaled.flip(-1).reshape(1, 1, 1, -1, 3)  # grid_sample's x runs along the last axis
    volume = grid.values[None, None]
    sampled = torch.nn.functional.grid_sample(volume, locations, padding_mode="zeros", align_corners=True)
    return sampled.reshape(points.shape[:-1])


def ray_distances(rays: Rays, samples: int) -> Float[Tensor, "*rays samples"]:
    """``samples`` evenly spaced distances from near to far, end points included."""
    fraction = torch.linspace(0, 1, samples, device=rays.near.device)
    return rays.near[..., None] + (rays.far - rays.near)[..., None] * fraction


def along(grid: DensityGrid, rays: Rays, t: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples"]:
    """The grid's values at distances ``t`` along the rays."""
    return trilinear(grid, points_on(rays, t))


def optical_depth(
    density: Float[Tensor, "*rays samples"], t: Float[Tensor, "*rays samples"]
) -> Float[Tensor, "*rays samples"]:
    """The integral of density from the first sample to each (trapezoids); transmittance is exp of its negative."""
    steps = (density[..., 1:] + density[..., :-1]) / 2 * t.diff(dim=-1)
    return torch.nn.functional.pad(steps.cumsum(-1), (1, 0))


def first_crossing(
    values: Float[Tensor, "*rays samples"], t: Float[Tensor, "*rays samples"], level: float
) -> Float[Tensor, "*rays"]:
    """Distance at which ``values`` first reach ``level``, linear between samples; infinite where they never do."""
    above: Bool[Tensor, "*rays samples"] = values >= level
    index = above.int().argmax(-1, keepdim=True)
    before = (index - 1).clamp(min=0)
    v0, v1 = values.gather(-1, before), values.gather(-1, index)
    t0, t1 = t.gather(-1, before), t.gather(-1, index)
    share = torch.where(v1 > v0, (level - v0) / torch.where(v1 > v0, v1 - v0, 1.0), 0.0)
    return torch.where(above.any(-1, keepdim=True), t0 + (t1 - t0) * share, torch.inf).squeeze(-1)


def median_depth(grid: DensityGrid, rays: Rays, samples: int) -> Float[Tensor, "*rays"]:
    """Distance at which half of the light is lost to the density grid: the median depth; infinite if never."""
    rays = clip_to_box(rays, grid.low, grid.high)
    t = ray_distances(rays, samples)
    return first_crossing(optical_depth(along(grid, rays, t), t), t, math.log(2))
