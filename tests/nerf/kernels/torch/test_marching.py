import numpy as np
import pytest
import torch
from torch import Tensor

from nerf.geometry.rays import Rays, clip_to_box
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import contract
from nerf.kernels import RayStepping
from nerf.kernels.torch import march, occupancy_bits, sample_points, sample_points_backward
from nerf.kernels.torch.marching import s_to_t, t_to_s
from nerf.kernels.torch.occupancy import binary_occupancy

BOUNDED = RayStepping(step_size=0.05, cone_angle=0.0, contracted=False, occupancy_resolution=8, max_samples=1000)
CONTRACTED = RayStepping(step_size=0.05, cone_angle=0.1, contracted=True, occupancy_resolution=8, max_samples=1000)
FULL = binary_occupancy(torch.full((8,), -1))


def random_rays(count: int = 50, near: float = 0.1, far: float = 9.0) -> Rays:
    generator = torch.Generator().manual_seed(2)
    origins = 3 * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=-1, keepdim=True)
    ends = torch.full((2, count), near, dtype=torch.float64)
    ends[1] = far
    return Rays(origins, directions, *ends)


def jitter_of(rays: Rays) -> Tensor:
    return torch.rand(len(rays.near), generator=torch.Generator().manual_seed(4), dtype=torch.float64)


def lattice_slowly(stepping: RayStepping, near: float, far: float, jitter: float) -> list[tuple[float, float]]:
    """(t, dt) of every sample of a ray, by summing ds = dt / max(step, cone t) in tiny pieces."""
    edges = np.linspace(0, 2 * far, 200_001)
    middles = (edges[1:] + edges[:-1]) / 2
    s = np.concatenate([[0], np.cumsum(np.diff(edges) / np.maximum(stepping.step_size, stepping.cone_angle * middles))])
    first, k, found = np.interp(near, edges, s), 0, []
    while (start := np.interp(first + k, s, edges)) < far:
        t = np.interp(first + k + jitter, s, edges)
        if t < far:
            found.append((t, min(np.interp(first + k + 1, s, edges), far) - start))
        k += 1
    return found


def test_the_lattice_is_the_solution_of_its_equation() -> None:
    stepping = RayStepping(0.3, 0.2, True, 8, 1000)
    rays = Rays(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), torch.tensor([0.7]), torch.tensor([4.0]))
    samples = march(FULL, stepping, rays, torch.tensor([0.25]))
    slow = torch.tensor(lattice_slowly(stepping, 0.7, 4.0, 0.25), dtype=torch.float32)
    assert 5 < len(slow) < 20
    torch.testing.assert_close(samples.t, slow[:, 0], rtol=1e-5, atol=0)
    torch.testing.assert_close(samples.dt, slow[:, 1], rtol=1e-4, atol=0)


@pytest.mark.parametrize("stepping", [BOUNDED, CONTRACTED])
def test_distance_and_coordinate_undo_each_other(stepping: RayStepping) -> None:
    t = torch.logspace(-6, 3, 50, dtype=torch.float64)
    torch.testing.assert_close(s_to_t(stepping, t_to_s(stepping, t)), t)


@pytest.mark.parametrize("stepping", [BOUNDED, CONTRACTED])
def test_intervals_of_a_full_cache_tile_each_ray(stepping: RayStepping) -> None:
    rays = random_rays()
    samples = march(FULL, stepping, rays, torch.zeros(50, dtype=torch.float64))
    lengths = torch.zeros(50, dtype=torch.float64).index_add(0, samples.ray.long(), samples.dt)
    inside = rays if stepping.contracted else clip_to_box(rays, -Box.half, Box.half)
    torch.testing.assert_close(lengths, inside.far - inside.near)
    assert 0 < (lengths == 0).sum() < 50 or stepping.contracted


