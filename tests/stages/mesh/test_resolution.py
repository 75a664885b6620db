"""How fine a grid fits into the time there is."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf import REGION_HALF_SIZE
from nerf.geometry.space_maps import Box
from stages.mesh.grid_space import points_of_grid
from stages.mesh.resolution import (
    FIXED_COST,
    MARGIN,
    MIN_POINTS,
    expected_seconds,
    grid_box,
    reference_seconds,
    resolution_from_training,
    resolution_within,
    slab_factor,
)

CUBE = np.array([[-REGION_HALF_SIZE] * 3, [REGION_HALF_SIZE] * 3])
GROUND = np.random.default_rng(0).uniform([-0.8, -0.8, -0.3], [0.8, 0.8, -0.1], (2000, 3))
FACADE = GROUND[:, [0, 2, 1]] * [1, 1, 0.2]


def test_resolution_grows_with_time():
    times = [resolution_within(seconds, 2e-7, 0.02) for seconds in (-5.0, 5.0, 9.0, 12.0, 16.0, 1000.0)]
    assert times == sorted(times) and (times[0], times[-1]) == (64, 256)
    assert all(edge % 16 == 0 for edge in times) and len(set(times)) > 3
    assert resolution_within(20.0, 5e-6, 0.02) < resolution_within(20.0, 2e-7, 0.02)
    assert resolution_within(20.0, 2e-7, 0.04) < resolution_within(20.0, 2e-7, 0.02)
    # A slow field says nothing of how fast the rest is: what it draws in a minute is still looked for.
    assert resolution_within(120.0, 2e-5, 0.02) > 96


@given(st.floats(8.0, 60.0), st.floats(1e-7, 1e-5), st.floats(0.005, 0.1))
def test_the_resolution_chosen_fits_and_the_next_would_not(seconds: float, per_density: float, per_ball: float):
    edge = resolution_within(seconds, per_density, per_ball)
    assert expected_seconds(edge, per_density, per_ball) <= seconds or edge == 64
    assert expected_seconds(edge + 16, per_density, per_ball) > seconds or edge == 256
    assert (
        expected_seconds(edge, 2 * per_density, per_ball)
        > expected_seconds(edge, per_density, per_ball)
        > FIXED_COST * per_ball
    )


def test_a_longer_training_gets_a_finer_lattice():
    assert [resolution_from_training(rays) for rays in (0, 10**5, 3 * 10**5, 10**9)] == [96, 128, 176, 256]


def test_the_yardstick_is_the_best_of_a_few(monkeypatch: pytest.MonkeyPatch):
    ticks = iter([0.0, 5.0, 10.0, 12.0, 20.0, 29.0])
    monkeypatch.setattr("stages.mesh.resolution.time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    assert reference_seconds() == 2.0


@pytest.mark.parametrize(("points", "flat"), [(GROUND, 2), (FACADE, 1)])
@pytest.mark.parametrize("capture_type", ["forward-facing", "inside-out"])
def test_a_flat_scenes_grid_spans_its_slice(points, flat, capture_type):
    stray = np.array([[0.1, 0.1, 0.85], [0.5, 0.85, 0.1], [0.0, 0.0, 30.0]])
    box = grid_box(capture_type, np.concatenate([points, stray]))
    ends = np.quantile(points[:, flat], [0, 1]) + np.array([-1, 1]) * 2 * REGION_HALF_SIZE * MARGIN
    np.testing.assert_allclose(box[:, flat], ends, atol=0.02)
    rest = [axis for axis in range(3) if axis != flat]
    np.testing.assert_array_equal(box[:, rest], CUBE[:, rest])


@pytest.mark.parametrize(
    ("points", "capture_type"),
    [
        (GROUND, "object-centric"),  # the vase on the table is bare
        (GROUND * [0.5, 0.5, 1], "forward-facing"),  # a poster on a bare wall
        (GROUND * [1, 1, 5] + [0, 0, 0.8], "forward-facing"),
        (GROUND[: MIN_POINTS - 1], "forward-facing"),
        (GROUND[:0], "forward-facing"),
        (GROUND + np.array([0, 0, 5]), "inside-out"),
    ],
)
def test_the_grid_spans_the_region_without_flat_points(points, capture_type):
    np.testing.assert_array_equal(grid_box(capture_type, points), CUBE)


@pytest.mark.parametrize("resolution", [16, 48, 77, 256])
def test_a_flat_box_has_as_many_points_and_smaller_voxels(resolution):
    none = np.zeros((0, 3))
    assert points_of_grid(Box(), CUBE, resolution, none) == 3 * (resolution,)
    assert slab_factor(CUBE) == pytest.approx(1)
    box = grid_box("forward-facing", GROUND)
    counts = points_of_grid(Box(), box, resolution, none)
    along = max(counts)
    assert along > 1.3 * resolution
    assert math.prod(counts) == pytest.approx(resolution**3, rel=4 / resolution)
    cut = slab_factor(box) * resolution**2
    assert cut == pytest.approx(along**2, rel=2 / resolution)


def test_a_flat_scene_costs_more_time_per_point():
    assert expected_seconds(128, 2e-7, 0.02, 2.0) > expected_seconds(128, 2e-7, 0.02)
    assert resolution_within(10.0, 2e-7, 0.02, 3.0) < resolution_within(10.0, 2e-7, 0.02)
