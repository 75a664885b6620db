"""What is not a number is never masked: it stays so, in every backend, until the loss or the gradient is refused."""

import math

import pytest
import torch

from nerf.fields.interface import Rendering
from nerf.kernels import Backend, Layers, RayStepping, Samples, grid_layout, warp
from nerf.kernels import torch as reference

BACKENDS = pytest.mark.parametrize("backend", [reference, warp], ids=["torch", "warp"])
SAMPLES = Samples(
    torch.tensor([0, 3, 5]).int(),
    torch.tensor([0, 0, 0, 1, 1]).int(),
    torch.tensor([0.1, 0.2, 0.3, 0.1, 0.2]),
    torch.full((5,), 0.1),
)
HIT = torch.tensor([False, True, False, False, False])


def with_nan(values: torch.Tensor) -> torch.Tensor:
    """``values`` with NaN in row 1, which is the second sample of the first ray."""
    return torch.where(HIT.view(-1, *(1 for _ in values.shape[1:])), math.nan, values)


@BACKENDS
def test_nan_density_is_no_solid(backend: Backend) -> None:
    """Warp's min takes NaN for missing: limited by it to OPAQUE, a broken density looked solid and the loss finite."""
    colour, background, far = torch.full((5, 3), 0.5), torch.zeros(2, 3), torch.ones(2)
    rendering, weights = backend.composite(SAMPLES, with_nan(torch.ones(5)), colour, background, far)
    assert rendering.colour[0].isnan().all() and rendering.depth[0].isnan() and rendering.opacity[0].isnan()
    assert weights[1].isnan()
    ones = Rendering(torch.ones(2, 3), torch.ones(2), torch.ones(2))
    arguments = SAMPLES, with_nan(torch.ones(5)), colour, background, far, ones, torch.ones(5)
    grad_sigma, grad_colour = backend.composite_backward(*arguments)
    assert grad_sigma[:2].isnan().all() and grad_colour[1].isnan().all()


@BACKENDS
def test_a_colour_that_is_not_a_number_reaches_the_picture(backend: Backend) -> None:
    colour = with_nan(torch.full((5, 3), 0.5))
    rendering, _ = backend.composite(SAMPLES, torch.ones(5), colour, torch.zeros(2, 3), torch.ones(2))
    assert rendering.colour[0].isnan().all()


@BACKENDS
def test_a_nan_hidden_unit_is_not_rectified(backend: Backend) -> None:
    layers, inputs = Layers(torch.full((4, 64), -1.0), torch.ones(3, 64)), with_nan(torch.ones(5, 4))
    outputs = backend.mlp_forward(layers, inputs, SAMPLES.ray, torch.zeros(2, 64))
    assert outputs[1].isnan().all() and not outputs[[0, 2, 3, 4]].any()


@BACKENDS
def test_a_nan_gradient_passes_through_the_networks(backend: Backend) -> None:
    layers, grad = Layers(torch.ones(4, 64), torch.ones(3, 64)), with_nan(torch.ones(5, 3))
    found = backend.mlp_backward(layers, torch.ones(5, 4), grad, SAMPLES, torch.zeros(2, 64))
    assert found.hidden.isnan().all() and found.out.isnan().all() and found.inputs[1].isnan().all()
    assert found.ray_hidden is not None and found.ray_hidden[0].isnan().all()
    assert found.inputs[[0, 2, 3, 4]].isfinite().all() and found.ray_hidden[1].isfinite().all()


@BACKENDS
def test_a_cell_of_no_known_thickness_is_looked_into(backend: Backend) -> None:
    """Skipped, a part of the field that is broken would look like empty space, and no loss would ever tell."""
    thickness = torch.zeros(128)
    thickness[3] = math.nan
    assert backend.occupancy_bits(thickness, 0.01).tolist() == [1 << 3, 0]


@BACKENDS
def test_a_cell_with_nan_has_no_value(backend: Backend) -> None:
    """Before and behind other values of its cell, and whatever the cell is told afterwards."""
    thickness, along_z = torch.full((64,), 0.5), torch.tensor([0, 1, 1, 2, 2, 3])
    values = torch.tensor([2.0, 2.0, math.nan, math.nan, 2.0, 3.0])
    points = torch.nn.functional.pad((along_z[:, None] + 0.5) / 4, (2, 0))
    backend.scatter_max(4, thickness, points, values)
    backend.scatter_max(4, thickness, points, torch.full((6,), 2.5))
    torch.testing.assert_close(thickness[:5], torch.tensor([2.5, math.nan, math.nan, 3.0, 0.5]), equal_nan=True)


@BACKENDS
@pytest.mark.parametrize("resolution", [3, 16])
def test_a_point_that_is_not_a_number_has_such_features(backend: Backend, resolution: int) -> None:
    """And is no index error: with an odd number of rows a side, it was one."""
    layout = grid_layout(1, resolution, resolution, 18, 4)
    table = torch.ones(layout.rows, 4)
    features = backend.encode(layout, table, torch.tensor([[math.nan, 0.5, 0.5], [0.5, 0.5, 0.5]]))
    assert features[0].isnan().all() and torch.equal(features[1], torch.ones(4))


@BACKENDS
def test_weights_and_gradients_that_are_not_numbers_stay(backend: Backend) -> None:
    stepping, weights = RayStepping(0.01, 0.02, True, 8, 9), with_nan(torch.full((5,), 0.1))
    assert backend.distortion(SAMPLES, weights, stepping)[0].isnan()
    assert backend.distortion_backward(SAMPLES, weights, stepping, torch.ones(2))[0].isnan()
    opacity, far, distance = torch.ones(2), torch.full((2,), 9.0), torch.ones(2)
    assert backend.depth_loss(SAMPLES, weights, opacity, far, distance, stepping)[0].isnan()
    of_weights, of_opacity = backend.depth_loss_backward(SAMPLES, far, distance, stepping, torch.full((2,), math.nan))
    assert of_weights[0].isnan() and of_opacity[0].isnan()


@BACKENDS
@pytest.mark.parametrize("others", [0.0, 1.0])
def test_a_gradient_that_is_not_a_number_moves_its_parameter(backend: Backend, others: float) -> None:
    """Of sixteen, taken together, and of those left over; where all others are zero, nothing else tells of it."""
    parameter, gradient, mean, square = torch.zeros(40), torch.full((40,), others), torch.zeros(40), torch.zeros(40)
    gradient[[5, 37]] = math.nan
    backend.adam(parameter, gradient, mean, square, 0.1, 1)
    assert parameter.isnan().nonzero().flatten().tolist() == [5, 37] and not gradient.any()
    assert mean.isnan().nonzero().flatten().tolist() == [5, 37]


def test_a_gradient_too_large_for_adam_has_no_finite_norm() -> None:
    """Its square overflows; the norm that trainers look at before an update is made of the same squares."""
    for size, finite in ((1e18, True), (1.9e19, False), (1e30, False)):
        norm = torch.nn.utils.get_total_norm([torch.zeros(100), torch.tensor([1.0, size])])
        assert bool(norm.isfinite()) == finite
