"""The surface's density: where light stops, over four decades of density, and refused where there is no surface."""

import numpy as np
import pytest
import torch

from nerf.fields.density_grid import DensityGrid, sample_density_grid
from nerf.geometry.rays import Rays
from stages.contract import StageError
from stages.mesh.iso_level import check_range, choose_iso_level
from stages.mesh.marching_cubes import extract_surface

CORNER = torch.full((3,), 0.9)
NUM_RAYS = 256
POINTS = 40
VOXEL = 1.8 / (POINTS - 1)


class Solid:
    """A stand-in model: ``inside`` times a soft step at the zero of a signed distance, over ``outside``."""

    chunk_rays = 64

    def __init__(self, distance, inside, softness=0.004, outside=0.0):
        self.distance, self.inside, self.softness, self.outside = distance, inside, softness, outside

    def density(self, points):
        return self.outside + self.inside * torch.sigmoid(-self.distance(points) / self.softness)

    def density_and_colour(self, points, directions):
        raise NotImplementedError

    def render(self, rays, background):
        raise NotImplementedError


def ball(points):
    return points.norm(dim=-1) - 0.55


@pytest.fixture
def rays():
    """Rays from a sphere of radius 2.5 to the box."""
    random = torch.Generator().manual_seed(0)
    origins = 2.5 * torch.nn.functional.normalize(torch.randn(NUM_RAYS, 3, generator=random), dim=-1)
    targets = torch.rand(NUM_RAYS, 3, generator=random) * 1.4 - 0.7
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return Rays(origins, directions, torch.full((NUM_RAYS,), 0.5), torch.full((NUM_RAYS,), 6.0))


def density_grid_of(model):
    return sample_density_grid(model, POINTS, -CORNER, CORNER)


@pytest.mark.parametrize("inside", [60.0, 1e3, 1e5])
def test_the_surface_lies_at_the_median_depth_whatever_the_density(rays, inside):
    model = Solid(ball, inside)
    grid = density_grid_of(model)
    chosen = choose_iso_level(grid, model, rays)
    assert chosen.well_defined and chosen.surface_error_voxels is not None and 0 < chosen.surface_error_voxels < 0.35
    assert "e+" not in chosen.reason
    radii = np.linalg.norm(extract_surface(grid, chosen.density).vertices, axis=1)
    assert abs(radii.mean() - 0.55) < VOXEL
    assert "rays of the photos falls to one half" in chosen.reason


def test_the_level_scales_with_density_and_inversely_with_length(rays):
    """Only density times length counts: a field twice the size with half the density has half the iso-level."""
    model = Solid(ball, 100.0, softness=0.02)
    large = Solid(lambda p: 2 * ball(p / 2), 50.0, softness=0.04)
    grid = density_grid_of(model)
    far_rays = Rays(rays.origins * 2, rays.directions, rays.near * 2, rays.far * 2)
    level = choose_iso_level(grid, model, rays).density
    half = choose_iso_level(DensityGrid(grid.values / 2, -2 * CORNER, 2 * CORNER), large, far_rays).density
    assert half == pytest.approx(level / 2, rel=1e-3)


def test_haze_around_a_solid_is_not_its_surface(rays):
    model = Solid(ball, 500.0, outside=0.15)
    grid = density_grid_of(model)
    surface = extract_surface(grid, choose_iso_level(grid, model, rays).density)
    assert abs(np.linalg.norm(surface.vertices, axis=1).mean() - 0.55) < VOXEL


def test_density_before_near_has_no_say(rays):
    """A curtain between the cameras and their near distance is never rendered."""

    def curtained(points):
        return torch.minimum(ball(points), (points[..., 0] - 0.8).abs() - 0.03)

    rays = rays._replace(
        near=torch.where(rays.origins[:, 0] > 1, (rays.origins[:, 0] - 0.6) / -rays.directions[:, 0], 0.5)
    )
    rays = rays.each(lambda part: part[(rays.near > 0) & (rays.near < 4)])
    bare, hung = Solid(ball, 500.0), Solid(curtained, 500.0)
    without, behind = (
        choose_iso_level(density_grid_of(bare), bare, rays),
        choose_iso_level(density_grid_of(hung), hung, rays),
    )
    assert 1 / 2.4 < behind.density / without.density < 2.4  # two steps of the search at most


def test_fog_is_split_into_thick_and_thin_and_called_fog(rays):
    model = Solid(ball, 0.02, softness=0.1, outside=0.002)
    chosen = choose_iso_level(density_grid_of(model), model, rays)
    assert chosen.surface_error_voxels is None and not chosen.well_defined
    assert 0.002 < chosen.density < 0.022
    assert chosen.reason.startswith("only 0.0% of the photos' rays") and "no surface yet" in chosen.reason


def test_rays_that_all_miss_the_box_leave_fog(rays):
    model = Solid(ball, 500.0)
    away = rays._replace(directions=-rays.directions)
    assert choose_iso_level(density_grid_of(model), model, away).surface_error_voxels is None


@pytest.mark.parametrize(
    ("values", "level", "message"),
    [
        (
            torch.zeros(4, 4, 4),
            None,
            "the field is empty: its density is at most 0: a ray across the box",
        ),
        (torch.full((4, 4, 4), 9.0), None, "the field has no surface: its density is 9 to 9"),
        (torch.full((4, 4, 4), torch.nan), None, "the density is not finite: 64 of 64 grid points are NaN"),
        (torch.linspace(1, 9, 64).reshape(4, 4, 4), 20.0, "no surface at density 20: density runs from 1 to 9"),
        (torch.linspace(1, 9, 64).reshape(4, 4, 4), 0.5, "no surface at density 0.5: density runs from 1 to 9"),
    ],
)
def test_grids_without_a_surface_are_refused_in_words(values, level, message):
    with pytest.raises(StageError) as error:
        check_range(DensityGrid(values, -CORNER, CORNER), level)
    assert str(error.value).startswith(message)
    assert error.value.hint.startswith("Give --mesh.iso-level" if level else "Train")


def test_a_level_in_range_passes():
    check_range(DensityGrid(torch.linspace(1, 9, 64).reshape(4, 4, 4), -CORNER, CORNER), 5.0)
