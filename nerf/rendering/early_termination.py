"""The samples of rays, taken from front to back in waves of a few per ray.

Behind what stops a ray's light nothing needs to be computed, but where that is only the densities can tell. So each
wave asks for those of the next samples of all rays that still have light.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.fields.mlp import DensityPass
from nerf.geometry.rays import Rays
from nerf.kernels import Backend, Lattice, Occupied, Samples
from nerf.runtime.profiler import part

EARLY_STOP_TRANSMITTANCE = 1e-3  # transmittance below which the rest of a ray is left out
# Samples whose densities are computed at once, in all, and per ray (docs/experiments/early_termination.md). A GPU waits
# for the host after each wave, and works on a million samples as long as on a few.
WAVE = {"cpu": 1 << 14, "cuda": 1 << 20}
SHORTEST_WAVE, LONGEST_WAVE = 6, 64


class Wave(NamedTuple):
    """Some samples of all rays; of those whose light is used up there are none."""

    samples: Samples
    points: Float[Tensor, "samples 3"]
    density: DensityPass


def march_with_early_termination(
    backend: Backend,
    occupied: Occupied,
    lattice: Lattice,
    density_at: Callable[[Float[Tensor, "points 3"]], DensityPass],
    rays: Rays,
    jitter: Float[Tensor, "rays"],
) -> Iterator[Wave]:
    """The samples in occupied cells that rays with light left meet, ``lattice.most_samples`` per ray at most, in one
    wave or more; there must be rays.

    Their places are those of :meth:`Backend.march`: the next wave goes on along the lattice where the last has ended.
    ``density_at`` answers for points in unit coordinates.
    """
    going_on, near = len(jitter), rays.near.clone()
    depth, taken = torch.zeros_like(jitter, dtype=torch.float64), 0
    while going_on and taken < lattice.most_samples:
        length = _wave_length(going_on, jitter.device)
        of_wave = lattice._replace(most_samples=min(length, lattice.most_samples - taken))
        with part("march"):
            samples = backend.march(occupied, of_wave, rays._replace(near=near), jitter)
            points = backend.sample_points(rays, samples, lattice.contracted)
        density = density_at(points)
        yield Wave(samples, points, density)
        with part("march"):
            backend.finish_round(
                of_wave, samples, density.sigma, EARLY_STOP_TRANSMITTANCE, jitter, rays.far, depth, near
            )
            taken, going_on = taken + of_wave.most_samples, int((near < rays.far).sum())


def _wave_length(rays: int, device: torch.device) -> int:
    """Samples per ray: few while there are many rays, so that little lies behind what stops their light."""
    return min(max(WAVE[device.type] // rays, SHORTEST_WAVE), LONGEST_WAVE)
