"""Surface sampling and two-sided distances against closed forms."""

import numpy as np
import pytest

from stages.mesh_distance import sample_surface, two_sided

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


def test_parallel_planes_are_their_distance_apart():
    near = sample_surface(SQUARE, TWO_TRIANGLES, 4000, 0)
    distance = two_sided(near + np.array([0, 0, 0.5]), near)
    assert distance == pytest.approx((0.5, 0.5, 0.5), rel=1e-9)


def test_a_part_is_accurate_but_not_complete():
    whole = np.stack([np.linspace(0, 1, 1001), np.zeros(1001), np.zeros(1001)], axis=1)
    distance = two_sided(whole[:501], whole)
    assert distance.accuracy == 0
    assert distance.completeness == pytest.approx(0.125, rel=0.01)  # half of the points, 1/4 away on average
    assert distance.chamfer == distance.completeness / 2
    swapped = two_sided(whole, whole[:501])
    assert (swapped.accuracy, swapped.completeness) == (distance.completeness, distance.accuracy)


def test_empty_point_sets_are_refused():
    with pytest.raises(ValueError, match="distance of 0 to 4 points: neither may be empty"):
        two_sided(np.zeros((0, 3)), SQUARE)
