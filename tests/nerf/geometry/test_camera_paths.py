import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf.geometry.camera_paths import (
    average_pose,
    interpolated,
    keeps_clear,
    levelled,
    look_at,
    nearest_rotations,
    orbit,
    spiral,
    suits_spiral,
    zoomed,
)
from tests.camera_layouts import ring, room, survey, wall

PATHS = {
    "orbit of a circle": lambda n: orbit(ring(), n),
    "orbit of an arc": lambda n: orbit(ring(arc_deg=100.0), n),
    "spiral": lambda n: spiral(wall(), n),
    "interpolated": lambda n: interpolated(room(), n),
}
LOOPED = sorted(set(PATHS) - {"interpolated"})


def hemisphere(count: int = 60) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, 3)) * [1, 1, 0.8]
    directions[:, 2] = np.abs(directions[:, 2]) + 0.05
    return look_at(4 * directions / np.linalg.norm(directions, axis=1, keepdims=True), np.zeros(3))


def steps(poses: np.ndarray) -> np.ndarray:
    """Change from frame to frame, turning and moving taken together."""
    return np.linalg.norm(np.diff(poses.reshape(-1, 12), axis=0), axis=1)


def turns(poses: np.ndarray) -> np.ndarray:
    """Degrees from frame to frame."""
    chord = np.linalg.norm(np.diff(poses[:, :, :3], axis=0), axis=(1, 2))
    return np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1)))


