"""The software renderer: coverage in closed form, a brute-force ray cast, and cameras that frame what they show."""

import numpy as np
import pytest

from stages.mesh.rasteriser import SUPERSAMPLING, Viewpoint, frame_mesh, rasterise, shade

FORWARD = np.eye(3, 4)  # at the origin, looking along +z
CAMERA = Viewpoint(FORWARD, 50.0, 64, 48)
SQUARE = np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0.2, 0.2, 1], [-0.2, 0.2, 1]])
FACING = np.array([[0, 2, 1], [0, 3, 2]])  # counter-clockwise seen from the camera


def plain(colour, count=4):
    return np.tile(np.array(colour, np.uint8), (count, 1))


def preview(vertices, faces, colours, camera, shading=1.0):
    return shade(rasterise(vertices, faces, camera), faces, colours, camera, shading)


def shown(image, colour):
    return (image == colour).all(axis=2)


def test_a_square_covers_exactly_its_pixels():
    image = preview(SQUARE, FACING, plain((200, 10, 30)), CAMERA, shading=0)
    assert image.shape == (48, 64, 3) and image.dtype == np.uint8
    expected = np.zeros((48, 64), bool)
    expected[14:34, 22:42] = True  # 0.2 × 50 px = 10 px to each side of the centre
    np.testing.assert_array_equal(shown(image, (200, 10, 30)), expected)


def test_the_nearer_face_wins_in_any_order():
    far = SQUARE * [1, 1, 2]
    vertices = np.concatenate([SQUARE, far])
    colours = np.concatenate([plain((200, 0, 0)), plain((0, 0, 200))])
    for faces in (np.concatenate([FACING, FACING + 4]), np.concatenate([FACING + 4, FACING])):
        image = preview(vertices, faces, colours, CAMERA, shading=0)
        assert shown(image, (200, 0, 0)).sum() == 400 and shown(image, (0, 0, 200)).sum() == 0


def test_colour_is_interpolated_in_perspective():
    """On a floor that recedes from depth 1 to depth 9 the colour runs evenly along the floor, not along the image."""
    floor = np.array([[-5.0, 0.2, 1], [5, 0.2, 1], [5, 0.2, 9], [-5, 0.2, 9]])
    colours = np.array([[0] * 3, [0] * 3, [240] * 3, [240] * 3], np.uint8)
    camera = Viewpoint(FORWARD, 200.0, 40, 100)
    column = preview(floor, np.array([[0, 1, 2], [0, 2, 3]]), colours, camera, shading=0)[:, 20, 0].astype(float)
    rows = np.arange(60, 88)
    depth = 0.2 * 200 / (rows + 0.5 - 50)
    np.testing.assert_allclose(column[rows], 240 * (depth - 1) / 8, atol=1.5)


def test_random_triangles_agree_with_casting_a_ray_per_pixel():
    random = np.random.default_rng(5)
    vertices = random.uniform(-1.5, 1.5, (24, 3)) + np.array([0, 0, 3])
    faces = np.arange(24).reshape(8, 3)
    colours = np.repeat(random.integers(30, 255, (8, 3)), 3, axis=0).astype(np.uint8)
    camera = Viewpoint(FORWARD, 40.0 / SUPERSAMPLING, 40, 40)
    image = preview(vertices, faces, colours, camera, shading=0)
    compared = 0
    for row in range(0, 40, 2):
        for column in range(40):
            hits = [ray_hits(vertices[faces], camera, column + x, row + y) for x in (0.25, 0.75) for y in (0.25, 0.75)]
            if len(set(hits)) == 1 and hits[0][0] >= 0 and not hits[0][1]:
                np.testing.assert_array_equal(image[row, column], colours[3 * hits[0][0]])
                compared += 1
    assert compared > 60


def ray_hits(triangles, camera, x, y):
    """The nearest triangle along a pixel's ray and whether its back is met (Möller and Trumbore 1997)."""
    ray = np.array([(x - camera.width / 2) / camera.focal_px, (y - camera.height / 2) / camera.focal_px, 1.0])
    nearest, depth, back = -1, np.inf, False
    for number, (a, b, c) in enumerate(triangles):
        u, v, t = np.linalg.solve(np.stack([b - a, c - a, -ray], axis=1), -a)
        if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < depth:
            nearest, depth, back = number, t, bool(np.cross(b - a, c - a) @ ray > 0)
    return nearest, back


def test_backs_are_tinted_and_light_comes_from_above():
    front = preview(SQUARE, FACING, None, CAMERA)
    back = preview(SQUARE, FACING[:, ::-1], None, CAMERA)
    assert int(front[24, 32].sum()) - int(back[24, 32].sum()) > 20
    tilted_up = SQUARE + [0, 0, 1] * np.array([[0], [0], [-0.3], [-0.3]])
    tilted_down = SQUARE + [0, 0, 1] * np.array([[-0.3], [-0.3], [0], [0]])
    assert int(preview(tilted_up, FACING, None, CAMERA)[24, 32].sum()) > int(
        preview(tilted_down, FACING, None, CAMERA)[24, 32].sum()
    )


@pytest.mark.parametrize("vertices", [SQUARE * [1, 1, -1], SQUARE + np.array([50, 0, 0]), SQUARE * [0, 1, 1]])
def test_nothing_to_see_is_the_background(vertices):
    empty = preview(SQUARE, FACING[:0], None, CAMERA)
    assert len(np.unique(empty[:, 0], axis=0)) > 5  # a gradient
    np.testing.assert_array_equal(preview(vertices, FACING, None, CAMERA), empty)


@pytest.mark.parametrize("towards", [(1.0, 0, 0.2), (-1, 2, 3), (0, 1, -0.5)])
def test_framing_shows_everything_and_fills_the_picture(towards):
    vertices = np.random.default_rng(0).normal(size=(500, 3)) * [1, 2, 0.3] + [10, -4, 2]
    camera = frame_mesh(vertices, np.array(towards), np.array([0, 0, 1.0]), 200, 150)
    points = (vertices - camera.from_camera[:, 3]) @ camera.from_camera[:, :3]
    assert (points[:, 2] > 0).all()
    reach = np.abs(points[:, :2] / points[:, 2:]) * camera.focal_px / [100, 75]
    assert 0.8 < reach.max() <= 0.92 + 1e-9
