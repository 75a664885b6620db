"""Surface sampling against closed forms."""

import numpy as np
import pytest

from stages.mesh.samples import sample_surface

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


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


def test_the_seed_decides():
    first, again, other = (sample_surface(SQUARE, TWO_TRIANGLES, 10, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("faces", [np.zeros((0, 3), int), np.array([[0, 1, 1]])])
def test_a_mesh_without_area_is_refused(faces):
    with pytest.raises(ValueError, match="without area"):
        sample_surface(SQUARE, faces, 10, 0)
