import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at
from stages.depth.neighbours import Tracks, choose_pairs, depth_range
from tests.camera_layouts import ball, ring, seen_by


def tracks_in(poses: np.ndarray, points: np.ndarray) -> Tracks:
    seen = seen_by(poses, points)
    return Tracks(points, np.asarray(seen.view), np.asarray(seen.point))


def anyhow(one: int, other: int) -> bool:
    return True


def test_neighbours_on_a_ring_lie_on_both_sides() -> None:
    poses = ring(36)  # 10° apart
    pairs = choose_pairs(poses, tracks_in(poses, ball(300)), 2, anyhow)
    assert {(j - i) % 36 for i, j in pairs} <= {1, 35}
    assert len(pairs) == 36


def test_what_is_not_usable_is_replaced_by_the_next() -> None:
    poses = ring(36)
    pairs = choose_pairs(poses, tracks_in(poses, ball(300)), 2, lambda i, j: (j - i) % 36 not in (1, 35))
    assert len(pairs) == 36
    assert {min((j - i) % 36, (i - j) % 36) for i, j in pairs} == {2}


def test_photos_from_one_place_or_of_other_things_are_none() -> None:
    pose = look_at(np.array([[0, -4.0, 0]]), np.zeros(3))
    away = look_at(np.array([[0.4, -4.0, 0]]), np.array([0.4, -8.0, 0]))
    poses = np.concatenate([pose, pose, away])
    assert choose_pairs(poses, tracks_in(poses, ball(300)), 4, anyhow) == []


def test_the_range_of_depths_holds_what_is_seen() -> None:
    poses = ring(36)
    points = ball(300)
    tracks = tracks_in(poses, points)
    low, high = depth_range(poses, tracks.points, tracks.sees(len(poses)), (0, 1), [])
    distance = np.linalg.norm(poses[0, :, 3])
    assert 0.6 * (distance - 1) < low < distance - 0.9
    assert distance + 0.9 < high < 2 * (distance + 1)


def test_near_and_far_tell_the_range_without_points() -> None:
    class View:
        near, far = 0.5, 9.0

    poses = ring(36)
    nothing = Tracks(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, int))
    views: list = [View(), View()]
    low, high = depth_range(poses, nothing.points, nothing.sees(len(poses)), (0, 1), views)
    assert (low, high) == (pytest.approx(0.5), pytest.approx(9.0))
