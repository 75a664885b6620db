"""What a curve of quality against time tells."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.training.learning_curve import (
    MIN_DOUBLING_GAIN_DB,
    MIN_STEPS,
    diminishing_returns_seconds,
    last_doubling_gain,
    predicted_doubling_gain,
    quality_at,
)

LATEST = 8.0


def straight(per_doubling: float, doublings: int = 6) -> list[tuple[float, float]]:
    """As much for every doubling."""
    return [(2.0**k, 20 + per_doubling * k) for k in range(doublings + 1)]


def saturating(first: float, doublings: int = 10) -> list[tuple[float, float]]:
    """Every doubling buys half of what the one before did."""
    return [(2.0**k, 30 - first * 2 * 0.5**k) for k in range(doublings + 1)]


@given(st.floats(0.01, 3), st.floats(1, 64))
def test_quality_is_straight_in_the_logarithm_of_time(per_doubling: float, seconds: float):
    assert quality_at(straight(per_doubling), seconds) == pytest.approx(20 + per_doubling * math.log2(seconds))


@pytest.mark.parametrize("seconds", [0.5, 65.0])
def test_no_quality_beyond_the_curve(seconds: float):
    with pytest.raises(ValueError, match="no point on both sides"):
        quality_at(straight(1.0), seconds)


@given(st.floats(-1, 3), st.floats(0.1, 100))
def test_the_last_doubling_does_not_know_the_unit_of_time(per_doubling: float, unit: float):
    curve = [(seconds * unit, db) for seconds, db in straight(per_doubling)]
    assert last_doubling_gain(curve) == pytest.approx(per_doubling)


@pytest.mark.parametrize("curve", [[], [(1.0, 20.0)], [(1.0, 20.0), (1.9, 21.0)]])
def test_a_short_curve_tells_nothing(curve: list[tuple[float, float]]):
    assert (
        last_doubling_gain(curve) is None
        and predicted_doubling_gain(curve, 1000) is None
        and diminishing_returns_seconds(curve) is None
    )


def test_returns_diminish_where_doublings_begin_to_gain_little():
    # 4, 2, 1, 0.5, 0.25 …: from 16 on less than half a decibel, at 8 just that much.
    assert diminishing_returns_seconds(saturating(4.0)) == 16.0


@given(st.floats(MIN_DOUBLING_GAIN_DB, 3))
def test_returns_do_not_diminish_while_doublings_gain_much(per_doubling: float):
    assert diminishing_returns_seconds(straight(per_doubling * (1 + 1e-9))) is None


def test_returns_of_a_flat_curve_always_diminish():
    assert diminishing_returns_seconds(straight(0.1)) == 1.0


def test_a_late_rise_undoes_diminishing_returns():
    flat_then_steep = [(1.0, 20.0), (2.0, 20.1), (4.0, 20.2), (8.0, 22.0)]
    assert diminishing_returns_seconds(flat_then_steep) is None


@given(st.floats(-1, 4))
def test_the_next_doubling_buys_less_than_the_last(last: float):
    coming = predicted_doubling_gain(straight(last), MIN_STEPS)
    assert coming is not None
    assert coming.db == pytest.approx(0.71 * last) and 0 < coming.half_width < 0.5
    assert predicted_doubling_gain(straight(last), MIN_STEPS - 1) is None
