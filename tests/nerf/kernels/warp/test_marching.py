"""Warp's marching, its samples and their points are the reference's, in value and gradient."""

import pytest
import torch
from torch import Tensor

from nerf.geometry.rays import Rays, clip_to_box
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import uncontract
from nerf.kernels import BinaryOccupancy, RayStepping, Samples, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.marching import t_to_s, unit_coordinates
from nerf.kernels.torch.occupancy import binary_occupancy, cell_corners, cell_numbers
from tests.nerf.kernels.agreement import (
    BOUNDED,
    CONTRACTED,
    STEPPINGS,
    TOLERANCE,
    agree,
    doubled,
    normal,
    occupied_of,
    random_rays,
    rays_of,
    relative_error,
    uniform,
)


def places(stepping: RayStepping, rays: Rays, jitter: Tensor, samples: Samples) -> Tensor:
    """Ray and number k of each sample on its ray, as one integer."""
    near = rays.near if stepping.contracted else clip_to_box(rays, -Box.half, Box.half).near
    ray = samples.ray.long()
    k = t_to_s(stepping, samples.t) - (t_to_s(stepping, near) + jitter)[ray]
    assert not len(k) or (k - k.round()).abs().max() < 0.3
    return (ray << 24) + k.round().long()


def decided_by_rounding(stepping: RayStepping, rays: Rays, samples: Samples) -> Tensor:
    """Samples so near to a face of their cell, or to far, that the last digit of exp() decides."""
    origin, direction, _, far = (part[samples.ray.long()].double() for part in rays)
    t = samples.t.double()
    scaled = stepping.occupancy_resolution * unit_coordinates(origin + t[:, None] * direction, stepping.contracted)
    to_face = (scaled - scaled.round()).abs().amin(-1)
    return (to_face < 1e-6 * stepping.occupancy_resolution) | ((t / far - 1).abs() < 1e-6)


def assert_same_march(where: BinaryOccupancy, stepping: RayStepping, rays: Rays, jitter: Tensor) -> Samples:
    """Bounded, where samples are a step apart, both give the same numbers on the CPU; folded, exp() and log() may
    differ by their last digit: t by 1e-6 of itself, dt, a difference of two distances, by 1e-6 of t. So may everything
    on a GPU, where torch divides by a number by multiplying with its inverse."""
    given, wanted = (backend.march(where, stepping, rays, jitter) for backend in (warp, reference))
    at, right = (places(stepping, rays, jitter, samples) for samples in (given, wanted))
    in_both, common = torch.isin(at, right), torch.isin(right, at)
    assert decided_by_rounding(stepping, rays, given)[~in_both].all(), "a sample in an empty cell"
    assert decided_by_rounding(stepping, rays, wanted)[~common].all(), "a sample was lost"
    most = (1e-3 if right.is_cuda else 1e-5) * len(right)
    assert (~common).sum() <= most and (~in_both).sum() <= most
    a, b = given.t[in_both], wanted.t[common]
    tolerance = 1e-6 * b if stepping.cone_angle or b.is_cuda else 0 * b
    assert ((a - b).abs() <= tolerance).all()
    assert ((given.dt[in_both] - wanted.dt[common]).abs() <= tolerance).all()
    assert torch.equal(given.starts.diff().long(), torch.bincount(given.ray, minlength=len(jitter)))
    assert given.starts[0] == 0 and given.starts.dtype == given.ray.dtype == torch.int32
    return given


@pytest.mark.parametrize("stepping", STEPPINGS.values(), ids=STEPPINGS)
@pytest.mark.parametrize("cells", [4, 12, 32, 128])
@pytest.mark.parametrize("kind", ["random", "sparse", "bricks", "full", "empty"])
def test_marching(device: str, kind: str, cells: int, stepping: RayStepping) -> None:
    rays = random_rays(device, 320)
    samples = assert_same_march(
        occupied_of(device, kind, cells), stepping._replace(occupancy_resolution=cells), rays, uniform(device, 8, 320)
    )
    assert kind != "empty" or len(samples.t) == 0
    assert kind == "empty" or cells == 4 or len(samples.t) > 20


@pytest.mark.parametrize("stepping", STEPPINGS.values(), ids=STEPPINGS)
@pytest.mark.parametrize("most", [1, 17])
def test_marching_stops_at_the_cap(device: str, most: int, stepping: RayStepping) -> None:
    rays = random_rays(device, 320)
    where = occupied_of(device, "random", 32)
    samples = assert_same_march(where, stepping._replace(max_samples=most), rays, uniform(device, 8, 320))
    assert samples.starts.diff().max() == most


