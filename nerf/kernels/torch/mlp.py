"""A network of one hidden layer, rectified and without biases, forward and backward.

Its outputs are Y = H Vᵀ with H = max(X W + h, 0). X are the samples' inputs, W the weights of the hidden layer and V
those of the outputs. h is what a sample's ray adds: of the viewing direction all samples of a ray see the same, so that
part is multiplied once per ray. Without rays it is nothing. Backward is the chain rule: dV = dYᵀ H, and where H is
positive dH = dY V; dW = Xᵀ dH and dX = dH Wᵀ; a ray's dh is the sum of its samples' dH.

H, larger than all the rest, is not kept: to compute it again takes less time than to fetch it from memory.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels import Layers, MlpGradients, Samples

# Samples whose hidden layer exists at a time: as many as stay in a core's cache (docs/experiments/step_time.md); on a
# GPU all.
BLOCK = {"cpu": 1 << 12, "cuda": 1 << 22}

HiddenLayer = Callable[
    [Layers, Float[Tensor, "samples inputs"], Int32[Tensor, "samples"] | None, Float[Tensor, "rays hidden"] | None],
    Float[Tensor, "samples hidden"],
]
"""Like :func:`hidden_layer`."""
HiddenLayerBackward = Callable[
    [
        Float[Tensor, "samples hidden"],
        Float[Tensor, "samples hidden"],
        Samples | None,
        slice,
        Float[Tensor, "rays hidden"] | None,
    ],
    None,
]
"""Like :func:`hidden_layer_backward`."""


def mlp_forward(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    ray: Int32[Tensor, "samples"] | None = None,
    ray_hidden: Float[Tensor, "rays hidden"] | None = None,
) -> Float[Tensor, "samples outputs"]:
    """The outputs; row ``ray`` of ``ray_hidden`` is added to a sample's hidden layer."""
    return forward_in_blocks(hidden_layer, layers, inputs, ray, ray_hidden, BLOCK[inputs.device.type])


def mlp_backward(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    grad: Float[Tensor, "samples outputs"],
    samples: Samples | None = None,
    ray_hidden: Float[Tensor, "rays hidden"] | None = None,
) -> MlpGradients:
    """Gradients of the layers and of what went into them, given that of the outputs. ``samples``, packed, tell whose
    rays' rows were added: both are given or neither."""
    block = BLOCK[inputs.device.type]
    return backward_in_blocks(hidden_layer, hidden_layer_backward, layers, inputs, grad, samples, ray_hidden, block)


def forward_in_blocks(
    hidden_of: HiddenLayer,
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    ray: Int32[Tensor, "samples"] | None,
    ray_hidden: Float[Tensor, "rays hidden"] | None,
    block: int,
) -> Float[Tensor, "samples outputs"]:
    """What :func:`mlp_forward` says, by any function of the hidden layer, so many samples at a time."""
    outputs = inputs.new_empty(len(inputs), len(layers.out))
    for rows in _blocks(inputs, block):
        hidden = hidden_of(layers, inputs[rows], None if ray is None else ray[rows], ray_hidden)
        torch.mm(hidden, layers.out.T, out=outputs[rows])
    return outputs


def backward_in_blocks(
    hidden_of: HiddenLayer,
    hidden_backward: HiddenLayerBackward,
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    grad: Float[Tensor, "samples outputs"],
    samples: Samples | None,
    ray_hidden: Float[Tensor, "rays hidden"] | None,
    block: int,
) -> MlpGradients:
    """What :func:`mlp_backward` says, by any functions of the hidden layer, so many samples at a time."""
    assert (samples is None) == (ray_hidden is None), "rays are given or not"
    of_hidden, of_out = torch.zeros_like(layers.hidden), torch.zeros_like(layers.out)
    of_inputs, of_rays = torch.empty_like(inputs), None if ray_hidden is None else torch.zeros_like(ray_hidden)
    for rows in _blocks(inputs, block):
        hidden = hidden_of(layers, inputs[rows], None if samples is None else samples.ray[rows], ray_hidden)
        grad_hidden = grad[rows] @ layers.out
        hidden_backward(hidden, grad_hidden, samples, rows, of_rays)
        of_hidden += inputs[rows].T @ grad_hidden
        of_out += grad[rows].T @ hidden
        torch.mm(grad_hidden, layers.hidden.T, out=of_inputs[rows])
    return MlpGradients(of_hidden, of_out, of_inputs, of_rays)


def hidden_layer(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    ray: Int32[Tensor, "samples"] | None,
    ray_hidden: Float[Tensor, "rays hidden"] | None,
) -> Float[Tensor, "samples hidden"]:
    """H."""
    hidden = inputs @ layers.hidden
    if ray is not None and ray_hidden is not None:
        hidden += ray_hidden.index_select(0, ray)
    return hidden.relu_()


def hidden_layer_backward(
    hidden: Float[Tensor, "samples hidden"],
    grad: Float[Tensor, "samples hidden"],
    samples: Samples | None,
    rows: slice,
    grad_of_rays: Float[Tensor, "rays hidden"] | None,
) -> None:
    """In place: from the gradient of H that of what was rectified, which is added to the gradients of the rays of these
    ``rows`` among the samples."""
    grad.mul_(hidden.sign())  # several times faster than a mask
    if samples is not None and grad_of_rays is not None:
        # By 32-bit numbers torch adds rows several times slower.
        grad_of_rays.index_add_(0, samples.ray[rows].long(), grad)


def _blocks(samples: Float[Tensor, "samples _"], size: int) -> Iterator[slice]:
    """All samples, so many at a time."""
    return (slice(first, min(first + size, len(samples))) for first in range(0, len(samples), size))
