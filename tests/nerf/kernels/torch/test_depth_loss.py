import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.torch.depth_loss import depth_loss, depth_loss_backward

EVEN, GROWING = (
    RayStepping(0.25, 0.0, False, 8, 100),
    RayStepping(0.25, 0.1, True, 8, 100),
)  # the second grows from 2.5 on
T = torch.tensor([1.0, 2.0, 4.0, 8.0], dtype=torch.float64)
FAR = torch.full((3,), 16.0, dtype=torch.float64)


def samples(rays: int = 3) -> Samples:
    """The same four on each ray."""
    starts = torch.arange(0, 4 * rays + 1, 4).int()
    ray = torch.arange(rays).repeat_interleave(4).int()
    return Samples(starts, ray, T.repeat(rays), torch.ones(4 * rays, dtype=torch.float64))


def loss_of(weights: Tensor, distance: list[float], stepping: RayStepping = EVEN) -> Tensor:
    opacity = weights.view(-1, 4).sum(-1)
    where = torch.tensor(distance, dtype=torch.float64)
    return depth_loss(samples(len(distance)), weights.flatten(), opacity, FAR[: len(distance)], where, stepping)


def test_light_that_is_stopped_at_the_point_costs_nothing() -> None:
    assert torch.equal(loss_of(torch.eye(4).double()[:3], [1.0, 2.0, 4.0]), torch.zeros(3).double())


def test_depth_loss_is_the_mean_distance_to_the_point() -> None:
    weights = torch.tensor([[0.5, 0.0, 0.25, 0.0], [0.0, 0.0, 0.0, 0.0]]).double()
    expected = torch.tensor([0.5 * 1 + 0.25 * 2 + 0.25 * 14, 16 - 2.0]).double()  # nothing stops the rest before far
    torch.testing.assert_close(loss_of(weights, [2.0, 2.0]), expected)


def test_relative_error_costs_the_same_at_any_distance() -> None:
    behind = torch.eye(4)[[2, 3]].double()  # all of the light is stopped at 4 and at 8
    near, far = loss_of(behind, [4 / 1.1, 8 / 1.1], GROWING)
    torch.testing.assert_close(near, far)
    torch.testing.assert_close(float(near), float(torch.tensor(1.1).log()), rtol=1e-6, atol=0)


@pytest.mark.parametrize("stepping", [EVEN, GROWING])
def test_the_gradient_by_hand_is_that_of_autograd(stepping: RayStepping) -> None:
    random = torch.Generator().manual_seed(0)
    weights = torch.rand(12, generator=random, dtype=torch.float64, requires_grad=True)
    opacity = torch.rand(3, generator=random, dtype=torch.float64, requires_grad=True)
    distance, each = torch.tensor([3.0, 0.0, 20.0]).double(), torch.tensor([0.3, 1.0, 2.0]).double()
    loss = (each * depth_loss(samples(), weights, opacity, FAR, distance, stepping)).sum()
    by_hand = depth_loss_backward(samples(), FAR, distance, stepping, each)
    torch.testing.assert_close(by_hand, torch.autograd.grad(loss, (weights, opacity)))


@given(st.lists(st.floats(0, 1, width=32), min_size=12, max_size=12))
def test_a_ray_without_a_point_costs_nothing_and_pulls_nowhere(weights: list[float]) -> None:
    drawn = torch.tensor(weights, dtype=torch.float64).view(3, 4)
    assert loss_of(drawn, [0.0, 2.0, 0.0])[[0, 2]].tolist() == [0, 0]
    of_weights, of_opacity = depth_loss_backward(samples(), FAR, torch.tensor([0.0, 2, 0]), EVEN, torch.ones(3))
    assert not of_weights.view(3, 4)[[0, 2]].any() and not of_opacity[[0, 2]].any()
    assert of_weights.view(3, 4)[1].tolist() == [1, 0, 2, 6] and of_opacity[1] == -14


def test_rays_without_samples_are_pulled_by_their_end() -> None:
    none = Samples(torch.zeros(2).int(), torch.zeros(0).int(), torch.zeros(0), torch.zeros(0))
    places = torch.tensor([16.0]), torch.tensor([2.0]), EVEN
    assert depth_loss(none, torch.zeros(0), torch.zeros(1), *places).tolist() == [14]
    of_weights, of_opacity = depth_loss_backward(none, *places, torch.ones(1))
    assert of_weights.shape == (0,) and of_opacity.tolist() == [-14]
