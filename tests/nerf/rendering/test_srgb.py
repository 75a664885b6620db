"""The transfer curve against the standard's own formula, its inverse, and extremes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from nerf.rendering.srgb_arrays import LINEAR_THRESHOLD, linear_light, srgb_values
from tests.nerf.effects.statistics.photographed_points import encoded

EXTREMES = [0.0, 1e-30, 1e-8, 0.04, LINEAR_THRESHOLD, 0.0405, 0.5, 1.0, 2.0, 1e4, 1e12, 1e20, 1e30]


def test_the_curve_is_that_of_the_standard():
    srgb = torch.tensor([0.0, 0.02, 0.2, 0.5, 0.735357, 1.0], dtype=torch.float64)
    light = torch.tensor([0.0, 0.02 / 12.92, 0.033105, 0.214041, 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(srgb_to_linear(srgb), light, atol=1e-6, rtol=0)
    torch.testing.assert_close(linear_to_srgb(light), srgb, atol=2e-6, rtol=0)


@given(st.floats(0, 1e9))
def test_the_two_curves_undo_each_other(colour: float):
    c = torch.tensor([colour], dtype=torch.float64)
    torch.testing.assert_close(linear_to_srgb(srgb_to_linear(c)), c, atol=1e-7, rtol=1e-12)
    torch.testing.assert_close(srgb_to_linear(linear_to_srgb(c)), c, atol=1e-8, rtol=1e-12)


@given(st.floats(0, 1e9))
def test_arrays_have_the_same_curves(colour: float):
    c = torch.tensor([colour], dtype=torch.float64)
    np.testing.assert_allclose(linear_light(c.numpy()), srgb_to_linear(c).numpy(), rtol=1e-12)
    np.testing.assert_allclose(srgb_values(c.numpy()), linear_to_srgb(c).numpy(), rtol=1e-12)


@given(st.floats(0, 1))
def test_light_and_values_are_inverse(light: float):
    np.testing.assert_allclose(linear_light(encoded(np.array([light]))), light, atol=1e-6)
    np.testing.assert_allclose(linear_light(srgb_values(np.array([light]))), light, atol=1e-12)
    np.testing.assert_allclose(srgb_values(np.array([light])), encoded(np.array([light])), atol=1e-6)


def test_arrays_are_not_clipped():
    np.testing.assert_allclose(srgb_values(np.array([-1.0, 2.0, np.nan])), [-12.92, 1.3533, np.nan], atol=1e-4)


@pytest.mark.parametrize("curve", [srgb_to_linear, linear_to_srgb])
def test_what_is_below_black_is_black(curve):
    dark = torch.tensor([-1.0, -1e30], requires_grad=True)
    curve(dark).sum().backward()
    assert (curve(dark) == 0).all() and dark.grad is not None and (dark.grad == 0).all()


@pytest.mark.parametrize("curve", [srgb_to_linear, linear_to_srgb])
def test_the_curves_stay_finite(curve):
    values = torch.tensor(EXTREMES, requires_grad=True)
    shown = curve(values)
    shown.sum().backward()
    assert torch.isfinite(shown).all() and values.grad is not None and torch.isfinite(values.grad).all()
    assert (shown.diff() >= 0).all() and (values.grad[:9] > 0).all()
