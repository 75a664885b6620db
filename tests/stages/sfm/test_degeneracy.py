import numpy as np
import pytest

from nerf.synthetic.scenes import ring_of_cameras
from stages.sfm.degeneracy import (
    MAX_ROTATION_DEPARTURE,
    count_pure_rotations,
    departure_from_rotation,
    different_poses,
    epipoles_inside,
    flow_is_radial,
)

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


def test_a_turn_is_a_rotation_at_the_right_focal() -> None:
    assert departure_from_rotation(homographies(0), sizes(4), 0.8).max() < 1e-9
    assert departure_from_rotation(homographies(0)[:2], sizes(2), 1.6).min() > MAX_ROTATION_DEPARTURE


def test_turns_are_told_from_a_plane_without_the_focal_length() -> None:
    assert count_pure_rotations(homographies(0), sizes(4)) == 4
    assert (
        count_pure_rotations(homographies(0.1), sizes(4)) <= 1
    )  # with some focal length a single pair passes for a turn
    assert count_pure_rotations(np.zeros((0, 3, 3)), sizes(0)) == 0


@pytest.mark.parametrize("broken", [np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_a_homography_without_an_inverse_is_no_turn(broken: np.ndarray) -> None:
    assert count_pure_rotations(np.concatenate([homographies(0)[:1], broken[None]]), sizes(2)) == 1


def test_photos_of_two_sizes_have_a_calibration_each() -> None:
    half = np.diag([0.5, 0.5, 1.0])
    mixed = np.array([half @ one for one in homographies(0)])
    assert departure_from_rotation(mixed, np.tile([SIZE, SIZE // 2], (4, 1, 1)), 0.8).max() < 1e-9


# --- forward motion

AHEAD, ASIDE, BACK_AND_UP = np.array([0.05, -0.1, 1.0]), np.array([1.0, 0.1, 0.2]), np.array([0.0, -0.3, -1.0])


def fundamental(step: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """F = K⁻ᵀ [t]× R K⁻¹ of a camera that moved by ``step`` and then turned; of any scale."""
    t = -rotation @ step
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return -3.7 * np.linalg.inv(K).T @ cross @ rotation @ np.linalg.inv(K)


@pytest.mark.parametrize(("step", "inside"), [(AHEAD, True), (BACK_AND_UP, True), (ASIDE, False)])
def test_forward_motion_has_epipoles_in_the_picture(step: np.ndarray, inside: bool) -> None:
    found = epipoles_inside(np.array([fundamental(step, turn(3, axis)) for axis in range(3)]), sizes(3))
    assert found.tolist() == [inside] * 3


def test_both_epipoles_must_be_seen_and_there_must_be_some() -> None:
    turned_away = fundamental(AHEAD, turn(50, 1))  # the first photo shows where it goes, the second does not
    assert epipoles_inside(np.array([turned_away, np.zeros((3, 3))]), sizes(2)).tolist() == [False, False]


def seen(step: np.ndarray, rotation: np.ndarray, depths: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where 200 points are in two photos, the second taken a ``step`` on; some of them matched to another."""
    rng = np.random.default_rng(0)
    first = rng.uniform((0, 0), SIZE, (200, 2))
    points = rng.uniform(*depths, (200, 1)) * np.column_stack([first, np.ones(200)]) @ np.linalg.inv(K).T
    there = (points - step) @ rotation.T @ K.T
    second = there[:, :2] / there[:, 2:] + rng.normal(0, 0.3, (200, 2))
    second[:10] = second[10:0:-1]
    return first, second


@pytest.mark.parametrize(
    ("step", "rotation", "moves"),
    [
        (0.5 * AHEAD, np.eye(3), True),
        (-0.5 * AHEAD, np.eye(3), True),
        (0.5 * AHEAD, turn(1, 0), True),
        (0.5 * ASIDE, np.eye(3), False),
        (0 * AHEAD, turn(8, 1), False),
        (0 * AHEAD, turn(8, 2), False),
    ],
    ids=["ahead", "back", "ahead and a little down", "aside", "turned", "rolled"],
)
@pytest.mark.parametrize("depths", [(3.0, 6.0), (5.0, 5.0)], ids=["deep", "flat"])
def test_what_moves_away_from_one_point_is_approached(
    step: np.ndarray, rotation: np.ndarray, moves: bool, depths: tuple[float, float]
) -> None:
    assert flow_is_radial(*seen(step, rotation, depths), SIZE) == moves


def test_what_does_not_move_is_not_approached() -> None:
    first, _ = seen(AHEAD, np.eye(3), (3.0, 6.0))
    assert not flow_is_radial(first, first, SIZE)
    assert not flow_is_radial(first[:1], first[:1] + 1, SIZE)


# --- repeated structure


def in_other_frame(poses: np.ndarray) -> np.ndarray:
    """The same poses in a frame of another scale, turned and moved."""
    rotation = turn(70, 2) @ turn(-30, 0)
    centres = 3.5 * poses[:, :, 3] @ rotation.T + [5.0, -2.0, 1.0]
    return np.concatenate([rotation @ poses[:, :, :3], centres[:, :, None]], axis=2)


def disturbed(poses: np.ndarray) -> np.ndarray:
    """By a degree, and a hundredth of the distance between cameras."""
    rng = np.random.default_rng(1)
    poses = poses.copy()
    poses[:, :, :3] = poses[:, :, :3] @ turn(1, 0)
    poses[:, :, 3] += rng.normal(0, 0.015, (len(poses), 3))
    return poses


def extent(poses: np.ndarray) -> float:
    return float(np.sqrt(poses[:, :, 3].var(axis=0).sum()))


def test_poses_are_equal_up_to_a_similarity() -> None:
    poses = ring_of_cameras(12)
    assert not different_poses(poses, in_other_frame(disturbed(poses)), extent(poses)).any()
    assert not different_poses(poses[:2], in_other_frame(poses)[[1, 0]], extent(poses)).any()  # too few to tell
    assert not different_poses(poses[[3, 3, 3]], poses[[3, 3, 3]], extent(poses)).any()


def test_photos_taken_for_another_side_have_different_poses() -> None:
    """Of a square tower the second model takes the last four photos for photos of the next side."""
    poses = ring_of_cameras(12)
    folded = disturbed(poses)
    folded[8:] = np.concatenate([turn(90, 2) @ poses[8:, :, :3], (turn(90, 2) @ poses[8:, :, 3:])], axis=2)
    assert different_poses(poses, in_other_frame(folded), extent(poses)).tolist() == [False] * 8 + [True] * 4


def test_photos_taken_for_the_next_window_have_different_poses() -> None:
    poses = ring_of_cameras(36)[:9]
    shifted = poses.copy()
    shifted[6:, :, 3] += [0.0, 0.5, 0.0]
    assert different_poses(poses, in_other_frame(shifted), extent(poses)).tolist() == [False] * 6 + [True] * 3
