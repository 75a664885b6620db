"""Ray marching with early termination: samples are taken from front to back in rounds of a few per ray.

Nothing behind an opaque surface needs to be computed, but only the densities tell where that is. So each round computes
those of the next samples of all rays that are not yet opaque.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.fields.mlp import DensityPass
from nerf.geometry.space_maps.mapped_rays import MappedRays
from nerf.kernels import Backend, BinaryOccupancy, RayStepping, Samples
from nerf.runtime.profiler import span

EARLY_STOP_TRANSMITTANCE = 1e-3  # below it the rest of a ray is left out
# Samples whose densities are computed at once, in all, and per ray (docs/experiments/early_termination.md). A GPU waits
# for the host after each round, and works on a million samples as long as on a few: the few rays that are long take
# few rounds there (docs/experiments/gpu.md).
ROUND_SAMPLES = {"cpu": 1 << 14, "cuda": 1 << 20}
MIN_ROUND_SAMPLES_PER_RAY, MAX_ROUND_SAMPLES_PER_RAY = 6, {"cpu": 64, "cuda": 256}


class RoundSize(NamedTuple):
    """Of a round: how many samples a ray may have, and all rays together (a ``capacity`` of nerf/kernels)."""

    per_ray: int
    capacity: int


class MarchingRound(NamedTuple):
    """The next samples of all rays, of which each might have ``per_ray``; a ray that has ended has none."""

    per_ray: int
    samples: Samples
    points: Float[Tensor, "samples 3"]
    density: DensityPass


def march_with_early_termination(
    backend: Backend,
    occupancy: BinaryOccupancy,
    stepping: RayStepping,
    density_at: Callable[[Float[Tensor, "points 3"]], DensityPass],
    mapped: MappedRays,
    jitter: Float[Tensor, "rays"],
    sizes: Sequence[RoundSize] | None = None,
) -> Iterator[MarchingRound]:
    """The samples of rays in occupied cells up to where their transmittance falls below EARLY_STOP_TRANSMITTANCE,
    ``stepping.max_samples`` per ray at most, in one round or more. There must be rays. ``sizes``: of the rounds, where
    the host is not to wait for a GPU after each of them to choose the next; what they have no room for is missing.

    Samples stand where :meth:`Backend.march` puts them: each round goes on where the last has ended. ``density_at``
    takes points in unit coordinates. Samples have distances along the ``mapped`` rays and lengths in the scene.
    """
    rays = mapped.rays
    near, optical_depth = rays.near.clone(), torch.zeros_like(jitter, dtype=torch.float64)
    adaptive = ((per_ray, None) for per_ray in _adaptive_sizes(stepping.max_samples, near, rays.far))
    for per_ray, capacity in adaptive if sizes is None else sizes:
        this_round = stepping._replace(max_samples=per_ray)
        with span("march"):
            samples = backend.march(occupancy, this_round, rays._replace(near=near), jitter, capacity)
            samples = samples._replace(dt=samples.dt * mapped.scene_length(samples.t, samples.ray))
            points = backend.sample_points(rays, samples, stepping.contracted)
        density = density_at(points)
        yield MarchingRound(per_ray, samples, points, density)
        with span("march"):
            backend.finish_round(
                this_round, samples, density.sigma, EARLY_STOP_TRANSMITTANCE, jitter, rays.far, optical_depth, near
            )


def _adaptive_sizes(max_samples: int, near: Float[Tensor, "rays"], far: Float[Tensor, "rays"]) -> Iterator[int]:
    """Samples per ray of rounds, up to where all rays have ended; ``near`` moves on between them."""
    active_rays, taken = len(near), 0
    while active_rays and taken < max_samples:
        per_ray = min(_samples_per_ray(active_rays, near.device), max_samples - taken)
        yield per_ray
        with span("march"):
            taken, active_rays = taken + per_ray, int((near < far).sum())


def _samples_per_ray(rays: int, device: torch.device) -> int:
    """Few while there are many rays, so that little is computed behind opaque surfaces."""
    most = MAX_ROUND_SAMPLES_PER_RAY[device.type]
    return min(max(ROUND_SAMPLES[device.type] // rays, MIN_ROUND_SAMPLES_PER_RAY), most)
