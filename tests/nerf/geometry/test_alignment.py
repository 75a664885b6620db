import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.alignment import align, align_poses
from nerf.geometry.camera_paths import nearest_rotations
from nerf.geometry.scene import Similarity


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 12), scale=st.floats(1e-3, 1e3), far=st.floats(0, 100))
def test_align_recovers_a_similarity(seed: int, count: int, scale: float, far: float):
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    true = Similarity(scale, nearest_rotations(random.normal(size=(3, 3))), far * random.normal(size=3))
    found = align(points, true.points(points))
    np.testing.assert_allclose(found.points(points), true.points(points), atol=1e-6 * scale, rtol=1e-6)
    assert found.scale == pytest.approx(scale, rel=1e-6)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_align_never_mirrors(seed: int):
    points = np.random.default_rng(seed).normal(size=(8, 3))
    found = align(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.linalg.norm(found.points(points) - points * [1, 1, -1]) > 1e-3


@given(seed=st.integers(0, 2**32 - 1))
def test_no_other_similarity_fits_better_than_align(seed: int):
    random = np.random.default_rng(seed)
    points, targets = random.normal(size=(2, 6, 3))
    best = align(points, targets)

    def cost(similarity: Similarity) -> float:
        return float(np.square(similarity.points(points) - targets).sum())

    for _ in range(5):
        turned = nearest_rotations(best.rotation + 0.01 * random.normal(size=(3, 3)))
        nearby = Similarity(best.scale * (1 + 0.01 * random.normal()), turned, best.translation)
        assert cost(nearby) >= cost(best)


@pytest.mark.parametrize("points", [np.eye(3)[:2], np.arange(12).reshape(4, 3) * 1.0, np.zeros((5, 3))])
def test_align_refuses_what_leaves_the_rotation_open(points: np.ndarray):
    with pytest.raises(ValueError, match=f"{len(points)} points on one line fit in more than one way"):
        align(points, points)


def cameras(random: np.random.Generator, count: int, spread: tuple[float, float, float]) -> np.ndarray:
    """Random poses, world_from_camera, whose centres are spread so far along x, y and z."""
    rotations = nearest_rotations(random.normal(size=(count, 3, 3)))
    return np.concatenate([rotations, random.normal(size=(count, 3, 1)) * np.array(spread)[:, None]], axis=2)


def moved(poses: np.ndarray, by: Similarity) -> np.ndarray:
    return np.array([by.pose(pose) for pose in poses])


@pytest.mark.parametrize("spread", [(1, 1, 1), (1, 0, 0), (1, 1e-3, 1e-3), (0, 0, 0)])
def test_poses_are_aligned_however_they_stand(spread: tuple[float, float, float]):
    """On a line, too, about which the centres alone leave the rotation open."""
    random = np.random.default_rng(0)
    poses = cameras(random, 10, spread)
    true = Similarity(1.0 if not any(spread) else 3.0, nearest_rotations(random.normal(size=(3, 3))), np.ones(3))
    found = align_poses(poses, moved(poses, true))
    np.testing.assert_allclose(moved(poses, found), moved(poses, true), atol=1e-9)
    assert found.scale == pytest.approx(true.scale)


def test_a_pose_that_is_far_off_does_not_count():
    random = np.random.default_rng(1)
    poses = cameras(random, 12, (1, 1, 1))
    targets = poses + np.concatenate([np.zeros((12, 3, 3)), random.normal(0, 1e-3, (12, 3, 1))], axis=2)
    targets[4] = cameras(random, 1, (50, 50, 50))
    found = align_poses(poses, targets)
    assert found.scale == pytest.approx(1, abs=2e-3)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found.translation, 0, atol=3e-3)
