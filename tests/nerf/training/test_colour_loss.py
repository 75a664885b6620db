import pytest
import torch

from nerf.training.colour_loss import HUBER_DELTA, huber_loss, shows_backdrop


def test_small_errors_are_squared_and_large_ones_pull_no_harder() -> None:
    loss, half_gradient = huber_loss(torch.tensor([0.05, -0.05, 0.3, -0.3]))
    torch.testing.assert_close(loss, torch.tensor([0.0025, 0.0025, 0.05, 0.05]))
    torch.testing.assert_close(half_gradient, torch.tensor([0.05, -0.05, HUBER_DELTA, -HUBER_DELTA]))


def test_huber_gradient_is_half_the_derivative() -> None:
    error = torch.linspace(-0.31, 0.3, 100, dtype=torch.float64, requires_grad=True)
    size = error.abs()
    torch.where(size < HUBER_DELTA, size**2, 2 * HUBER_DELTA * size - HUBER_DELTA**2).sum().backward()
    torch.testing.assert_close(2 * huber_loss(error.detach())[1], error.grad)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_stays_so(value: float) -> None:
    assert not huber_loss(torch.tensor([value]))[0].isfinite()


def test_every_channel_decides_whether_a_colour_is_the_backdrops() -> None:
    colours = torch.tensor([[1.0, 1, 1], [0.97, 1, 0.98], [1, 0.9, 1], [0, 0, 0], [float("nan"), 1, 1]])
    assert shows_backdrop(colours, torch.ones(5, 3), 8 / 255).tolist() == [True, True, False, False, False]
