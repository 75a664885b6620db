"""The report's picture of a mesh: from where it is taken."""

from dataclasses import replace

import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.geometry.space_maps import Box
from stages.mesh.files import ColouredMesh
from stages.mesh.preview import ELEVATION, SMALL_FACES, preview, small_copy, viewpoints

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
UP = np.array([0, 0, 1.0])


def scene_of(capture_type, centres, target=(0.0, 0, 0)):
    views = tuple(
        View(f"{i}", f"{i}", 0, look_at(np.array([c], float), np.array(target))[0], 0.1, 9.0, "train")
        for i, c in enumerate(centres)
    )
    camera = Camera("SIMPLE_PINHOLE", 40, 30, (40.0, 20.0, 15.0))
    return Scene((camera,), views, Similarity(1.0, np.eye(3), np.zeros(3)), True, False, capture_type, True)


def shows_all(camera):
    points = (CUBE - camera.from_camera[:, 3]) @ camera.from_camera[:, :3]
    pixels = points[:, :2] / points[:, 2:] * camera.focal_px
    return bool((points[:, 2] > 0).all() and (np.abs(pixels) < [camera.width / 2, camera.height / 2]).all())


@pytest.mark.parametrize(("last", "turned"), [((-2, -0.5, 0.4), 180.0), ((0.5, -2.0, 0.2), -90.0)])
def test_an_object_is_shown_from_the_photos_side(last, turned):
    scene = scene_of("object-centric", [(-0.1, 0, 3), (2, 0.5, 1.1), last])
    one, other = viewpoints(CUBE, scene)
    assert shows_all(one) and shows_all(other)
    side = -one.from_camera[:, 2]
    np.testing.assert_allclose(side, np.array([2, 0.5, 1.1]) / np.linalg.norm([2, 0.5, 1.1]))
    assert abs(np.degrees(np.arcsin(side[2])) - ELEVATION) < 5
    turn = np.radians(turned)
    around = [side[0] * np.cos(turn) - side[1] * np.sin(turn), side[0] * np.sin(turn) + side[1] * np.cos(turn)]
    np.testing.assert_allclose(-other.from_camera[:, 2], [*around, side[2]], atol=1e-12)


def test_a_facade_is_shown_from_the_cameras():
    scene = scene_of("forward-facing", [(-1, -3, 0), (0, -3, 0), (1.5, -3, 0)])
    one, other = viewpoints(CUBE, scene)
    assert shows_all(one) and shows_all(other)
    np.testing.assert_allclose(one.from_camera[:, 2], [0, 1, 0], atol=1e-12)
    assert other.from_camera[0, 2] < 0  # the camera on the right looks to the left


def test_a_photo_that_was_held_sideways_shows_the_mesh_upright():
    scene = scene_of("forward-facing", [(-1, -3, 0), (0, -3, 0), (1.5, -3, 0)])
    upright = viewpoints(CUBE, scene)
    turns = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    views = tuple(
        replace(view, scene_from_camera=np.c_[view.scene_from_camera[:, :3] @ turns, view.scene_from_camera[:, 3]])
        for view in scene.views
    )
    for seen, before in zip(viewpoints(CUBE, replace(scene, views=views)), upright, strict=True):
        assert np.allclose(seen.from_camera, before.from_camera)


def test_a_room_is_shown_from_inside():
    scene = scene_of("inside-out", [(0, 0, 0), (0.3, 0, 0)], target=(0.0, 5, 0))
    one, other = viewpoints(CUBE, scene)
    np.testing.assert_allclose(one.from_camera[:, 3], [0, 0, 0])
    np.testing.assert_allclose(other.from_camera[:, 3], [0.3, 0, 0])


@pytest.mark.parametrize("centre", [(0.01, 0, 3), (2, 0, 1)])
def test_the_picture_has_two_rows_of_colour_and_clay(monkeypatch, centre):
    monkeypatch.setattr("stages.mesh.preview.WIDTH", 40)
    monkeypatch.setattr("stages.mesh.preview.HEIGHT", 30)
    faces = np.array([[0, 2, 4], [2, 6, 4], [1, 5, 3], [3, 5, 7]], np.int32)
    red = np.tile(np.array([220, 20, 20], np.uint8), (8, 1))
    image = preview(ColouredMesh(CUBE, faces, CUBE, red), scene_of("object-centric", [centre])).astype(int)
    assert image.shape == (60, 80, 3)
    redness = image[..., 0] - image[..., 1]
    assert (redness[:, :40] > 60).any() and redness[:, 40:].max() < 20


def terrain(side: int) -> ColouredMesh:
    """A wavy square of 2 (side − 1)² faces far from the origin, red where it is high."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    z = 0.2 * np.sin(3 * x) * np.cos(2 * y)
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = (corner[i : side - 1 + i, j : side - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) + np.array([50.0, 0, 0])
    colours = np.stack([np.where(z > 0, 255, 0), 0 * z, 0 * z], axis=-1).reshape(-1, 3).astype(np.uint8)
    return ColouredMesh(vertices, faces, np.tile(UP, (len(vertices), 1)), colours)


def test_the_copy_that_turns_is_small_and_the_same_shape():
    mesh = terrain(160)
    small = small_copy(mesh, Box())
    assert small is not None and 0.8 * SMALL_FACES < len(small["faces"]) <= SMALL_FACES
    assert sum(part.nbytes for part in small.values()) < 300_000
    back = small["positions"] / 32767 * small["radius"] + small["middle"]
    assert np.allclose(back.min(axis=0), mesh.vertices.min(axis=0), atol=1e-3)
    x, y, z = (back - [50, 0, 0]).T
    assert 0 < np.abs(z - 0.2 * np.sin(3 * x) * np.cos(2 * y)).max() < 0.005
    high = np.abs(z) > 0.02
    assert ((small["colours"][:, 0] == 255) == (z > 0))[high].all()


def test_a_mesh_that_is_all_borders_has_no_copy():
    mesh = terrain(120)
    loose = mesh._replace(vertices=mesh.vertices[mesh.faces.ravel()], colours=mesh.colours[mesh.faces.ravel()])
    assert (
        small_copy(loose._replace(faces=np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)), Box()) is None
    )
