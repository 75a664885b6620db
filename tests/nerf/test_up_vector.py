import numpy as np
import pytest

from nerf.camera_paths import nearest_rotations
from nerf.reconstruction import angles_deg
from nerf.up_vector import find_up
from tests.camera_layouts import ball, ring, seen_by, wall

UP = np.array([0.0, 0.0, 1.0])


def rolled(poses: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Each camera turned about its own optical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, one = np.zeros_like(c), np.ones_like(c)
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return np.concatenate([poses[:, :, :3] @ turn, poses[:, :, 3:]], axis=2)


def test_level_cameras_give_the_exact_up_even_when_all_look_down_from_one_side() -> None:
    up = find_up(seen_by(ring(arc_deg=100.0, height=4.0), ball()))
    assert up.known
    assert up.source in ("level horizons", "level standpoints")
    assert angles_deg(up.direction, UP) < 1e-5


def test_hand_held_roll_is_averaged_out() -> None:
    poses = rolled(ring(count=24), np.random.default_rng(0).normal(0, 5, 24))
    poses[:, :, 3] += np.random.default_rng(1).normal(0, 0.8, (24, 3))
    up = find_up(seen_by(poses, ball()))
    assert up.known
    assert 0 < angles_deg(up.direction, UP) < 5


def test_level_standpoints_decide_when_horizons_are_crooked() -> None:
    poses = rolled(ring(count=24), np.random.default_rng(0).normal(0, 10, 24))
    up = find_up(seen_by(poses, ball()))
    assert up.source == "level standpoints"
    assert angles_deg(up.direction, UP) < 1e-5


def test_cameras_that_all_face_a_wall_take_up_from_their_upper_edges_and_not_from_their_plane() -> None:
    up = find_up(seen_by(rolled(wall(), np.tile([-2.0, 2.0], 12)), ball()))
    assert up.source == "upper edges"
    assert angles_deg(up.direction, UP) < 1


def test_one_far_camera_does_not_tilt_the_standpoints() -> None:
    poses = rolled(ring(count=24), np.random.default_rng(0).normal(0, 10, 24))
    poses[5, :, 3] = [0.0, 0.0, 500.0]
    assert angles_deg(find_up(seen_by(poses, ball())).direction, UP) < 10


def test_a_few_photos_turned_by_ninety_degrees_change_little() -> None:
    roll = np.zeros(24)
    roll[[2, 9, 15]] = 90
    assert angles_deg(find_up(seen_by(rolled(ring(count=24), roll), ball())).direction, UP) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_tumbling_cameras_have_no_up(seed: int) -> None:
    poses = np.random.default_rng(seed).normal(size=(30, 3, 4))
    poses[:, :, :3] = nearest_rotations(poses[:, :, :3])
    up = find_up(seen_by(poses, ball()))
    assert not up.known
    np.testing.assert_array_equal(up.direction, -poses[0, :, 1])


def test_opposite_cameras_have_no_up_rather_than_nan() -> None:
    poses = rolled(wall(rows=1, columns=4), np.array([0.0, 180.0, 0.0, 180.0]))
    up = find_up(seen_by(poses, ball()))
    assert not up.known
    assert np.isfinite(up.direction).all()
