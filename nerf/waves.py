"""The samples of rays, taken from front to back in waves of a few per ray.

Behind what stops a ray's light nothing needs to be computed, but where that is only the densities can tell. So each
wave asks for those of the next samples of all rays that still have light, and the rays without any drop out.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from nerf.grid_mlp import DensityPass
from nerf.kernels import Backend, Lattice, Occupied, Samples
from nerf.kernels.marching import lattice_coordinate, lattice_distance, starts_of
from nerf.kernels.packed_compositing import OPAQUE
from nerf.rays import Rays
from nerf.stopwatch import part

HIDDEN_BEHIND = 1e-3  # transmittance below which the rest of a ray is left out
# The optical depth that surely hides the rest: sums of waves round otherwise than the sum that decides.
ENOUGH_DEPTH = -math.log(HIDDEN_BEHIND) * (1 + 1e-5)
# Samples whose densities are computed at once: in all, and per ray (docs/numbers.md).
WAVE, SHORTEST_WAVE, LONGEST_WAVE = 1 << 14, 6, 64


class Wave(NamedTuple):
    """Some samples of the rays with these numbers."""

    number: Int64[Tensor, "rays"]
    samples: Samples
    points: Float[Tensor, "samples 3"]
    density: DensityPass


def front_to_back(
    backend: Backend,
    occupied: Occupied,
    lattice: Lattice,
    density_at: Callable[[Float[Tensor, "points 3"]], DensityPass],
    rays: Rays,
    jitter: Float[Tensor, "rays"],
) -> Iterator[Wave]:
    """The samples in occupied cells that rays with light left meet, ``lattice.most_samples`` per ray at most.

    Their places are those of :meth:`Backend.march`: the next wave goes on along the lattice where the last has ended.
    ``density_at`` answers for points in unit coordinates.
    """
    number, depth, taken = torch.arange(len(jitter), device=jitter.device), torch.zeros_like(jitter), 0
    while len(number) and taken < lattice.most_samples:
        length = min(_wave_length(len(number)), lattice.most_samples - taken)
        with part("march"):
            samples = backend.march(occupied, lattice._replace(most_samples=length), rays, jitter)
            points = backend.sample_points(rays, samples, lattice.contracted)
        density = density_at(points)
        yield Wave(number, samples, points, density)
        with part("march"):
            taken, depth = taken + length, depth + _optical_depth(samples, density.sigma)
            going_on = ((depth <= ENOUGH_DEPTH) & (samples.starts.diff() == length)).nonzero()[:, 0]
            last = samples.t.index_select(0, samples.starts.index_select(0, going_on + 1) - 1)
            number, depth, jitter, *of_rays = (of.index_select(0, going_on) for of in (number, depth, jitter, *rays))
            near = lattice_distance(lattice, lattice_coordinate(lattice, last) + (1 - jitter))
            rays = Rays(*of_rays)._replace(near=near)


def packed(waves: Sequence[Wave], rays: int) -> tuple[Samples, Int64[Tensor, "samples"]]:
    """The samples of all waves packed ray by ray, and where each is among the waves' one after the other."""
    before, counts = [], torch.zeros(rays, dtype=torch.int64, device=waves[0].number.device)
    for wave in waves:
        before.append(counts.index_select(0, wave.number))
        counts.index_add_(0, wave.number, wave.samples.starts.diff().long())
    starts = starts_of(counts)
    places = []
    for wave, earlier in zip(waves, before, strict=True):
        first = starts.index_select(0, wave.number) + earlier - wave.samples.starts[:-1]
        ray = wave.samples.ray
        places.append(first.index_select(0, ray) + torch.arange(len(ray), device=ray.device))
    place = torch.cat(places)
    order = torch.empty_like(place)
    order[place] = torch.arange(len(place), device=place.device)
    ray = torch.cat([wave.number.int().index_select(0, wave.samples.ray) for wave in waves])
    t, dt = (torch.cat(parts) for parts in zip(*(wave.samples[2:] for wave in waves), strict=True))
    return Samples(starts, *(part.index_select(0, order) for part in (ray, t, dt))), order


def _wave_length(rays: int) -> int:
    """Samples per ray: few while there are many rays, so that little lies behind what stops their light."""
    return min(max(WAVE // rays, SHORTEST_WAVE), LONGEST_WAVE)


def _optical_depth(samples: Samples, sigma: Float[Tensor, "samples"]) -> Float[Tensor, "rays"]:
    """The sum of sigma dt over each ray's samples."""
    until = torch.nn.functional.pad((sigma * samples.dt).clamp(max=OPAQUE).double().cumsum(0), (1, 0))
    return until.index_select(0, samples.starts).diff().to(sigma.dtype)
