"""SSIM against scikit-image, the laws of the error map and of the interval."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from stages.evaluate.image_metrics import ERROR_SCALE, error_map, mean_interval, ssim


def _picture(seed: int, height: int = 40, width: int = 52) -> torch.Tensor:
    """Smooth structure with noise on top, in [0, 1]."""
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 4, width), indexing="ij")
    waves = torch.stack([torch.sin(2 * x), torch.cos(3 * y), torch.sin(x * y)], -1) * 0.3 + 0.5
    noise = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    return (waves + 0.3 * (noise - 0.5)).clamp(0, 1)


@pytest.mark.parametrize("size", [(40, 52), (11, 11), (11, 64), (97, 33)])
def test_ssim_equals_scikit_image(size: tuple[int, int]):
    a, b = _picture(1, *size), _picture(2, *size)
    expected: Any = structural_similarity(
        a.double().numpy(), b.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert ssim(a, b) == pytest.approx(expected, abs=1e-4)
    assert 0.1 < expected < 0.9


def test_ssim_is_one_for_equal_pictures_and_symmetric():
    a, b = _picture(1), _picture(2)
    assert ssim(a, a) == pytest.approx(1, abs=1e-6)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-6)
    assert ssim(torch.zeros(12, 12, 3), torch.zeros(12, 12, 3)) == pytest.approx(1, abs=1e-6)


def test_pictures_smaller_than_the_window_have_no_ssim():
    assert ssim(torch.zeros(10, 50, 3), torch.zeros(10, 50, 3)) is None


def test_error_map_grows_with_the_error_and_saturates():
    error = torch.tensor([0.0, 0.1, 0.2, ERROR_SCALE, 0.9])
    shades = error_map(error[None, :, None].expand(1, 5, 3), torch.zeros(1, 5, 3))
    assert shades.shape == (1, 5, 3) and shades.dtype == np.uint8
    luminance = shades[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance)[:3] > 20).all()
    assert (shades[0, 3] == shades[0, 4]).all()
    assert luminance[0] < 3 and luminance[-1] > 240


def test_the_sign_of_the_error_does_not_matter():
    a, b = _picture(1), _picture(2)
    assert (error_map(a, b) == error_map(b, a)).all()


@given(st.lists(st.floats(5, 40), min_size=3, max_size=12), st.floats(-20, 20))
@settings(max_examples=25, deadline=None)
def test_interval_holds_the_mean_and_moves_with_the_values(values: list[float], shift: float):
    low, high = _interval(values)
    assert low <= high and (low + high) / 2 == pytest.approx(np.mean(values))
    assert _interval([v + shift for v in values]) == pytest.approx((low + shift, high + shift), abs=1e-9)


@pytest.mark.parametrize("count", [3, 5, 12])
def test_intervals_hold_the_truth_95_times_in_100(count: int):
    samples = np.random.default_rng(0).normal(20, 3, size=(4000, count)).tolist()
    held = np.mean([low <= 20 <= high for low, high in map(_interval, samples)])
    assert 0.94 < held < 0.96


def test_the_interval_of_three_is_that_of_tables():
    assert _interval([21.0, 20.0, 19.0]) == pytest.approx(
        (20 - 4.3027 / math.sqrt(3), 20 + 4.3027 / math.sqrt(3)), abs=1e-4
    )
    values = np.random.default_rng(0).normal(20, 3, size=200).tolist()
    low, high = _interval(values)
    assert (high - low) / 2 == pytest.approx(1.96 * 3 / math.sqrt(200), rel=0.15)


@pytest.mark.parametrize("values", [[], [20.0], [20.0, 21.0]])
def test_fewer_than_three_photos_give_no_interval(values: list[float]):
    assert mean_interval(values) is None


def _interval(values: list[float]) -> tuple[float, float]:
    interval = mean_interval(values)
    assert interval is not None
    return interval


def test_what_is_not_used_counts_nowhere():
    """A field of windows that lie inside the left half scores as the left half alone, whatever the right half holds."""
    a, b = _picture(1), _picture(2)
    used = torch.zeros(a.shape[:2], dtype=torch.bool)
    used[:, :26] = True
    assert ssim(a, b, used) == pytest.approx(ssim(a[:, :26], b[:, :26]), abs=1e-6)
    spoiled = torch.where(used[..., None], b, 1 - b)
    assert ssim(a, spoiled, used) == ssim(a, b, used) != ssim(a, b)
    assert np.array_equal(error_map(a, spoiled, used)[:, :26], error_map(a, b)[:, :26])
    assert (error_map(a, spoiled, used)[:, 26:] == error_map(a, a)[:, 26:]).all()
    used[::10, ::10] = False
    assert ssim(a, b, used) is None
