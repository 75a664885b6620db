"""Frustums and visibility of a ball, in closed form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf.fields.density_grid import DensityGrid
from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.geometry.space_maps import Box
from stages.io.files import write_png
from stages.mesh.visibility import sample_rays, shadow_maps, unmasked_rays, vertex_visibility

RADIUS = 0.5
CORNER = torch.full((3,), 0.9)
VOXEL = 1.8 / 63
PINHOLE = Camera("PINHOLE", 120, 90, (140.0, 140.0, 60.0, 45.0))
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def scene_of(*centres, camera=PINHOLE, near=0.5, far=6.0, target=(0, 0, 0)):
    poses = look_at(np.array(centres, float), np.array(target, float))
    views = tuple(View(f"{i}.png", f"images/{i}.png", 0, pose, near, far, "train") for i, pose in enumerate(poses))
    return Scene((camera,), views, IDENTITY, True, False, "object-centric", True)


@pytest.fixture(scope="module")
def ball():
    axis = torch.linspace(-0.9, 0.9, 64)
    radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).norm(dim=-1)
    return DensityGrid(500 * torch.sigmoid((RADIUS - radius) / 0.01), -CORNER, CORNER)


@pytest.fixture(scope="module")
def normals():
    random = np.random.default_rng(0).normal(size=(3000, 3))
    return random / np.linalg.norm(random, axis=1, keepdims=True)


def looked(grid, scene, vertices, normals):
    maps = shadow_maps(grid, Box(), scene, Path(), scene.views, lambda done: None)
    return vertex_visibility(vertices, normals, maps, np.full(len(vertices), VOXEL))


def test_one_camera_covers_the_ball_and_sees_its_front(ball, normals):
    vertices = RADIUS * normals
    visibility = looked(ball, scene_of((2.5, 0, 0)), vertices, normals)
    assert (visibility.in_frustum == 1).all()
    towards = vertices - [2.5, 0, 0]
    facing = -(towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    assert (visibility.visible[facing > 0.15] == 1).all()
    assert (visibility.visible[facing < 0.05] == 0).all()


def test_directions_are_the_cameras_or_the_inward_normal(ball, normals):
    vertices = RADIUS * normals
    visibility = looked(ball, scene_of((2.5, 0, 0)), vertices, normals)
    towards = vertices - [2.5, 0, 0]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    expected = np.where(visibility.visible[:, None] > 0, towards, -normals)
    assert 0 < visibility.visible.sum() < len(vertices)
    np.testing.assert_allclose(visibility.direction, expected, atol=1e-12)


def test_two_cameras_count_twice_and_their_directions_are_weighted(ball):
    normals = np.array([[1.0, 0, 0], [2**-0.5, 2**-0.5, 0], [0, 1.0, 0]])
    visibility = looked(ball, scene_of((2.5, 0, 0), (0, 2.5, 0)), RADIUS * normals, normals)
    assert visibility.visible.tolist() == [1, 2, 1]
    np.testing.assert_allclose(visibility.direction, -normals, atol=1e-12)


def test_an_occluder_hides_what_is_behind_it():
    values = torch.zeros(64, 64, 64)
    values[50:53, :32] = 500.0  # a wall at x = 0.55, y < 0
    points = np.array([[-0.5, 0.4, 0], [-0.5, -0.4, 0]])
    visibility = looked(
        DensityGrid(values, -CORNER, CORNER), scene_of((2.5, 0, 0)), points, np.tile([1.0, 0, 0], (2, 1))
    )
    assert visibility.in_frustum.tolist() == [1, 1] and visibility.visible.tolist() == [1, 0]


@pytest.mark.parametrize(("near", "far", "covered"), [(0.5, 6.0, 1), (2.2, 6.0, 0), (0.5, 1.8, 0)])
def test_only_points_between_near_and_far_are_in_the_frustum(ball, near, far, covered):
    point = np.array([[0.5, 0, 0]])
    visibility = looked(ball, scene_of((2.5, 0, 0), near=near, far=far), point, np.array([[1.0, 0, 0]]))
    assert visibility.in_frustum.tolist() == [covered]


def test_points_beside_and_behind_the_camera_are_outside(ball):
    """The image is 120 px wide at a focal length of 140 px: from 2.5 away it reaches 1.071 to either side."""
    points = np.array([[0, 1.05, 0], [0, 1.09, 0], [0, 0, 0.79], [0, 0, 0.82], [5.0, 0, 0]])
    visibility = looked(ball, scene_of((2.5, 0, 0)), points, np.tile([1.0, 0, 0], (5, 1)))
    assert visibility.in_frustum.tolist() == [1, 0, 1, 0, 0]


def test_distortion_that_folds_back_adds_nothing_to_the_frustum(ball):
    """With k1 = -0.3 the image radius shrinks again beyond tan(angle) = 1.05, and returns to 0 at 1.83."""
    folding = Camera("SIMPLE_RADIAL", 120, 90, (140.0, 60.0, 45.0, -0.3))
    points = np.array([[0.0, 0.5, 0], [0.0, 2.5 * 1.8, 0]])
    visibility = looked(ball, scene_of((2.5, 0, 0), camera=folding), points, np.tile([1.0, 0, 0], (2, 1)))
    assert visibility.in_frustum.tolist() == [1, 0]


def test_many_photos_share_the_rays(ball, monkeypatch):
    monkeypatch.setattr("stages.mesh.visibility.NUM_RAYS", 1000)
    monkeypatch.setattr("stages.mesh.visibility.MIN_MAP_SIDE", 10)
    told = []
    for count, shape in ((1, (27, 37)), (10, (9, 12)), (40, (8, 10))):
        scene = scene_of(*[(2.5, 0, 0)] * count)
        maps = shadow_maps(ball, Box(), scene, Path(), scene.views, told.append)
        assert [m.depth.shape for m in maps] == [shape] * count
    assert told[0] == told[-1] == 1.0 and len(told) == 51


def test_masked_pixels_are_outside_the_frustum_and_give_no_rays(ball, normals, tmp_path):
    mask = np.full((90, 120), 255, np.uint8)
    mask[:, :60] = 0
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / "0.png", mask)
    scene = scene_of((2.5, 0, 0))
    masked = replace(scene, views=(replace(scene.views[0], mask="masks/0.png"),))
    maps = shadow_maps(ball, Box(), masked, tmp_path, masked.views, lambda done: None)
    vertices = RADIUS * normals
    local = (vertices - scene.views[0].scene_from_camera[:, 3]) @ scene.views[0].scene_from_camera[:, :3]
    visibility = vertex_visibility(vertices, normals, maps, np.full(len(vertices), VOXEL))
    assert (visibility.in_frustum[local[:, 0] < -0.05] == 0).all() and (
        visibility.in_frustum[local[:, 0] > 0.05] == 1
    ).all()
    (whole,) = shadow_maps(ball, Box(), scene, tmp_path, scene.views, lambda done: None)
    assert len(unmasked_rays(maps[0]).near) == pytest.approx(len(unmasked_rays(whole).near) / 2, rel=0.05)


def test_rays_are_sampled_from_all_columns_of_the_photos(ball):
    scene = scene_of((2.5, 0, 0))
    (one,) = maps = shadow_maps(ball, Box(), scene, Path(), scene.views, lambda done: None)
    rows, columns = one.depth.shape
    drawn = sample_rays(maps, rows)  # as many as every ray of one column would be
    assert len(drawn.near) == rows and torch.equal(drawn.directions, sample_rays(maps, rows).directions)
    of_column = one.rays.directions.flatten(0, 1)
    number = [int((of_column - ray).norm(dim=-1).argmin()) % columns for ray in drawn.directions]
    assert len(set(number)) > columns / 4
    assert len(sample_rays(maps, 10**6).near) == rows * columns