def test_samples_of_empty_cells_are_skipped_alone() -> None:
    rays = random_rays(400)
    jitter = jitter_of(rays)
    thickness = torch.rand(512, generator=torch.Generator().manual_seed(5))
    some = march(binary_occupancy(occupancy_bits(thickness, 0.7)), BOUNDED, rays, jitter)
    every = march(FULL, BOUNDED, rays, jitter)
    points = sample_points(rays, every, False)
    x, y, z = (8 * points).long().clamp(0, 7).unbind(-1)
    brick = ((x // 4) * 2 + y // 4) * 2 + z // 4
    wanted = thickness[brick * 64 + (x % 4) * 16 + (y % 4) * 4 + z % 4] > 0.7
    assert 0.1 < wanted.float().mean() < 0.5
    for part, whole in zip(some[1:], every[1:], strict=True):
        assert torch.equal(part, whole[wanted])


def test_packing_counts_what_each_ray_has_in_order() -> None:
    rays = random_rays()
    samples = march(FULL, BOUNDED, rays, jitter_of(rays))
    assert samples.starts.dtype == samples.ray.dtype == torch.int32
    assert torch.equal(samples.starts.diff().long(), torch.bincount(samples.ray, minlength=50))
    assert samples.starts[0] == 0 and samples.starts[-1] == len(samples.t)
    assert (samples.t.diff()[samples.ray[1:] == samples.ray[:-1]] > 0).all()


def test_a_ray_inside_starts_at_near() -> None:
    origins = torch.tensor([[0.0, 0, 0], [0, 0, 5]])
    directions = torch.tensor([[1.0, 0, 0], [0, 1, 0]])
    rays = Rays(origins, directions, torch.full((2,), 0.2), torch.full((2,), 10.0))
    samples = march(FULL, BOUNDED, rays, torch.full((2,), 0.5))
    assert samples.starts.tolist() == [0, 14, 14]
    assert samples.t[0].item() == pytest.approx(0.225)
    assert samples.t[-1].item() == pytest.approx(0.875)


def test_the_cap_keeps_the_first_samples() -> None:
    rays = random_rays()
    every = march(FULL, BOUNDED, rays, jitter_of(rays))
    few = march(FULL, BOUNDED._replace(max_samples=7), rays, jitter_of(rays))
    position = torch.arange(len(every.t)) - every.starts[every.ray]
    assert torch.equal(few.t, every.t[position < 7])
    assert few.starts.diff().max() == 7


def test_an_empty_cache_or_no_rays_give_no_samples() -> None:
    rays = random_rays(3)
    nothing = march(binary_occupancy(torch.zeros(8, dtype=torch.int64)), BOUNDED, rays, jitter_of(rays))
    assert (nothing.starts.tolist(), len(nothing.t)) == ([0, 0, 0, 0], 0)
    none = rays.each(lambda part: part[:0])
    assert march(FULL, CONTRACTED, none, jitter_of(none)).starts.tolist() == [0]


def test_unit_coordinates_are_the_box_or_all_of_space() -> None:
    rays = random_rays()
    for stepping in (BOUNDED, CONTRACTED):
        samples = march(FULL, stepping, rays, jitter_of(rays))
        points = sample_points(rays, samples, stepping.contracted)
        assert 0 <= points.min() < 0.1 and 0.9 < points.max() <= 1
        scene = rays.origins[samples.ray] + samples.t[:, None] * rays.directions[samples.ray]
        wanted = (contract(scene) + 2) / 4 if stepping.contracted else (scene + 0.9) / 1.8
        torch.testing.assert_close(points, wanted)


@pytest.mark.parametrize("stepping", [BOUNDED, CONTRACTED])
def test_gradients_reach_origins_and_directions(stepping: RayStepping) -> None:
    rays = random_rays(8)
    samples = march(FULL, stepping, rays, jitter_of(rays))
    grad = torch.randn(len(samples.t), 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    origins, directions = rays.origins.requires_grad_(), rays.directions.requires_grad_()
    points = sample_points(rays, samples, stepping.contracted)
    wanted = torch.autograd.grad(points, (origins, directions), grad)
    given = sample_points_backward(rays, samples, stepping.contracted, grad)
    torch.testing.assert_close(given, wanted)


def test_folded_points_far_away_have_a_finite_gradient() -> None:
    rays = Rays(torch.zeros(1, 3), torch.tensor([[0.6, 0.0, 0.8]]), torch.tensor([1e-3]), torch.tensor([1e12]))
    samples = march(FULL, CONTRACTED, rays, torch.tensor([0.5]))
    gradients = sample_points_backward(rays, samples, True, torch.ones(len(samples.t), 3))
    assert samples.t[-1] > 1e11
    assert all(gradient.isfinite().all() for gradient in gradients)
