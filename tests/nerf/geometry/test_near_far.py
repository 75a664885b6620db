"""What cameras that took no photo may see; near and far of the photos themselves: mostly in test_normalisation.py."""

from dataclasses import replace

import numpy as np
import pytest

from nerf.geometry import near_far
from nerf.geometry.near_far import MIN_NEAR, near_and_far, near_and_far_between_views
from tests.camera_layouts import ball, ring, seen_by

PHOTOS = np.array([[0.0, 0, -2.5], [0.5, 0, -2.5], [-0.5, 0, -2.5], [0, 0, 9.0]])
NEAR, FAR = np.array([1.0, 1.1, 1.2, 0.1]), np.array([20.0, 30.0, 25.0, 90.0])


def ranges(centre: tuple[float, float, float], bounded: bool = False) -> tuple[float, float]:
    """Of one camera that looks along z."""
    pose = np.concatenate([np.eye(3), np.array(centre)[:, None]], axis=1)
    near, far = near_and_far_between_views(pose[None], PHOTOS, NEAR, FAR, bounded)
    return float(near[0]), float(far[0])


def test_among_photos_it_is_the_widest_range_of_those_nearby() -> None:
    near, far = ranges((0.0, 0, -2.5))
    assert (near, far) == (1.0, 30.5)


def test_a_step_aside_or_back_brings_nothing_nearer() -> None:
    assert ranges((0.0, 0.4, -2.5))[0] == ranges((0.0, 0, -3.5))[0] == 1.0


def test_what_photos_have_before_them_is_nearer_from_further_ahead() -> None:
    assert ranges((0.0, 0, -2.1))[0] == pytest.approx(0.6)
    assert ranges((0.0, 0, -1.0))[0] == MIN_NEAR


def test_cameras_between_near_photos_see_near_too() -> None:
    """As above the ground in a survey that is long beside its height."""
    pose = np.concatenate([np.eye(3), PHOTOS[0][:, None]], axis=1)[None]
    near, _ = near_and_far_between_views(pose, PHOTOS, 0.01 * NEAR, FAR, bounded=False)
    assert near[0] == pytest.approx(0.01 * NEAR[0])


def test_from_far_away_everything_is_within_far() -> None:
    assert ranges((0.0, 0, -32.5))[1] == pytest.approx(np.hypot(30, 0.5) + 30)


def test_in_a_bounded_scene_the_region_is_seen_whole() -> None:
    near, far = ranges((0.0, 0, -2.5), bounded=True)
    assert near < 2.5 - 0.9 < 2.5 + 0.9 < far


def test_the_order_of_observations_changes_nothing() -> None:
    scene = seen_by(ring(), ball())
    few = (scene.view != 3) | (np.cumsum(scene.view == 3) <= 9)  # too few to tell: all photos together do for it
    scene = replace(scene, view=scene.view[few], point=scene.point[few])
    shuffled = np.random.default_rng(0).permutation(len(scene.view))
    other = replace(scene, view=scene.view[shuffled], point=scene.point[shuffled])
    near, far = near_and_far(scene, bounded=False)
    np.testing.assert_array_equal(near_and_far(other, bounded=False), (near, far))
    assert near[3] == near_and_far(replace(scene, view=np.where(scene.view == 3, 4, scene.view)), bounded=False)[0][3]


def test_of_many_points_some_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = seen_by(ring(), ball())
    near, far = near_and_far(scene, bounded=False)
    monkeypatch.setattr(near_far, "MAX_POINTS", len(scene.points) // 3)
    of_some = near_and_far(scene, bounded=False)
    np.testing.assert_allclose(of_some, (near, far), rtol=0.1)
    monkeypatch.setattr(near_far, "MAX_POINTS", 1)
    assert (near_and_far(scene, bounded=False)[0] >= near).all()
