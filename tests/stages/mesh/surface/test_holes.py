"""Holes closed: how large, how much is invented, and what is left open."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from stages.mesh.surface import Surface, face_areas, is_watertight, keep_faces
from stages.mesh.surface.holes import Closed, close_holes, separated


@pytest.fixture(scope="module")
def ball():
    line = np.linspace(-1, 1, 24)
    radius = np.linalg.norm(np.stack(np.meshgrid(line, line, line, indexing="ij")), axis=0)
    vertices, faces, _, _ = marching_cubes(0.8 - radius, 0.0, gradient_direction="descent")
    return Surface(vertices.astype(float) / 11.5 - 1, faces.astype(np.int32))


def without(surface, direction, cosine):
    """The surface without its cap around a direction."""
    middle = surface.vertices[surface.faces].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return keep_faces(surface, middle @ direction < cosine)[0]


def volume(surface):
    a, b, c = surface.vertices[surface.faces].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_ball_without_a_cap_is_closed_again(ball):
    open_ = without(ball, np.array([0, 0, 1.0]), 0.9)
    closed, told = close_holes(open_, 1.0)
    assert is_watertight(ball) and not is_watertight(open_) and is_watertight(closed)
    assert (told.holes, told.left) == (1, 0) and 0.02 < told.area_share < 0.1
    assert told.area_share == pytest.approx(1 - face_areas(open_).sum() / face_areas(closed).sum())
    assert 0.9 < volume(closed) / volume(ball) < 1, "the fan faces outwards"


def test_larger_holes_stay_open(ball):
    small = without(ball, np.array([0, 0, 1.0]), 0.97)
    both = without(small, np.array([0, 0, -1.0]), 0.5)
    closed, told = close_holes(both, 0.3)
    assert (told.holes, told.left) == (1, 1) and not is_watertight(closed)
    assert close_holes(both, 1.0)[1].holes == 2


def test_a_closed_surface_stays_as_it_is(ball):
    closed, told = close_holes(ball, 1.0)
    assert told == Closed(0, 0, 0.0) and len(closed.faces) == len(ball.faces)


def test_parts_that_touch_in_a_vertex_are_separated():
    """Two triangles point to point: each gets a border of its own."""
    touching = Surface(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0.0]]), np.array([[0, 1, 2], [0, 3, 4]])
    )
    assert len(separated(touching).vertices) == 6
    closed, told = close_holes(touching, 1.0)
    assert told.holes == 2 and is_watertight(closed)
