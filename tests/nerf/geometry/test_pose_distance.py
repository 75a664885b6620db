import numpy as np
import pytest

from nerf.geometry.pose_distance import NEIGHBOURS, neighbour_weights, pose_distances


def poses(*x: float) -> np.ndarray:
    """Cameras side by side at these x."""
    found = np.repeat(np.eye(3, 4)[None], len(x), axis=0)
    found[:, 0, 3] = x
    return found


@pytest.mark.parametrize(("angle", "moved"), [(0.0, 0.0), (1e-9, 0.0), (0.5, 2.0), (np.pi, 0.3)])
def test_the_distance_is_scene_units_plus_radians(angle: float, moved: float):
    turned = poses(moved)
    turned[0, :, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    assert pose_distances(poses(0.0)[0], turned)[0] == pytest.approx(moved + angle, abs=1e-12)


def test_the_nearest_tell_most_and_far_ones_nothing():
    weights = neighbour_weights(poses(0.0), poses(1.0, -2.0, 4.0, 3.0, 5.0, 6.0))
    expected = np.array([1, 1 / 4, 1 / 16, 1 / 9, 0, 0])
    np.testing.assert_allclose(weights[0], expected / expected.sum())
    assert np.count_nonzero(weights) == NEIGHBOURS


def test_photos_in_the_same_place_tell_everything():
    np.testing.assert_array_equal(neighbour_weights(poses(0.0), poses(1.0, 0.0, 0.0, 2.0)), [[0, 0.5, 0.5, 0]])


@pytest.mark.parametrize("count", [1, 2, 9])
def test_rows_are_shares_whatever_the_scale(count: int):
    random = np.random.default_rng(count)
    known, unseen = poses(*random.normal(size=count)), poses(*random.normal(size=3))
    weights = neighbour_weights(unseen, known)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    known[:, :, 3], unseen[:, :, 3] = 1e-100 * known[:, :, 3], 1e-100 * unseen[:, :, 3]
    np.testing.assert_allclose(neighbour_weights(unseen, known), weights)
