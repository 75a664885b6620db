import math

import pytest
import torch

from nerf.fields.positional_encoding import positional_encoding
from tests.reference.paper_loop import encode


def random_points(count: int) -> torch.Tensor:
    return 1.8 * torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.9


def test_known_values() -> None:
    # x = 1/4: sin and cos of pi/4 and pi/2.
    half = math.sqrt(0.5)
    expected = torch.tensor([[half, 1.0, half, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(positional_encoding(torch.tensor([[0.25]], dtype=torch.float64), 2), expected)


def test_agrees_with_the_slow_loop_in_float64() -> None:
    points = random_points(50)
    expected = torch.stack([torch.from_numpy(encode(p.numpy(), 10)) for p in points])
    assert (positional_encoding(points, 10) - expected).abs().max() < 1e-14


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6])
def test_float32_is_exact_to_1e_6_at_every_frequency(scale: float) -> None:
    points = (scale * random_points(20000)).float()
    error = (positional_encoding(points, 10).double() - positional_encoding(points.double(), 10)).abs().max()
    assert 0 < error < 1e-6


def test_sines_and_cosines_lie_on_the_unit_circle() -> None:
    sines, cosines = positional_encoding(random_points(100), 6).chunk(2, -1)
    torch.testing.assert_close(sines**2 + cosines**2, torch.ones_like(sines))


def test_a_point_keeps_its_distance_to_its_neighbours_under_shift() -> None:
    """<gamma(x), gamma(y)> depends on x - y alone."""
    x, y = random_points(20), random_points(40)[20:]
    shifted = (positional_encoding(x + 0.123, 5) * positional_encoding(y + 0.123, 5)).sum(-1)
    torch.testing.assert_close(shifted, (positional_encoding(x, 5) * positional_encoding(y, 5)).sum(-1))


def test_the_period_is_two() -> None:
    points = random_points(20)
    torch.testing.assert_close(positional_encoding(points + 2, 10), positional_encoding(points, 10), atol=1e-12, rtol=0)


def test_gradients() -> None:
    # Away from x = 0, 2^k x = odd: there the reduction jumps, the encoding does not.
    assert torch.autograd.gradcheck(lambda x: positional_encoding(x, 4), random_points(10).requires_grad_())


@pytest.mark.parametrize("size", [0.0, 1e10, 1e30])
def test_value_and_gradient_are_finite_everywhere(size: float) -> None:
    x = torch.tensor([size, -size], requires_grad=True)
    encoded = positional_encoding(x, 10)
    encoded.sum().backward()
    assert x.grad is not None and torch.isfinite(x.grad).all()
    assert torch.isfinite(encoded).all() and encoded.abs().max() <= 1


def test_exact_points_give_exact_angles_in_a_coarser_type() -> None:
    points = random_points(1000)
    wanted = positional_encoding(points, 10)
    rounded_late = positional_encoding(points, 10, torch.float32)
    assert rounded_late.dtype == torch.float32
    assert 0 < (rounded_late - wanted).abs().max() < 3e-7
    assert (positional_encoding(points.float(), 10) - wanted).abs().max() > 1e-5
