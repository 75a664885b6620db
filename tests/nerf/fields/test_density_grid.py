"""The density grid: exact where its interpolation is exact, and rays that lose light at the right place."""

import math

import pytest
import torch

from nerf.fields.density_grid import (
    DensityGrid,
    along,
    first_crossing,
    median_depth,
    occupancy,
    optical_depth,
    ray_distances,
    sample_density_grid,
    smoothed,
    trilinear,
)
from nerf.geometry.rays import Rays, clip_to_box

LOW, HIGH = torch.tensor([-0.9, -0.9, -0.9]), torch.tensor([0.9, 0.9, 0.9])


class Field:
    """A stand-in model with a given density."""

    chunk_rays = 64

    def __init__(self, function):
        self.function = function

    def density(self, points):
        return self.function(points)

    def density_and_colour(self, points, directions):
        raise NotImplementedError

    def render(self, rays, background):
        raise NotImplementedError


def linear(points):
    return 5 + points @ torch.tensor([1.0, 2.0, -1.5])


def make_rays(origins, directions, near=0.0, far=10.0):
    origins, directions = torch.as_tensor(origins), torch.as_tensor(directions)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return Rays(origins, directions, torch.full((len(origins),), near), torch.full((len(origins),), far))


def test_values_lie_at_vertices_and_corners_on_the_box():
    grid = sample_density_grid(Field(linear), 7, LOW, HIGH)
    assert grid.values.shape == (7, 7, 7)
    index = torch.tensor([[0, 0, 0], [6, 6, 6], [1, 4, 2]])
    points = LOW + index * grid.spacing()
    torch.testing.assert_close(grid.values[tuple(index.T)], linear(points))
    torch.testing.assert_close(points[1], HIGH)


def test_a_long_box_has_nearly_cubic_voxels():
    grid = sample_density_grid(Field(linear), 41, LOW, torch.tensor([0.9, 0.0, -0.75]))
    assert grid.values.shape == (41, 21, 4)
    assert float(grid.spacing().max() / grid.spacing().min()) < 1.2
    index = torch.cartesian_prod(*(torch.arange(count) for count in grid.values.shape))
    torch.testing.assert_close(grid.values.flatten(), linear(LOW + index * grid.spacing()))


def test_the_chunk_size_changes_nothing_and_progress_is_told():
    told = []
    whole = sample_density_grid(Field(linear), 9, LOW, HIGH)
    parts = sample_density_grid(Field(linear), 9, LOW, HIGH, chunk=100, on_chunk=told.append)
    assert torch.equal(whole.values, parts.values)
    assert len(told) == 8 and told == sorted(told) and told[-1] == 1.0


def test_no_gradient_is_recorded():
    weight = torch.tensor(2.0, requires_grad=True)
    assert not sample_density_grid(Field(lambda p: weight * p[..., 0]), 3, LOW, HIGH).values.requires_grad


@pytest.mark.parametrize(("resolution", "high"), [(1, HIGH), (8, LOW), (8, torch.tensor([0.9, -0.9, 0.9]))])
def test_boxes_and_resolutions_without_a_voxel_are_refused(resolution, high):
    with pytest.raises(ValueError, match="a grid needs a box and two vertices per edge"):
        sample_density_grid(Field(linear), resolution, LOW, high)


def test_interpolation_is_exact_for_trilinear_functions_and_zero_outside():
    def product(p):
        return (1 + p[..., 0]) * (2 - p[..., 1]) * (3 + p[..., 2])

    box = torch.tensor([1.0, 1.0, 1.0])
    grid = sample_density_grid(Field(product), 5, -box, box)
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    torch.testing.assert_close(trilinear(grid, points), product(points), atol=2e-5, rtol=1e-5)
    assert (trilinear(grid, points + torch.tensor([5.0, 0, 0])) == 0).all()


def test_occupancy_is_bounded_over_sixty_decades():
    density = torch.tensor([0.0, 1e-30, 1.0, 7.0, 1e4, 1e30])
    values = occupancy(DensityGrid(density.reshape(1, 1, 6), LOW, HIGH), 7.0).values.flatten()
    assert float(values[3]) == pytest.approx(0.5, abs=1e-7)
    assert values[0] == 0 and values[-1] == 1 and (values.diff() >= 0).all()


def test_optical_depth_of_a_linear_density_is_a_parabola():
    t = torch.linspace(1, 3, 9, dtype=torch.float64)[None]
    torch.testing.assert_close(optical_depth(4 * t, t), 2 * (t**2 - 1))


def test_first_crossing_is_exact_on_lines_infinite_without_one():
    t = torch.tensor([[0.0, 1.0, 2.0, 3.0]]).expand(4, 4)
    values = torch.tensor([[0.0, 1, 0, 5], [0, 0, 0, 4], [2, 0, 0, 0], [0, 0, 0, 0.4]])
    torch.testing.assert_close(first_crossing(values, t, 0.5), torch.tensor([0.5, 2.125, 0.0, torch.inf]))


@pytest.mark.parametrize(("density", "near"), [(2.0, 0.0), (50.0, 0.0), (2.0, 2.3), (0.3, 0.0)])
def test_light_stops_half_a_transmittance_behind_the_wall(density, near):
    grid = DensityGrid(torch.full((20, 20, 20), density), LOW, HIGH)
    rays = make_rays([[-3.0, 0.1, 0.2]], [[1.0, 0, 0]], near=near)
    expected = max(near, 2.1) + math.log(2) / density
    expected = expected if expected < 3.9 else math.inf
    assert float(median_depth(grid, rays, 200)) == pytest.approx(expected, rel=1e-4)


def test_what_rays_meet_is_what_lies_there():
    grid = sample_density_grid(Field(linear), 9, LOW, HIGH)
    rays = clip_to_box(make_rays([[-2.0, 0.3, 0.1]], [[1.0, -0.1, 0.2]]), LOW, HIGH)
    t = ray_distances(rays, 12)
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    torch.testing.assert_close(along(grid, rays, t)[:, 1:-1], linear(points)[:, 1:-1], atol=1e-4, rtol=0)


def test_smoothing_averages_neighbours_and_repeats_the_border():
    values = torch.zeros(5, 4, 3)
    values[2, 0, 1] = 1.0
    once = smoothed(DensityGrid(values, LOW, HIGH), 1).values
    assert float(once[2, 0, 1]) == 0.5 * 0.75 * 0.5 and float(once[1, 1, 2]) == 0.25**3
    assert float(smoothed(DensityGrid(torch.full((3, 4, 5), 0.3), LOW, HIGH), 3).values.std()) < 1e-7
    assert torch.equal(smoothed(DensityGrid(values, LOW, HIGH), 0).values, values)


def test_smoothing_is_a_gaussian_that_keeps_steps_in_place():
    line = (torch.arange(40) >= 20).double().expand(3, 3, 40)
    smooth = smoothed(DensityGrid(line, LOW, HIGH), 2).values[1, 1]
    slope = smooth.diff()
    places = torch.arange(39) + 0.5
    middle = float((slope * places).sum())
    assert middle == pytest.approx(19.5) and float(smooth[19] + smooth[20]) == pytest.approx(1.0)
    assert float((slope * (places - middle) ** 2).sum()) == pytest.approx(1.0)
