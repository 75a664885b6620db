import numpy as np
import pytest

from stages.degeneracy import LIKE_A_ROTATION, count_turns, departure_from_rotation

SIZE = np.array([640, 480])
K = np.array([[512.0, 0, 320], [0, 512.0, 240], [0, 0, 1]])  # 0.8 of the longer side


def turn(degrees: float, axis: int) -> np.ndarray:
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[[i, i, j, j], [i, j, i, j]] = cos, -sin, sin, cos
    return rotation


TURNS = [turn(8, 1), turn(-12, 0), turn(5, 2) @ turn(10, 1), turn(20, 1)]


def homographies(step: float) -> np.ndarray:
    """Of a camera that turns, and moves sideways by ``step`` of its distance to a plane; of any scale and sign."""
    normal = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
    scenes = [rotation + np.outer([step, 0.3 * step, 0], normal) for rotation in TURNS]
    scales = (1.0, -2.5, 0.01, 300.0)
    return np.array([scale * K @ scene @ np.linalg.inv(K) for scale, scene in zip(scales, scenes, strict=True)])


def sizes(count: int) -> np.ndarray:
    return np.tile(SIZE, (count, 2, 1))


def test_a_turn_is_a_rotation_with_the_right_focal_length_only() -> None:
    assert departure_from_rotation(homographies(0), sizes(4), 0.8).max() < 1e-9
    assert departure_from_rotation(homographies(0)[:2], sizes(2), 1.6).min() > LIKE_A_ROTATION


def test_turns_are_told_from_a_plane_without_the_focal_length() -> None:
    assert count_turns(homographies(0), sizes(4)) == 4
    assert count_turns(homographies(0.1), sizes(4)) <= 1  # with some focal length a single pair passes for a turn
    assert count_turns(np.zeros((0, 3, 3)), sizes(0)) == 0


@pytest.mark.parametrize("broken", [np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_a_homography_without_an_inverse_is_no_turn(broken: np.ndarray) -> None:
    assert count_turns(np.concatenate([homographies(0)[:1], broken[None]]), sizes(2)) == 1


def test_photos_of_two_sizes_have_a_calibration_each() -> None:
    half = np.diag([0.5, 0.5, 1.0])
    mixed = np.array([half @ one for one in homographies(0)])
    assert departure_from_rotation(mixed, np.tile([SIZE, SIZE // 2], (4, 1, 1)), 0.8).max() < 1e-9
