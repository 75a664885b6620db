import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at, nearest_rotations
from nerf.geometry.reconstruction import angles_deg
from nerf.geometry.up_vector import find_up, up_by_places
from tests.camera_layouts import ball, ring, seen_by, survey, wall

UP = np.array([0.0, 0.0, 1.0])


def rolled(poses: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Each camera turned about its own optical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, one = np.zeros_like(c), np.ones_like(c)
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return np.concatenate([poses[:, :, :3] @ turn, poses[:, :, 3:]], axis=2)


def test_level_cameras_give_the_exact_up() -> None:
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


@pytest.mark.parametrize("third", [(0.0, -3.0, 2.1), (0.0, -2.8, 0.7)], ids=["overhead", "crouching"])
def test_three_standpoints_always_share_a_plane_and_so_tell_nothing(third: tuple[float, float, float]) -> None:
    centres = np.array([(-1.8, -2.2, 1.5), (1.8, -2.2, 1.5), third])
    poses = rolled(look_at(centres, np.array([0.0, 0.0, 0.8])), np.array([2.0, -1.5, 1.0]))
    up = find_up(seen_by(poses, ball()))
    assert (up.known, up.source) == (True, "level horizons")
    assert angles_deg(up.direction, UP) < 5


def test_wall_photos_take_up_from_their_upper_edges() -> None:
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


@pytest.mark.parametrize("turned", [90.0, -90.0])
@pytest.mark.parametrize("seed", range(3))
def test_sideways_photos_all_around_take_up_from_their_centres(turned: float, seed: int) -> None:
    """Their upper edges cancel: the median of them is noise, and lies in the ring's plane."""
    random = np.random.default_rng(seed)
    poses = rolled(ring(count=24), turned + random.normal(0, 3, 24))
    poses[:, :, 3] += random.normal(0, 0.1, (24, 3))
    up = find_up(seen_by(poses, ball()))
    assert (up.known, up.source) == (True, "level standpoints")
    assert 0 < angles_deg(up.direction, UP) < 5


def test_sideways_level_photos_have_no_up() -> None:
    assert not find_up(seen_by(rolled(ring(height=0.1), np.full(16, 90.0)), ball())).known


def test_flights_to_and_fro_over_the_ground_know_up() -> None:
    up = find_up(seen_by(survey(), ball()))
    assert (up.known, up.source) == (True, "level standpoints")
    assert angles_deg(up.direction, UP) < 1e-5


@pytest.mark.parametrize(("error_m", "right"), [(0.5, True), (2.0, True), (6.0, False)])
def test_gps_tells_ground_from_wall_unless_far_off(error_m: float, right: bool) -> None:
    """All photos are turned one way, in a frame of its own scale and turn; 60 m of flight to either side."""
    turn = nearest_rotations(np.random.default_rng(3).normal(size=(3, 3)))
    poses = survey(lines=7)
    poses[:, :, :3] = poses[0, :, :3]
    sfm = seen_by(poses, ball()).in_frame(turn, np.array([5.0, 3, -2]), 0.1)
    enu_from_sfm = np.eye(4)
    enu_from_sfm[:3, :3] = 10 * turn.T
    places = up_by_places(sfm.centres, enu_from_sfm, error_m)
    assert places.tilt == pytest.approx(error_m / 60, rel=1e-6)  # the standard deviation of 7 lines, 30 m apart
    assert find_up(sfm).source == "upper edges"
    up = find_up(sfm, places)
    assert (up.known, up.source) == (True, "GPS" if right else "upper edges")
    assert (angles_deg(up.direction, turn @ UP) < 1e-5) == right


def test_the_more_certain_of_horizons_and_places_decides() -> None:
    tilted = np.eye(4)
    tilted[:3, :3] = nearest_rotations(np.array([[1.0, 0, 0], [0, 1, 0.05], [0, -0.05, 1]]))
    for roll, source in ((0.0, "level horizons"), (8.0, "GPS")):
        poses = rolled(ring(count=24), np.random.default_rng(0).normal(0, roll, 24))
        poses[:, 2, 3] += np.random.default_rng(1).normal(0, 1, 24)
        scene = seen_by(poses, ball())
        assert find_up(scene, up_by_places(scene.centres, tilted, 0.05)).source == source


def test_gps_along_a_line_leaves_roll_open() -> None:
    assert up_by_places(np.linspace(0, 90, 10)[:, None] * [1.0, 2, 0], np.eye(4), 0.1).tilt > 1e9