def facing(centres: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Cameras at ``centres`` that look along ``directions``."""
    return np.concatenate([look_at(c[None], c + d) for c, d in zip(centres, directions, strict=True)])


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("frames", [2, 24, 61])
def test_poses_are_orthonormal_and_right_handed(path: str, frames: int) -> None:
    poses = PATHS[path](frames)
    assert poses.shape == (frames, 3, 4)
    rotation = poses[:, :, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)


@pytest.mark.parametrize("path", LOOPED)
def test_looped_paths_close_without_a_jump(path: str) -> None:
    poses = PATHS[path](60)
    closing = np.linalg.norm(poses[0] - poses[-1])
    assert closing <= 1.01 * steps(poses).max()


@pytest.mark.parametrize("path", PATHS)
def test_motion_is_smooth_and_more_frames_make_smaller_steps(path: str) -> None:
    coarse, fine = steps(PATHS[path](61)), steps(PATHS[path](121))
    assert 0 < fine.max() < 0.8 * coarse.max()


def test_orbit_stands_and_looks_as_the_cameras_did() -> None:
    poses = orbit(ring(radius=4.0, height=1.5), 36)
    centres = poses[:, :, 3]
    np.testing.assert_allclose(np.hypot(centres[:, 0], centres[:, 1]), 4.0, atol=1e-6)
    np.testing.assert_allclose(centres[:, 2], 1.5, atol=1e-6)
    np.testing.assert_allclose(poses[:, :, 2], -centres / np.linalg.norm(centres, axis=1, keepdims=True), atol=1e-6)
    assert (poses[:, 2, 1] < 0).all()  # image y points down


def test_orbit_looks_where_the_cameras_near_each_frame_look() -> None:
    """At either end of a long thing, from both sides."""
    centres = ring(48)[:, :, 3]
    cameras = np.concatenate([look_at(c[None], np.array([c[0] / 4, 0.0, 0.0])) for c in centres])
    poses = orbit(cameras, 96)
    nearest = np.linalg.norm(poses[:, None, :, 3] - centres, axis=2).argmin(axis=1)
    off = np.degrees(np.arccos(np.clip(np.sum(poses[:, :, 2] * cameras[nearest, :, 2], axis=1), -1, 1)))
    assert off.max() < 6 and off.mean() < 3  # 11 and 6 where all look at one point


def test_orbit_of_an_arc_stays_within_it() -> None:
    centres = orbit(ring(arc_deg=100.0), 60)[:, :, 3]
    from_middle = np.degrees(np.arctan2(centres[:, 0], -centres[:, 1]))
    assert np.abs(from_middle).max() == pytest.approx(50, abs=0.5)


def test_orbit_follows_an_elliptic_ring() -> None:
    angle = 2 * np.pi * np.arange(40) / 40
    centres = np.stack([5 * np.cos(angle), 3 * np.sin(angle), 1 + 0.5 * np.sin(angle)], axis=1)
    path = orbit(look_at(centres, np.zeros(3)), 80)[:, :, 3]
    nearest = np.linalg.norm(path[:, None] - centres, axis=2).min(axis=1)
    assert nearest.max() < 0.45  # neighbours are 0.6 apart


def test_orbit_of_a_hemisphere_takes_its_middle_height() -> None:
    poses = orbit(hemisphere(), 60)
    distance = np.linalg.norm(poses[:, :, 3], axis=1)
    assert (poses[:, 2, 3] > 0.3).all()
    assert ((distance > 3) & (distance < 4.3)).all()


def test_orbit_from_straight_above_keeps_a_horizon() -> None:
    centres = np.array([[0.0, 1e-9, 4.0], [1e-9, 0.0, 4.0], [-1e-9, 0.0, 4.0]])
    poses = np.tile(np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]]), (3, 1, 1))
    poses[:, :, 3] = centres
    assert np.isfinite(orbit(poses, 12)).all()


def test_spiral_stays_among_the_cameras_and_looks_inwards() -> None:
    cameras = wall()
    poses = spiral(cameras, 60)
    low, high = cameras[:, :, 3].min(axis=0), cameras[:, :, 3].max(axis=0)
    assert (poses[:, :, 3] >= low - 1e-9).all()
    assert (poses[:, :, 3] <= high + 1e-9).all()
    assert np.ptp(poses[:, 0, 3]) > 0.5 * (high - low)[0]
    assert (poses[:, 1, 2] > 0.95).all()


@pytest.mark.parametrize(
    ("cameras", "suits"),
    [
        (wall(), True),
        (ring(arc_deg=30.0), True),
        (wall(rows=2, columns=30, spacing=0.6), False),  # 18 wide, from 4 away
        (survey() / np.array([1, 1, 1, 100.0]), False),
    ],
    ids=["grid", "arc", "facade", "survey"],
)
def test_a_spiral_suits_photos_that_look_where_it_looks(cameras: np.ndarray, suits: bool) -> None:
    assert suits_spiral(cameras) == suits
    asked = spiral(cameras, 48) if suits else interpolated(cameras, 48)
    off = np.degrees(np.arccos(np.clip(asked[:, :, 2] @ cameras[:, :, 2].T, -1, 1))).min(axis=1)
    assert off.max() < 15  # from the direction of some photo


def test_orbits_keep_clear_but_not_between_near_and_far() -> None:
    """Of an object of radius 1; far away something else stands before the photos, too."""

    def clear(cameras: np.ndarray) -> bool:
        near = np.minimum(np.linalg.norm(cameras[:, :, 3], axis=1) - 1, 2.0)
        return keeps_clear(orbit(cameras, 120), cameras, near)

    dome = np.concatenate([ring(12, radius=r, height=h) for r, h in ((2.4, 0.3), (2.0, 1.4), (1.0, 2.2))])
    near, far = ring(3, radius=1.5, height=0.3, arc_deg=40.0), ring(4, radius=7.5, height=0.3, arc_deg=20.0)
    assert clear(ring(8)) and clear(dome) and clear(ring(9, arc_deg=100.0))
    assert not clear(np.concatenate([near, far]))


def test_a_spiral_beside_a_walk_does_not_keep_clear() -> None:
    step = np.linspace(-1, 1, 11)
    walk = facing(np.stack([step, step - 3, 0 * step], axis=1), np.tile([0.0, 1.0, 0.0], (11, 1)))
    near = np.full(11, 0.3)
    assert not keeps_clear(spiral(walk, 120), walk, near) and keeps_clear(interpolated(walk, 120), walk, near)
    assert keeps_clear(spiral(wall(), 120), wall(), np.full(24, 0.3))


def test_a_path_zooms_with_photos_but_not_with_lens_changes() -> None:
    cameras = np.concatenate([ring(4, radius=1.0, arc_deg=10.0), ring(4, radius=9.0, arc_deg=10.0)])
    focals = np.repeat([0.5, 4.0], 4)
    focal = zoomed(cameras, focals, interpolated(cameras, 40))
    assert focal.max() > 2.5 and focal.min() < 0.8 and np.abs(np.diff(np.log(focal))).max() < 0.2
    around = ring(24)
    steady = zoomed(around, np.tile([0.5, 4.0], 12), orbit(around, 240))
    assert np.ptp(np.log(steady)) < 0.05
    np.testing.assert_allclose(zoomed(around, np.full(24, 1.3), orbit(around, 5)), 1.3)


def test_a_video_of_flights_to_and_fro_never_flips() -> None:
    flown = survey(9, 9) / np.array([1, 1, 1, 100.0])
    assert turns(interpolated(flown, 120)).max() > 150
    assert turns(interpolated(levelled(flown), 120)).max() < 1e-3
    np.testing.assert_allclose(levelled(flown)[:, :, 2:], flown[:, :, 2:], atol=1e-12)


def test_sideways_photos_of_a_wall_are_set_upright() -> None:
    upright = facing(wall()[:, :, 3], np.random.default_rng(0).normal([0, 1.0, 0], 0.2, (24, 3)))
    upright[3, :, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]  # looks straight down: nothing to set
    turned = upright.copy()
    turned[::2, :, 0], turned[::2, :, 1] = upright[::2, :, 1], -upright[::2, :, 0]
    np.testing.assert_allclose(levelled(turned), upright, atol=1e-12)


def test_interpolated_leads_past_every_camera_it_has_frames_for() -> None:
    cameras = room(12)
    poses = interpolated(cameras, 400)
    away = np.linalg.norm((poses[:, None] - cameras).reshape(400, 12, 12), axis=2).min(axis=0)
    assert away.max() < 0.5 * steps(cameras).min()


def test_interpolated_keeps_a_constant_speed() -> None:
    moved = steps(interpolated(room(), 300))
    assert moved.min() > 0.5 * moved.max()


def test_interpolated_walks_along_a_row_of_cameras_whatever_their_order() -> None:
    row = wall(rows=1, columns=9)
    shuffled = row[np.random.default_rng(0).permutation(9)]
    x = interpolated(shuffled, 120)[:, 0, 3]
    assert np.ptp(x) == pytest.approx(8 * 0.3, rel=1e-6)
    assert np.abs(np.diff(x)).sum() == pytest.approx(8 * 0.3, rel=1e-6)


@pytest.mark.parametrize("frames", [12, 20])
@pytest.mark.parametrize("away", [0.0, 0.5])
def test_interpolated_turns_steadily_where_photos_look_all_around(frames: int, away: float) -> None:
    angle = 2 * np.pi * np.random.default_rng(0).permutation(24) / 24
    directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turned = turns(interpolated(facing(away * directions, directions), frames))
    assert 180 <= turned.sum() < 360
    assert turned.max() < 1.2 * np.median(turned) < 40


@pytest.mark.parametrize("frames", [12, 24, 48, 96])
@pytest.mark.parametrize("ahead", [True, False])
@pytest.mark.parametrize("photos", [20, 40, 80])
def test_interpolated_walks_around_a_wall_as_the_photos_do(frames: int, ahead: bool, photos: int) -> None:
    """They stand along a U whose arms lie on both sides of a wall at y = 0, x < 6, and look ahead or all to +x."""
    on_arms, angle = np.linspace(-6, 6, photos), np.linspace(-1, 1, photos) * np.pi / 2
    straight = np.stack([6 - np.abs(on_arms), np.sign(on_arms), 0 * on_arms], axis=1)
    bend = np.stack([6 + np.cos(angle), np.sin(angle), 0 * angle], axis=1)[:: max(1, photos // 10)]
    directions = np.concatenate([-np.sign(on_arms), 1 - 2 * (bend[:, 1] > 0)])[:, None] * [1.0, 0, 0]
    cameras = facing(np.concatenate([straight, bend]), directions if ahead else np.abs(directions))
    centres = interpolated(cameras[np.random.default_rng(0).permutation(len(cameras))], frames)[:, :, 3]
    fine = np.linspace(centres[:-1], centres[1:], 10).reshape(-1, 3)
    assert (fine[fine[:, 0] < 6][:, 1] ** 2 > 0.5).all()
    assert np.ptp(fine[:, 0]) > 5 and np.ptp(fine[:, 1]) > 1.9  # on both sides of it
    assert fine[fine[:, 0] > 6, 0].max() > 6.7


def test_interpolated_stays_near_the_photos() -> None:
    """Far apart are only the ends of a way that winds through the scene: a helix of three turns."""
    angle = np.linspace(0, 6 * np.pi, 60)
    centres = np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)
    cameras = facing(centres, np.tile([1.0, 0, 0], (60, 1)))
    for frames in (24, 60, 120):
        path = interpolated(cameras, frames)[:, :, 3]
        away = np.linalg.norm(path[:, None] - centres, axis=2).min(axis=1)
        assert away.max() < np.linalg.norm(centres[1] - centres[0])


def test_interpolated_joins_groups_of_photos_where_they_are_nearest() -> None:
    """Each of two clusters has its neighbours within; the path goes over at their corners next to each other."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    cluster, aside = np.stack([x, y, 0 * x], axis=1), np.array([8.0, 8, 0])
    centres = np.concatenate([cluster, cluster + aside])
    path = interpolated(facing(centres, np.tile([1.0, 0, 0], (50, 1))), 120)[:, :, 3]
    between = path[(path[:, :2].min(axis=1) > 4.5) & (path[:, :2].max(axis=1) < 7.5)]
    assert len(between) > 2
    np.testing.assert_allclose(between[:, 0], between[:, 1], atol=0.5)


def test_interpolated_does_not_shake_with_the_hands() -> None:
    random = np.random.default_rng(0)
    centres = np.stack([np.linspace(0, 15, 300), *random.normal(scale=0.05, size=(2, 300))], axis=1)
    path = interpolated(facing(centres, random.normal([1.0, 0, 0], 0.05, (300, 3))), 120)
    moved, shaken = (np.linalg.norm(np.diff(path[:, :, 3], n, axis=0), axis=1).mean() for n in (1, 2))
    assert shaken < 0.15 * moved


@pytest.mark.parametrize("count", [1, 3, 30])
def test_interpolated_stands_still_where_all_photos_are_one(count: int) -> None:
    pose = ring()[3]
    np.testing.assert_allclose(interpolated(np.tile(pose, (count, 1, 1)), 10), np.tile(pose, (10, 1, 1)), atol=1e-6)


def test_paths_through_two_cameras_work() -> None:
    for path in (orbit, spiral, interpolated):
        assert np.isfinite(path(ring(arc_deg=20.0, count=2), 10)).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_nearest_rotation_is_the_identity_on_rotations_and_ignores_scale(seed: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    rotation = nearest_rotations(matrix)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(nearest_rotations(rotation * 7), rotation, atol=1e-9)


def test_average_pose_of_equal_poses_is_that_pose() -> None:
    pose = ring()[3]
    np.testing.assert_allclose(average_pose(np.tile(pose, (5, 1, 1))), pose, atol=1e-9)


def test_looking_is_along_z_with_up_up() -> None:
    pose = look_at(np.array([[3.0, 0, 1]]), np.zeros(3))[0]
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:, 2], -pose[:, 3] / np.linalg.norm(pose[:, 3]))
    assert pose[2, 1] < 0 and pose[2, 0] == 0  # image y runs down, image x is level
