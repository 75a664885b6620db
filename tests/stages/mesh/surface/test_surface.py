"""Marching cubes and mesh surgery: closed forms on a ball and a torus, and what is open."""

import math

import numpy as np
import pytest
import torch
from skimage.measure import marching_cubes

from nerf.fields.density_grid import DensityGrid, occupancy
from nerf.geometry.space_maps import Box, Ndc
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.surface import (
    Surface,
    border_vertices,
    components,
    face_areas,
    is_watertight,
    keep_faces,
    sample_surface,
    vertex_normals,
)
from stages.mesh.surface.decimation import decimate

LEVEL = 20.0
SHARPNESS = 0.02
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
TETRAHEDRON = Surface(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
)


def density_grid_of(distance, points=64):
    """Density LEVEL where the signed ``distance`` is zero, growing inwards: the occupancy is a logistic step."""
    axis = torch.linspace(-0.9, 0.9, points)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    corner = torch.full((3,), 0.9)
    return DensityGrid(LEVEL / math.log(2) * torch.nn.functional.softplus(-distance(grid) / SHARPNESS), -corner, corner)


def ball(points):
    return points.norm(dim=-1) - 0.6


def torus(points):
    return torch.stack([points[..., :2].norm(dim=-1) - 0.5, points[..., 2]], dim=-1).norm(dim=-1) - 0.2


def volume(surface):
    a, b, c = surface.vertices[surface.faces].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


def euler(surface):
    edges = len(surface.faces) * 3 // 2
    return len(surface.vertices) - edges + len(surface.faces)


def unsmoothed(grid):
    """Vertices of marching cubes on the bare occupancy."""
    index, *_ = marching_cubes(occupancy(grid, LEVEL).values.numpy(), 0.5, gradient_direction="ascent")
    return grid.low.double().numpy() + index * grid.spacing().double().numpy()


@pytest.mark.parametrize(
    ("distance", "area", "content", "characteristic"),
    [
        (ball, 4 * np.pi * 0.6**2, 4 / 3 * np.pi * 0.6**3, 2),
        (torus, 4 * np.pi**2 * 0.5 * 0.2, 2 * np.pi**2 * 0.5 * 0.2**2, 0),
    ],
)
def test_area_volume_and_topology_are_those_of_the_solid(distance, area, content, characteristic):
    surface = extract_surface(density_grid_of(distance), LEVEL)
    assert is_watertight(surface) and len(border_vertices(surface)) == 0
    assert euler(surface) == characteristic
    assert 0 < abs(float(face_areas(surface).sum()) / area - 1) < 0.015
    assert 0 < abs(volume(surface) / content - 1) < 0.03  # positive: faces are counter-clockwise from outside
    off = distance(torch.from_numpy(surface.vertices)).abs()
    # In voxels of 1.8 / 63; smoothing draws the tube, whose radius is seven of them, a tenth of one inwards.
    assert 0 < float(off.mean()) < 0.12 * 1.8 / 63 and float(off.max()) < 0.2 * 1.8 / 63


def test_grid_noise_is_not_drawn():
    clean, random = density_grid_of(ball), torch.Generator().manual_seed(0)
    noisy = clean._replace(values=clean.values * torch.exp(torch.randn(clean.values.shape, generator=random)))
    off = ball(torch.from_numpy(extract_surface(noisy, LEVEL).vertices)) / (1.8 / 63)
    raw = ball(torch.from_numpy(unsmoothed(noisy))) / (1.8 / 63)
    assert 0 < float(off.std()) < 0.4 * float(raw.std())


def test_normals_point_to_lower_density():
    surface = extract_surface(density_grid_of(ball), LEVEL)
    outward = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    assert 0.99 < float((vertex_normals(surface) * outward).sum(axis=1).min()) <= 1


def test_a_density_of_thirty_decades_makes_the_same_surface():
    grid = density_grid_of(ball)
    extreme = grid._replace(values=torch.where(grid.values > 10 * LEVEL, 1e30, grid.values))
    assert np.isfinite(extract_surface(extreme, LEVEL).vertices).all()
    assert volume(extract_surface(extreme, LEVEL)) == pytest.approx(volume(extract_surface(grid, LEVEL)), rel=0.01)


def test_a_step_is_put_halfway_between_full_and_empty():
    values = torch.zeros(12, 12, 12)
    values[:6] = 1e6
    corner = torch.full((3,), 1.1)
    surface = extract_surface(DensityGrid(values, -corner, corner), LEVEL)
    np.testing.assert_allclose(surface.vertices[:, 0], 0, atol=1e-6)  # between vertices at -0.1 and 0.1


def test_what_the_box_cuts_stays_open_there():
    surface = extract_surface(density_grid_of(lambda p: p[..., 2] + 0.31), LEVEL)
    assert not is_watertight(surface)
    border = border_vertices(surface)
    assert len(border) == 2 * 4 * 63
    np.testing.assert_allclose(np.abs(border[:, :2]).max(axis=1), 0.9, atol=1e-6)


