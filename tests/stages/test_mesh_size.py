"""How fine a lattice fits into the time there is."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.mesh_size import ONCE, affordable_resolution, resolution_in, seconds_of, yardstick


def test_the_resolution_grows_with_the_time_and_falls_with_what_things_take():
    times = [resolution_in(seconds, 2e-7, 0.02) for seconds in (-5.0, 5.0, 9.0, 12.0, 16.0, 1000.0)]
    assert times == sorted(times) and (times[0], times[-1]) == (64, 256)
    assert all(edge % 16 == 0 for edge in times) and len(set(times)) > 3
    assert resolution_in(20.0, 5e-6, 0.02) < resolution_in(20.0, 2e-7, 0.02)
    assert resolution_in(20.0, 2e-7, 0.04) < resolution_in(20.0, 2e-7, 0.02)
    # A slow field says nothing of how fast the rest is: what it draws in a minute is still looked for.
    assert resolution_in(120.0, 2e-5, 0.02) > 96


@given(st.floats(8.0, 60.0), st.floats(1e-7, 1e-5), st.floats(0.005, 0.1))
def test_the_resolution_chosen_fits_and_the_next_would_not(seconds: float, per_density: float, per_ball: float):
    edge = resolution_in(seconds, per_density, per_ball)
    assert seconds_of(edge, per_density, per_ball) <= seconds or edge == 64
    assert seconds_of(edge + 16, per_density, per_ball) > seconds or edge == 256
    assert seconds_of(edge, 2 * per_density, per_ball) > seconds_of(edge, per_density, per_ball) > ONCE * per_ball


def test_a_longer_training_gets_a_finer_lattice():
    assert [affordable_resolution(rays) for rays in (0, 10**5, 3 * 10**5, 10**9)] == [96, 128, 176, 256]


def test_the_yardstick_is_the_best_of_a_few(monkeypatch: pytest.MonkeyPatch):
    ticks = iter([0.0, 5.0, 10.0, 12.0, 20.0, 29.0])
    monkeypatch.setattr("stages.mesh_size.time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    assert yardstick() == 2.0
