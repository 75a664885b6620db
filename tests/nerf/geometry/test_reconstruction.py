import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.camera_paths import nearest_rotations
from nerf.geometry.reconstruction import closest_point_to_lines, spatial_median

random = np.random.default_rng(0)


def test_spatial_median_of_a_symmetric_cloud_is_its_centre() -> None:
    points = random.normal(size=(50, 3))
    np.testing.assert_allclose(spatial_median(np.concatenate([points, -points]) + 7), 7, atol=1e-6)


def test_spatial_median_minimises_the_summed_distance() -> None:
    points = random.exponential(size=(31, 3))

    def cost(x: np.ndarray) -> float:
        return float(np.linalg.norm(points - x, axis=1).sum())

    best = spatial_median(points)
    for offset in random.normal(size=(50, 3)):
        assert cost(best) < cost(best + 0.1 * offset)


def test_spatial_median_ignores_a_far_minority() -> None:
    points = random.normal(size=(100, 3))
    outliers = np.full((40, 3), 1e9)
    assert np.linalg.norm(spatial_median(np.concatenate([points, outliers]))) < 2


@given(st.integers(0, 1000), st.floats(1e-6, 1e6))
def test_spatial_median_is_equivariant(seed: int, scale: float) -> None:
    draw = np.random.default_rng(seed)
    points, shift = draw.normal(size=(9, 3)), draw.normal(size=3)
    turn = nearest_rotations(draw.normal(size=(3, 3)))
    moved = spatial_median(scale * points @ turn.T + shift)
    np.testing.assert_allclose((moved - shift) / scale, turn @ spatial_median(points), atol=1e-6 + 1e-15 / scale)


def test_spatial_median_of_coinciding_points() -> None:
    np.testing.assert_array_equal(spatial_median(np.ones((5, 3))), np.ones(3))


def test_lines_meet_though_a_third_are_wrong() -> None:
    target = np.array([1.0, 2.0, 3.0])
    origins = random.normal(size=(30, 3)) * 5
    directions = target - origins
    directions[:10] = random.normal(size=(10, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(closest_point_to_lines(origins, directions), target, atol=1e-4)


def test_parallel_lines_give_a_point_beside_their_origins() -> None:
    origins = random.normal(size=(30, 3))
    point = closest_point_to_lines(origins, np.tile([0.0, 0.0, 1.0], (30, 1)))
    assert np.linalg.norm(point - spatial_median(origins)) < 1
