"""The density grid in normalised device coordinates: the same optical depths, and surfaces near and far."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf import REGION_HALF_SIZE
from nerf.fields.density_grid import median_depth, sample_density_grid
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, Contraction
from nerf.geometry.space_maps.ndc import Ndc
from stages.mesh.grid_space import DensityIn, VoxelSize, box_in, grid_space, in_scene, points_of_grid
from stages.mesh.iso_level import choose_iso_level
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.surface import Surface
from tests.refusals import refused

APEX, NEAR = (0.0, -1.4, 0.0), 0.6
FORWARD = Ndc(APEX, ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), (0.7, 0.7), NEAR)  # looks along +y
CUBE = np.array([[-REGION_HALF_SIZE] * 3, [REGION_HALF_SIZE] * 3])
WALLS = {0.9: 0.3, 2.1: 2.0}  # depth: how far to the side; the near one hides the middle of the far one
THICKNESS = 0.08  # of a wall, times its squared depth: as thick as cells of the field are there


class Walls:
    """A field of walls across the line of sight, all of the same optical thickness."""

    def density(self, points: Tensor) -> Tensor:
        depth = points[..., 1] - APEX[1]
        sigma = torch.zeros_like(depth)
        for wall, half in WALLS.items():
            inside = (depth > wall) & (depth < wall + THICKNESS * wall**2) & (points[..., 0].abs() < half)
            sigma = torch.where(inside, 60 / wall**2, sigma)
        return sigma


def rays_ahead(count: int) -> Rays:
    side = torch.linspace(-0.55, 0.55, count)
    directions = torch.stack([side, torch.ones(count), 0.3 * side], -1)
    length = directions.norm(dim=-1, keepdim=True)
    origin = torch.tensor(APEX).repeat(count, 1)
    return Rays(origin, directions / length, torch.full((count,), 0.3), torch.full((count,), 6.0))


def test_forward_facing_scenes_have_a_space_of_their_own() -> None:
    assert grid_space(FORWARD) is FORWARD
    assert grid_space(Contraction()) == grid_space(Box()) == Box()
    np.testing.assert_array_equal(box_in(Box(), CUBE), CUBE)


def test_the_box_holds_what_the_space_shows_of_the_region() -> None:
    low, high = box_in(FORWARD, CUBE)
    points = torch.from_numpy(np.random.default_rng(0).uniform(CUBE[0], CUBE[1], (4000, 3)))
    mapped = FORWARD.forward(points).numpy()
    shown = np.all(np.abs(mapped) <= FORWARD.half, axis=1)
    assert shown.sum() > 500 and np.all((mapped[shown] >= low) & (mapped[shown] <= high))
    assert high[2] < FORWARD.half - 0.1, "nothing is sampled beyond the region, to infinity"


def test_voxels_are_as_long_as_the_inverse_map_makes_them() -> None:
    vertices = np.array([[0.1, -0.6, 0.05], [0.0, 0.0, 0.0], [-0.3, 0.8, 0.2]])
    found = VoxelSize(FORWARD, np.array([0.02, 0.03, 0.01])).at(vertices)
    mapped = FORWARD.forward(torch.from_numpy(vertices))
    for length, step in ((found.along, (0.0, 0.0, 0.005)), (found.across, (0.0, 0.015, 0.0))):
        half = torch.tensor(step, dtype=torch.float64)
        measured = (FORWARD.inverse(mapped + half) - FORWARD.inverse(mapped - half)).norm(dim=-1)
        np.testing.assert_allclose(length, measured.numpy(), rtol=1e-3)
    assert found.along[2] > 4 * found.along[0]
    in_box = VoxelSize(Box(), np.full(3, 0.01)).at(vertices)
    np.testing.assert_array_equal(in_box, 0.01)


def test_voxels_are_cubes_at_the_depth_of_the_points() -> None:
    ahead = np.array([[0.1, 1.5, 0.0], [0.0, 1.6, 0.2], [0.0, 1.7, 0.0], [0.0, -1.0, 0.0]])
    points = ahead + np.array(APEX)
    box = box_in(FORWARD, CUBE)
    counts = np.array(points_of_grid(FORWARD, box, 128, points))
    lengths = VoxelSize(FORWARD, (box[1] - box[0]) / (counts - 1)).at(points[1:2])
    assert lengths.along[0] == pytest.approx(lengths.across[0], rel=0.05)
    assert counts.prod() == pytest.approx(128**3, rel=0.03)
    assert points_of_grid(Box(), CUBE, 128, points) == (128, 128, 128)
    assert min(points_of_grid(FORWARD, box, 64, np.zeros((0, 3)))) > 8


def test_a_region_that_no_photo_shows_is_named() -> None:
    behind = CUBE / 3 - [0, 3, 0]
    with refused("mesh.region-not-seen"):
        box_in(FORWARD, behind)


def test_what_lies_beyond_the_region_is_left_out() -> None:
    inside, outside = [[-0.1, 0, 0.3], [0.1, 0, 0.3], [0, 0.1, 0.3]], [[0.8, 0, 0.3], [0.85, 0, 0.3], [0.8, 0.1, 0.3]]
    mapped = Surface(np.array([*inside, *outside]), np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    kept = in_scene(mapped, FORWARD, CUBE)
    assert len(kept.faces) == 1 and np.all(np.abs(kept.vertices) <= REGION_HALF_SIZE)
    with refused("mesh.nothing-in-region"):
        in_scene(mapped, FORWARD, CUBE / 10 + [0, 5, 0])


def test_rays_stop_where_they_stop_in_the_scene() -> None:
    rays, field = rays_ahead(80), DensityIn(FORWARD, Walls())  # pyright: ignore[reportArgumentType]
    low, high = torch.tensor(box_in(FORWARD, CUBE), dtype=torch.float32)
    grid = sample_density_grid(field, 160, low, high)
    mapped = FORWARD.map_rays(rays)
    depth = mapped.to_scene(median_depth(grid, mapped.rays, 160)[:, None])[:, 0] * rays.directions[:, 1]
    near = (rays.directions[:, 0] / rays.directions[:, 1]).abs() < 0.3 / 0.95
    for wall, seen in zip(WALLS, (near, ~near), strict=True):
        middle = math.log(2) / 60 * wall**2
        assert seen.sum() >= 20
        torch.testing.assert_close(depth[seen].median(), torch.tensor(wall + middle), rtol=0.02, atol=0)


def found_of_walls(space: Ndc | Box) -> tuple[int, int]:
    """How many vertices the surface has by the front of each wall."""
    field = DensityIn(space, Walls())  # pyright: ignore[reportArgumentType]
    low, high = torch.tensor(box_in(space, CUBE), dtype=torch.float32)
    grid = sample_density_grid(field, 96, low, high)
    level = choose_iso_level(grid, field, space.map_rays(rays_ahead(200)).rays)
    depth = in_scene(extract_surface(grid, level.density), space, CUBE).vertices[:, 1] - APEX[1]
    near, far = (int((np.abs(depth / wall - 1) < 0.04).sum()) for wall in WALLS)
    return near, far


def test_near_walls_have_the_vertices_that_photos_show() -> None:
    (near, far), (near_in_scene, far_in_scene) = found_of_walls(FORWARD), found_of_walls(Box())
    assert near / far > 2 * near_in_scene / far_in_scene > 0
