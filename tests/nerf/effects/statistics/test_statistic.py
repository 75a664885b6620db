from math import log10

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.effects.statistics.statistic import MIN_EFFECT, classify, decide, unknown

INFINITE = float("inf")


def test_the_minimum_effect_is_three_tenths_of_a_decibel() -> None:
    assert abs(-10 * log10(1e-3 + MIN_EFFECT**2) - 29.7) < 0.005
    assert abs(-10 * log10(1e-3 + (2 * MIN_EFFECT) ** 2) - 28.9) < 0.05


@pytest.mark.parametrize(
    ("statistic", "noise", "called_for"),
    [
        (1.0, 0.2, True),
        (1.0, 0.21, None),
        (0.99, 0.0, None),
        (0.5, 0.0, None),
        (0.49, 0.0, False),
        (0.3, 0.1, None),
        (0.29, 0.1, False),
        (0.0, INFINITE, None),
    ],
)
def test_the_rule(statistic: float, noise: float, called_for: bool | None) -> None:
    assert decide(statistic, noise, 1.0) is called_for
    assert classify(statistic, noise, 1.0, "EV", "words").called_for is called_for


@given(st.floats(0, 1e6), st.floats(0, 1e6), st.floats(1e-6, 1e6))
def test_more_noise_never_decides_more(statistic: float, noise: float, threshold: float) -> None:
    quiet, noisy = decide(statistic, noise, threshold), decide(statistic, 2 * noise, threshold)
    assert noisy is None or noisy is quiet


def test_unknown_says_so() -> None:
    assert unknown("EV", 0.1, "no tracks", None) == (0.0, "EV", 0.1, INFINITE, None, "not measured: no tracks")
