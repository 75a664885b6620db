import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.training.psnr import PSNR_LIMIT, mean_squared_error, psnr


@given(st.floats(1e-9, 1e9), st.floats(1.01, 100))
def test_a_k_times_larger_error_costs_10_log10_k_decibel(error: float, factor: float) -> None:
    assert psnr(error) - psnr(error * factor) == pytest.approx(10 * math.log10(factor), abs=1e-9)


def test_closed_forms() -> None:
    assert psnr(1.0) == 0
    assert psnr(0.01) == pytest.approx(20)
    assert psnr(0.0) == PSNR_LIMIT
    assert psnr(1e-30) == PSNR_LIMIT


def test_the_limit_is_reached_without_a_jump() -> None:
    assert psnr(1.000001e-10) == pytest.approx(PSNR_LIMIT, abs=1e-4)


@pytest.mark.parametrize("error", [math.nan, math.inf, -1e-9])
def test_an_impossible_error_is_refused(error: float) -> None:
    with pytest.raises(ValueError, match="cannot be"):
        psnr(error)


def test_mean_squared_error_is_the_mean_over_pixels_and_channels() -> None:
    truth = torch.zeros(2, 5, 3)
    image = truth.clone()
    image[0, 0, 0] = 3.0
    assert mean_squared_error(image, truth) == pytest.approx(9 / 30)
