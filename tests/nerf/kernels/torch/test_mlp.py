"""The networks beside autograd."""

import pytest
import torch

from nerf.kernels import Layers, Samples
from nerf.kernels.torch import mlp_backward, mlp_forward
from nerf.kernels.torch.mlp import BLOCK
from tests.nerf.kernels.agreement import COUNTS, normal, packed


def as_double(*shape: int, seed: int) -> torch.Tensor:
    return normal("cpu", seed, *shape).double().requires_grad_()


@pytest.mark.parametrize("block", [1 << 12, 50])
@pytest.mark.parametrize("samples", [packed("cpu", COUNTS), None])
def test_gradients_are_autograds(samples: Samples | None, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BLOCK, "cpu", block)
    layers, inputs = Layers(as_double(5, 8, seed=1), as_double(3, 8, seed=2)), as_double(sum(COUNTS), 5, seed=3)
    ray_hidden = as_double(len(COUNTS), 8, seed=4) if samples else None
    before = inputs @ layers.hidden
    if samples and ray_hidden is not None:
        before = before + ray_hidden[samples.ray.long()]
    outputs, grad = before.relu() @ layers.out.T, normal("cpu", 5, sum(COUNTS), 3).double()
    with torch.no_grad():
        torch.testing.assert_close(mlp_forward(layers, inputs, samples and samples.ray, ray_hidden), outputs)
        found = mlp_backward(layers, inputs, grad, samples, ray_hidden)
    given = [*layers, inputs, *([] if ray_hidden is None else [ray_hidden])]
    torch.testing.assert_close(
        tuple(each for each in found if each is not None), torch.autograd.grad(outputs, given, grad)
    )
