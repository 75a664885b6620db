import math

import pytest
import torch

from nerf.geometry.rotations import SERIES_BELOW, cross_matrix, rotation_from_vector

ANGLES = (
    0.0,
    1e-30,
    1e-8,
    1e-3,
    0.999 * SERIES_BELOW**0.5,
    1.001 * SERIES_BELOW**0.5,
    1.0,
    math.pi - 1e-6,
    math.pi,
    6.0,
)
AXIS = torch.tensor([2.0, -3.0, 6.0], dtype=torch.float64) / 7


@pytest.mark.parametrize("angle", ANGLES)
def test_it_is_the_matrix_exponential_with_its_derivative(angle: float) -> None:
    vector = (angle * AXIS).requires_grad_()
    expected = torch.linalg.matrix_exp(cross_matrix(vector.detach()))
    torch.testing.assert_close(rotation_from_vector(vector).detach(), expected, rtol=0, atol=1e-10)
    assert torch.autograd.gradcheck(rotation_from_vector, vector, atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_single_precision_stays_a_rotation(angle: float) -> None:
    vector = (angle * AXIS).float().requires_grad_()
    rotation = rotation_from_vector(vector)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(rotation[0, 1], vector)
    assert gradient.isfinite().all() and (angle == 0 or gradient.abs().max() > 0.01)


def test_at_zero_it_is_exactly_nothing() -> None:
    assert torch.equal(rotation_from_vector(torch.zeros(2, 3)), torch.eye(3).expand(2, 3, 3))


def test_the_cross_matrix_is_the_cross_product() -> None:
    a, b = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close((cross_matrix(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
