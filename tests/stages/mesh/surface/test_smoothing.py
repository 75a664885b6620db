"""Smoothing takes the noise of faces away and leaves edges and positions where they are."""

import numpy as np
import pytest
import trimesh

from stages.mesh.surface import Surface, face_area_vectors, unit
from stages.mesh.surface.smoothing import smoothed


def box(side: int = 24) -> Surface:
    """A cube of edge 2 around the origin, each side cut into so many squares."""
    line = np.linspace(-1, 1, side + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1)
    square = np.concatenate([first[:, None] + corners for corners in ([0, side + 1, side + 2], [0, side + 2, 1])])
    vertices, faces = [], []
    for axis in range(3):
        for end in (-1, 1):
            points = np.stack([np.full_like(u, end), u if end > 0 else v, v if end > 0 else u], -1).reshape(-1, 3)
            faces.append(square + sum(map(len, vertices)))
            vertices.append(np.roll(points, axis, axis=1))
    position, which = np.unique(np.concatenate(vertices).round(9), axis=0, return_inverse=True)
    return Surface(position, which.reshape(-1)[np.concatenate(faces)].astype(np.int32))


def noisy(surface: Surface, deviation: float) -> Surface:
    return surface._replace(
        vertices=surface.vertices + np.random.default_rng(0).normal(0, deviation, surface.vertices.shape)
    )


def angles(a: Surface, b: Surface) -> np.ndarray:
    """Degrees between the normals of the same faces."""
    cosine = (unit(face_area_vectors(*a)) * unit(face_area_vectors(*b))).sum(axis=1)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def test_noise_goes_and_edges_stay():
    true = box()
    rough = noisy(true, 0.006)
    smooth = smoothed(rough)
    assert angles(rough, true).mean() > 6
    assert angles(smooth, true).mean() < 2
    on_edge = (np.abs(true.vertices) == 1).sum(axis=1) >= 2
    off = np.abs(smooth.vertices - true.vertices).max(axis=1)
    assert np.median(off[on_edge]) < 0.01, "an edge of 0.08 moved by an eighth of that"
    assert np.linalg.norm(smooth.vertices, axis=1).max() > 1.7, "corners are at 1.732"


def test_a_ball_keeps_its_size():
    ball = trimesh.creation.icosphere(subdivisions=4)
    surface = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    smooth = smoothed(surface)
    assert np.abs(np.linalg.norm(smooth.vertices, axis=1) - 1).max() < 3e-3, "a thirtieth of an edge"


def test_faces_without_area_and_open_borders_stay_finite():
    sheet = Surface(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.1], [1, 1, 0.1]]),
        np.array([[0, 1, 2], [1, 3, 2], [1, 3, 4]], np.int32),
    )
    assert np.isfinite(smoothed(sheet).vertices).all()
    point = Surface(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(smoothed(point).vertices, 0)


@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_a_plane_far_from_the_origin_stays_a_plane(shift: float):
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    plane = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) + shift, faces)
    np.testing.assert_allclose(smoothed(plane).vertices, plane.vertices, atol=1e-9 + 1e-9 * shift)