@pytest.mark.parametrize(
    "stepping", [BOUNDED._replace(step_size=2e-4), CONTRACTED._replace(step_size=5e-4, cone_angle=1e-3)], ids=STEPPINGS
)
@pytest.mark.parametrize("kind", ["random", "full"])
def test_marching_of_4096_samples(device: str, kind: str, stepping: RayStepping) -> None:
    stepping, where = stepping._replace(max_samples=4096), occupied_of(device, kind, 32)
    samples = assert_same_march(where, stepping, random_rays(device, 32), uniform(device, 8, 32))
    assert kind == "random" or samples.starts.diff().max() == 4096


def test_marching_from_far_away_in_folded_space(device: str) -> None:
    rays = random_rays(device, 320, far=1e7)
    origins = rays.origins * torch.logspace(0, 6, 320)[:, None]
    samples = assert_same_march(
        occupied_of(device, "full", 16),
        CONTRACTED._replace(occupancy_resolution=16),
        rays._replace(origins=origins),
        uniform(device, 8, 320),
    )
    assert samples.t.max() > 5e6


def aimed_rays(device: str, stepping: RayStepping, cell: int, count: int) -> Rays:
    """Rays through one cell of the cache: through its inside, its edges and corners, and along its faces."""
    corner = cell_corners(stepping.occupancy_resolution, torch.tensor([cell], device=device))
    inside = uniform(device, 9, count, 3)
    inside[: count // 3] = inside[: count // 3].round()
    unit = (corner + inside / stepping.occupancy_resolution).clamp(1e-6, 1 - 1e-6)
    aim = uncontract(4 * unit - 2) if stepping.contracted else Box.half * (2 * unit - 1)
    origins = 3 * normal(device, 10, count, 3)
    origins[: count // 2] /= 10
    share = count // 8
    origins[:share, 0] = aim[:share, 0]  # directions along a face
    origins[share // 2 : share, 1] = aim[share // 2 : share, 1]
    return rays_of(origins, aim - origins, 0.01, 1e3 if stepping.contracted else 30.0)


@pytest.mark.parametrize("stepping", STEPPINGS.values(), ids=STEPPINGS)
@pytest.mark.parametrize("cells", [4, 8, 20, 64])
def test_skipping_bricks_loses_no_sample(device: str, cells: int, stepping: RayStepping) -> None:
    """Bit for bit: the samples in the one occupied cell are those that a full cache has there."""
    stepping = stepping._replace(occupancy_resolution=cells, max_samples=4096)
    full = occupied_of(device, "full", cells)
    for cell in (0, cells**3 // 2, 7 * cells**3 // 9, cells**3 - 1):
        rays, jitter = aimed_rays(device, stepping, cell, 1000), uniform(device, 11, 1000)
        every = warp.march(full, stepping, rays, jitter)
        here = cell_numbers(cells, warp.sample_points(rays, every, stepping.contracted)) == cell
        bits = torch.zeros_like(full.bits)
        bits[cell >> 6] = 1 << (cell & 63) if cell & 63 != 63 else -(1 << 63)
        found = warp.march(binary_occupancy(bits), stepping, rays, jitter)
        assert here.sum() > 100
        for part, whole in zip(found[1:], every[1:], strict=True):
            assert torch.equal(part, whole[here])


@pytest.mark.parametrize("contracted", [False, True])
def test_sample_points(device: str, contracted: bool) -> None:
    rays = random_rays(device, 320)
    if contracted:
        rays = rays._replace(origins=rays.origins * torch.logspace(0, 6, 320)[:, None])
    stepping = CONTRACTED if contracted else BOUNDED
    samples = warp.march(occupied_of(device, "random", 32), stepping, rays, uniform(device, 8, 320))
    points = agree("sample_points", rays, samples, contracted)
    assert points.min() > -1e-6 and points.max() < 1 + 1e-6


@pytest.mark.parametrize("contracted", [False, True])
def test_gradients_of_sample_points(device: str, contracted: bool) -> None:
    """Ray by ray, as they fall with the square of the distance."""
    rays = random_rays(device, 320, far=1e3)
    stepping = CONTRACTED if contracted else BOUNDED
    samples = warp.march(occupied_of(device, "random", 32), stepping, rays, uniform(device, 8, 320))
    grad = normal(device, 12, len(samples.t), 3)
    given = warp.sample_points_backward(rays, samples, contracted, grad)
    wanted = reference.sample_points_backward(*doubled((rays, samples, contracted, grad)))
    assert contracted or 20 < sum(samples.starts.diff() == 0) < 300
    for one, right in zip(given, wanted, strict=True):
        assert max(relative_error(a, b) for a, b in zip(one, right, strict=True)) < TOLERANCE
