import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.space_maps.contraction import contract, uncontract

POINTS = 3 * torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_the_unit_cube_stays_as_it_is() -> None:
    inside = 2 * torch.rand(100, 3) - 1
    assert torch.equal(contract(inside), inside)


def test_distance_becomes_two_minus_its_inverse() -> None:
    y = contract(torch.tensor([[4.0, -2.0, 0.0]]))
    torch.testing.assert_close(y, torch.tensor([[1.75, -0.875, 0.0]]))


def test_the_inverse_undoes_it() -> None:
    assert (POINTS.abs().amax(-1) > 1).sum() > 100
    torch.testing.assert_close(uncontract(contract(POINTS)), POINTS, rtol=1e-12, atol=1e-12)


def test_the_slope_is_continuous_across_the_unit_cube() -> None:
    def slope(x: float) -> torch.Tensor:
        point = torch.tensor([x, 0.3, -0.2], dtype=torch.float64)
        return torch.stack(torch.autograd.functional.jacobian(contract, point).unbind())  # pyright: ignore

    torch.testing.assert_close(slope(1 - 1e-9), slope(1 + 1e-9), rtol=0, atol=1e-7)


def test_gradients() -> None:
    points = POINTS[:20].clone().requires_grad_()
    assert torch.autograd.gradcheck(contract, points)
    assert torch.autograd.gradcheck(uncontract, contract(points).detach().requires_grad_())


@given(
    st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=3, max_size=3),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_value_and_gradient_are_finite_everywhere(point: list[float], dtype: torch.dtype) -> None:
    x = torch.tensor(point, dtype=dtype, requires_grad=True)
    y = contract(x)
    y.sum().backward()
    assert x.grad is not None
    assert torch.isfinite(y).all() and torch.isfinite(x.grad).all()
    assert y.abs().max() <= 2 and (0.45 * y).abs().max() <= 0.9 + 1e-7


@pytest.mark.parametrize("size", [0.0, 1.0, 1e30])
def test_ties_and_extremes(size: float) -> None:
    x = torch.full((3,), size, requires_grad=True)
    contract(x).sum().backward()
    assert x.grad is not None and torch.isfinite(x.grad).all()
    expected = {0.0: 0.0, 1.0: 1.0, 1e30: 2.0}[size]
    torch.testing.assert_close(contract(x), torch.full((3,), expected))
