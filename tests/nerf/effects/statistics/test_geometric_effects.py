"""Scale variation, background, poses and rolling shutter."""

from dataclasses import replace

import numpy as np
import pytest

from nerf.effects.statistics.background import background_statistic, untracked_share
from nerf.effects.statistics.pose_refinement import common_residuals, pose_statistic
from nerf.effects.statistics.tracks import TrackColours
from nerf.effects.statistics.warnings import (
    across_rows,
    motion_to_next,
    rolling_shutter_statistic,
    scale_variation_statistic,
)
from tests.nerf.effects.statistics.photographed_points import photographed_points

SEEDS = range(20)


@pytest.mark.parametrize(("ratio", "called_for"), [(1.5, False), (3.0, None), (4.5, True)])
def test_the_ratio_of_footprints(ratio: float, called_for: bool | None) -> None:
    for seed in SEEDS:
        tracks = photographed_points(seed)
        near = tracks.view < 6  # every point is seen by five photos in a row: some by both kinds, some by one
        tracks = replace(tracks, footprint=np.where(near, 1.0, ratio))
        found = scale_variation_statistic(tracks)
        assert found.value == pytest.approx(ratio) and found.called_for is called_for


def test_far_and_near_photos_are_compared_through_others() -> None:
    """No point is seen by photos more than a third of the walk apart, the first of which are five times as far."""
    for seed in SEEDS:
        tracks = photographed_points(seed, views=30, per_point=4)
        walk = tracks.only(
            tracks.view + 4 > tracks.point * 0 + np.repeat(tracks.view[::4], 4)
        )  # none from last to first
        point_size = np.random.default_rng(seed).uniform(0.5, 2, walk.point.max() + 1)[walk.point]
        found = scale_variation_statistic(replace(walk, footprint=point_size * 6.0 ** (walk.view / 29)))
        assert found.called_for is True and 4.5 < found.value < 6
        assert found.words.startswith("pixel sizes differ 1.2-fold at one point, and ")


def test_a_few_false_points_are_no_scale() -> None:
    tracks = photographed_points(0)
    footprint = np.ones(len(tracks))
    footprint[:30:5] = 50
    assert 1 <= scale_variation_statistic(replace(tracks, footprint=footprint)).value < 1.2
    assert scale_variation_statistic(TrackColours.empty(2)).words == "not measured: no tracks"


@pytest.mark.parametrize("share", [0.0, 0.008, 0.05])
def test_background_is_modelled_unless_alpha_rules_it_out(share: float) -> None:
    position = np.zeros((4000, 3))
    position[: int(share * 4000), 2] = -5
    found = background_statistic(position, np.repeat(np.arange(4000), 3), None, 0.1)
    assert found.called_for is True and abs(found.value - share) < 1e-9
    assert np.isinf([found.threshold, found.noise]).all()  # neither decides anything
    assert f"{share:.1%} of the observations" in found.words and "10% of the photos' area" in found.words


def test_photos_may_tell_that_nothing_lies_beyond() -> None:
    assert background_statistic(np.full((9, 3), 5.0), np.arange(9), "alpha", 0.5).called_for is False
    assert background_statistic(np.zeros((0, 3)), np.zeros(0, int), "alpha", 1.0).called_for is False
    assert background_statistic(np.zeros((0, 3)), np.zeros(0, int), None, 1.0).words == "not measured: no tracks"


def test_untracked_parts_of_photos() -> None:
    middle = np.array([[0.5, 0.5]])
    assert untracked_share(middle, np.zeros(1, int), 1) == 1 - 9 / 256
    assert untracked_share(np.array([[0.0, 1.0]]), np.zeros(1, int), 2) == 1 - 4 / 512
    assert untracked_share(np.zeros((0, 2)), np.zeros(0, int), 3) == 1
    everywhere = np.stack(np.meshgrid(np.arange(16), np.arange(16)), -1).reshape(-1, 2) / 16 + 0.01
    assert untracked_share(everywhere, np.zeros(256, int), 1) == 0


