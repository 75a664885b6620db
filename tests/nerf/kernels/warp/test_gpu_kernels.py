"""Kernels in the form that a GPU runs, a few numbers a thread, agree with those of the CPU on a CPU as well."""

from typing import Any

import pytest
import torch

from nerf.kernels import Layers, MlpGradients, Samples, grid_layout, warp
from nerf.kernels.torch.adam import BETA1, BETA2
from nerf.kernels.torch.mlp import backward_in_blocks, forward_in_blocks
from nerf.kernels.warp import encoding, gather, mlp
from nerf.kernels.warp.adam import _adam4
from nerf.kernels.warp.launch import launch
from tests.nerf.kernels.agreement import normal, packed, uniform

LAYOUT = grid_layout(3, 4, 32, 8, 4)
COUNTS = [3, 0, 70, 1]


def run(kernel: Any, count: int, *arguments: Any) -> None:
    launch(kernel, count, *arguments)


def test_encoding() -> None:
    points, table = uniform("cpu", 1, 99, 3), normal("cpu", 2, LAYOUT.rows, 4)
    found, levels = torch.empty(99, LAYOUT.width), encoding._levels(LAYOUT, points.device)
    run(encoding._encode_gpu, 3 * 99, levels, 3, table, points, found)
    torch.testing.assert_close(found, warp.encode(LAYOUT, table, points))


def test_gradients_of_the_table() -> None:
    points, grad = uniform("cpu", 1, 99, 3), normal("cpu", 2, 99, LAYOUT.width)
    wanted, found = torch.zeros(LAYOUT.rows, 4), torch.zeros(LAYOUT.rows, 4)
    warp.encode_backward_table(LAYOUT, range(1, 3), points, grad, wanted)
    levels = encoding._levels(LAYOUT, points.device)
    run(encoding._encode_backward_table_gpu, 2 * 99, levels, 3, 1, 99, points, grad, found)
    torch.testing.assert_close(found, wanted)
    assert wanted.any() and not wanted[: LAYOUT.level_offsets[1]].any()


@pytest.mark.parametrize("block", [1 << 22, 16])
def test_networks(block: int) -> None:
    samples, of_ray = packed("cpu", COUNTS), normal("cpu", 3, len(COUNTS), 64)
    layers = Layers(normal("cpu", 4, 20, 64), normal("cpu", 5, 3, 64))
    inputs, grad = normal("cpu", 6, len(samples.t), 20), normal("cpu", 7, len(samples.t), 3)
    forward, backward = mlp._hidden_layer_gpu, mlp._hidden_layer_backward_gpu
    for rays, given in ((samples, of_ray), (None, None)):
        found = forward_in_blocks(forward, layers, inputs, rays and rays.ray, given, block)
        torch.testing.assert_close(found, warp.mlp_forward(layers, inputs, rays and rays.ray, given))
        gradients = backward_in_blocks(forward, backward, layers, inputs, grad, rays, given, block)
        wanted = warp.mlp_backward(layers, inputs, grad, rays, given)
        torch.testing.assert_close(gradients, wanted, rtol=1e-4, atol=1e-4)
    inputs[5, 7] = torch.nan
    assert forward(layers, inputs, samples.ray, of_ray)[5].isnan().all()


@pytest.mark.parametrize("on_gpu", [False, True])
def test_padding_behind_the_samples_changes_no_gradient(on_gpu: bool) -> None:
    """As a CUDA graph has it: zeros that belong to no ray and have no gradient."""
    samples, of_ray = packed("cpu", COUNTS), normal("cpu", 3, len(COUNTS), 64)
    layers, count = Layers(normal("cpu", 4, 20, 64), normal("cpu", 5, 3, 64)), len(samples.t)
    padded = Samples(samples.starts, *(torch.nn.functional.pad(each, (0, 50)) for each in samples[1:]))
    inputs, grad = (torch.nn.functional.pad(normal("cpu", 6, count, size), (0, 0, 0, 50)) for size in (20, 3))

    def gradients(samples: Samples, count: int) -> MlpGradients:
        given = layers, inputs[:count], grad[:count], samples, of_ray
        if on_gpu:
            return backward_in_blocks(mlp._hidden_layer_gpu, mlp._hidden_layer_backward_gpu, *given, 1 << 22)
        return warp.mlp_backward(*given)

    found, wanted = gradients(padded, count + 50), gradients(samples, count)
    assert torch.equal(found.inputs[:count], wanted.inputs) and not found.inputs[count:].any()
    torch.testing.assert_close(found[:2], wanted[:2])
    torch.testing.assert_close(found.ray_hidden, wanted.ray_hidden)


def test_adam() -> None:
    gradient = normal("cpu", 6, 40, 4) * (uniform("cpu", 7, 40, 4) > 0.5)
    gradient[3], gradient[4, 1] = 0.0, torch.nan
    state = [normal("cpu", 8, 40, 4), gradient, normal("cpu", 9, 40, 4), uniform("cpu", 10, 40, 4)]
    found = [tensor.clone() for tensor in state]
    warp.adam(*state, learning_rate=0.1, step=1)
    run(_adam4, 40, 0.1 / (1 - BETA1), 1 / (1 - BETA2), *found)
    torch.testing.assert_close(found, state, equal_nan=True)


def test_gathering_rows() -> None:
    values, rows = normal("cpu", 11, 20, 12), torch.tensor([3, 19, 0, 3], dtype=torch.int32)
    gathered = torch.empty(4, 12)
    run(gather._gather_rows, 4 * 3, 3, values, rows, gathered)
    assert torch.equal(gathered, values[rows.long()])