def test_watertight_means_closed_and_consistently_wound():
    assert is_watertight(TETRAHEDRON)
    assert not is_watertight(TETRAHEDRON._replace(faces=TETRAHEDRON.faces[:3]))
    flipped = TETRAHEDRON.faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not is_watertight(TETRAHEDRON._replace(faces=flipped))
    assert len(border_vertices(TETRAHEDRON._replace(faces=TETRAHEDRON.faces[:3]))) == 6


def test_components_are_numbered_by_area():
    small = TETRAHEDRON.vertices * 0.5 + [3, 0, 0]
    both = Surface(
        np.concatenate([small, TETRAHEDRON.vertices]), np.concatenate([TETRAHEDRON.faces, TETRAHEDRON.faces + 4])
    )
    assert components(both).tolist() == [1] * 4 + [0] * 4
    large, old = keep_faces(both, components(both) == 0)
    assert old.tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(large.vertices, TETRAHEDRON.vertices)
    np.testing.assert_array_equal(large.faces, TETRAHEDRON.faces)


def test_normals_have_unit_length_also_on_lost_faces():
    more = np.concatenate([TETRAHEDRON.vertices, [[9.0, 9, 9], [1, 1, 1]]])
    normals = vertex_normals(Surface(more, np.concatenate([TETRAHEDRON.faces, [[1, 2, 5], [2, 1, 5]]])))
    np.testing.assert_allclose(normals[0], -np.ones(3) / np.sqrt(3))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_what_decimation_folds_onto_itself_goes_and_nothing_opens(monkeypatch):
    folded = np.array([[1, 2, 4], [4, 2, 1], [3, 3, 0]], np.int32)  # in one edge of the tetrahedron, and in another
    vertices = np.concatenate([TETRAHEDRON.vertices, [[1.0, 1, 1], TETRAHEDRON.vertices[0]]])
    slivers = np.array([[5, 2, 1], [0, 2, 5], [0, 5, 1], *TETRAHEDRON.faces[1:]], np.int32)  # 0 and 5 are in one place
    for faces in (TETRAHEDRON.faces, slivers):
        given = vertices, np.concatenate([folded, faces])
        monkeypatch.setattr("fast_simplification.simplify", lambda *_, given=given, **__: given)
        fewer = decimate(Surface(*given), 5, Box())
        assert len(fewer.faces) == len(faces) and is_watertight(fewer)


def test_decimation_keeps_the_shape_closed():
    surface = extract_surface(density_grid_of(torus), LEVEL)
    fewer = decimate(surface, len(surface.faces) // 4, Box())
    assert 0.2 < len(fewer.faces) / len(surface.faces) <= 0.25
    assert is_watertight(fewer) and euler(fewer) == 0
    assert 0 < abs(volume(fewer) / volume(surface) - 1) < 0.01
    assert decimate(surface, len(surface.faces), Box()) is surface


def test_decimation_leaves_borders_where_they_are():
    surface = extract_surface(density_grid_of(lambda p: p[..., 2] + 0.2 * p[..., 0].cos()), LEVEL)
    fewer = decimate(surface, len(surface.faces) // 3, Box())
    assert len(fewer.faces) < len(surface.faces) / 2
    before, after = (np.unique(border_vertices(s).round(9), axis=0) for s in (surface, fewer))
    np.testing.assert_array_equal(before, after)


def test_near_things_keep_faces_in_normalised_device_coordinates():
    """Two balls, the far one ten times as large: the photos show them alike, and the near one with more parallax."""
    space = Ndc((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (1.0, 1.0), 0.1)
    near = extract_surface(density_grid_of(ball), LEVEL)
    small = near.vertices / 6
    vertices = np.concatenate([small + np.array([0, 0, 0.3]), 10 * small + np.array([0, 0, 3.0])])
    both = Surface(vertices, np.concatenate([near.faces, near.faces + len(small)]))

    def share_of_near(of_space):
        fewer = decimate(both, len(both.faces) // 6, of_space)
        return (fewer.vertices[fewer.faces].mean(axis=1)[:, 2] < 0.45).mean()

    assert share_of_near(Box()) < 0.42 and share_of_near(space) > 0.6


def test_samples_lie_on_the_surface_and_are_uniform_by_area():
    points = sample_surface(SQUARE, TWO_TRIANGLES, 20000, seed=1)
    assert points.shape == (20000, 3) and (points[:, 2] == 0).all()
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=[8, 4], range=[[0, 2], [0, 1]])
    assert counts.sum() == 20000
    assert 0 < np.abs(counts - 625).max() < 5 * 25  # five standard deviations of a Poisson count


def test_large_and_small_triangles_get_their_share():
    vertices = np.concatenate([SQUARE, SQUARE * 0.1 + [0, 0, 5]])
    faces = np.concatenate([TWO_TRIANGLES, TWO_TRIANGLES + 4])
    points = sample_surface(vertices, faces, 10100, seed=0)
    assert abs((points[:, 2] > 1).sum() - 100) <= 1  # stratified: exact but for the stratum on the border


def test_the_seed_decides_the_samples():
    first, again, other = (sample_surface(SQUARE, TWO_TRIANGLES, 10, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("faces", [np.zeros((0, 3), int), np.array([[0, 1, 1]])])
def test_a_mesh_without_area_is_refused(faces):
    with pytest.raises(ValueError, match="without area"):
        sample_surface(SQUARE, faces, 10, 0)