def residuals(seed: int, shift_px: float, turn: float, views: int = 10, per_view: int = 150) -> tuple[np.ndarray, ...]:
    """Residuals of noise, some outliers, and of photos that are shifted and turned."""
    draw = np.random.default_rng(seed)
    view = np.repeat(np.arange(views), per_view)
    place = draw.uniform([0, 0], [1000, 700], (len(view), 2))
    residual = 0.5 * draw.normal(size=place.shape)
    residual[draw.random(len(view)) < 0.03] = [30.0, -20.0]
    direction = draw.uniform(0, 2 * np.pi, views)
    residual += shift_px * np.stack([np.cos(direction), np.sin(direction)], 1)[view]
    residual += turn * (place - [500, 350]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    order = draw.permutation(len(view))
    return residual[order], place[order], view[order]


def test_right_poses_are_left_alone() -> None:
    for seed in SEEDS:
        power, expected = common_residuals(*residuals(seed, 0, 0), views=10)
        assert 0.5 < power.mean() / expected.mean() < 2
        assert pose_statistic(power, expected, np.full(10, np.nan)).called_for is False


@pytest.mark.parametrize(("shift_px", "turn", "size_px"), [(1.0, 0.0, 1.0), (0.0, 0.003, 1.06), (5.0, 0.0, 5.0)])
def test_wrong_poses_are_seen(shift_px: float, turn: float, size_px: float) -> None:
    for seed in SEEDS:
        found = pose_statistic(*common_residuals(*residuals(seed, shift_px, turn), views=10), np.full(10, 0.02))
        assert found.called_for is True
        assert abs(found.value / size_px - 1) < 0.15


def test_uncertain_poses_leave_refinement_open() -> None:
    power, expected = common_residuals(*residuals(0, 0, 0), views=10)
    none = np.full(10, np.nan)
    for stated, called_for in ((1.5, None), (0.4, None), (0.2, False)):
        assert pose_statistic(power, expected, np.full(10, stated)).called_for is called_for
        assert pose_statistic(none, none, np.full(10, stated)).called_for is called_for


@pytest.mark.parametrize(("bad", "called_for"), [(1, False), (10, False), (30, True)])
def test_a_few_photos_do_not_call_for_refining_all(bad: int, called_for: bool) -> None:
    draw = np.random.default_rng(0)
    expected = draw.uniform(1e-3, 4e-3, 100)
    power = expected * draw.chisquare(4, 100) / 4
    stated = np.full(100, 0.03)
    stated[:bad] = 7.0
    assert pose_statistic(power, expected, stated).called_for is (None if called_for else False)
    power[:bad] += 7.0**2
    assert pose_statistic(power, expected, np.full(100, 0.03)).called_for is called_for


def test_photos_with_too_few_points_are_left_out() -> None:
    power, expected = common_residuals(np.ones((5, 2)), np.ones((5, 2)), np.zeros(5, int), 2)
    assert np.isnan(power).all() and np.isnan(expected).all()
    assert pose_statistic(power, expected, np.full(2, np.nan)).called_for is None
    assert len(common_residuals(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int), 0)[0]) == 0


@pytest.mark.parametrize(("readout", "called_for"), [(0.0, False), (0.5, True), (-0.5, True)])
def test_rows_taken_one_after_another(readout: float, called_for: bool) -> None:
    for seed in SEEDS:
        residual, place, view = residuals(seed, 0, 0)
        motion = np.random.default_rng(seed).normal(size=(10, 2)) * 8
        motion[9] = np.nan
        row = place[:, 1] / 700
        residual = (
            residual + np.where(view == 9, 0, readout * (row - 0.5))[:, None] * np.where(view == 9, 0, motion[view].T).T
        )
        found = rolling_shutter_statistic(residual, row, motion, view)
        assert found.called_for is called_for, found
        still = rolling_shutter_statistic(residual, row, np.full((10, 2), np.nan), view)
        assert still.called_for is False and np.isinf(still.noise)


def test_the_motion_of_a_video() -> None:
    place = np.random.default_rng(0).uniform(0, 100, (20, 2))
    xy = np.concatenate([place, place + np.array([3, -1]), place[:5]])
    point = np.concatenate([np.arange(20), np.arange(20), np.arange(5)])
    view = np.repeat([0, 1, 2], [20, 20, 5])
    motion = motion_to_next(xy, point, view, np.arange(3))
    np.testing.assert_allclose(motion[0], [3, -1])
    assert np.isnan(motion[1:]).all()
    assert np.isnan(motion_to_next(xy, point, view, np.array([0, 2, 3]))).all()  # a frame between them was left out


def test_rows_follow_each_other_along_the_shorter_side() -> None:
    xy, size = np.array([[3.0, 1.0], [3.0, 1.0]]), np.array([[4.0, 2.0], [4.0, 8.0]])
    np.testing.assert_allclose(across_rows(xy, size), [0.5, 0.75])
