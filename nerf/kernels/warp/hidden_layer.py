"""The hidden layer of the colour network, whose input is part the sample's and part its ray's
(``nerf.kernels.torch.hidden_layer``)."""

from typing import Any

import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import Samples
from nerf.kernels.warp.launch import launch, vec16

wp.set_module_options({"enable_backward": False})

_HIDDEN = 64
# Of four numbers in a row. On a GPU each has a thread: neighbouring threads should touch neighbouring memory.
VECTORS = 16
# Samples whose gradients are summed by themselves before they join their ray's: of n numbers one after the other, in
# float32, up to n half ulps are lost, here 64 + 64 for a ray of 4096. Sums in float64 take twice the vectors.
_PARTIAL_SUM = wp.constant(64)


def add_ray_relu(samples: Samples, hidden: Float[Tensor, "samples 64"], ray_hidden: Float[Tensor, "rays 64"]) -> None:
    """As in nerf.kernels.torch.hidden_layer."""
    if hidden.is_cuda:
        launch(_add_ray_relu_gpu, VECTORS * len(hidden), samples.ray, ray_hidden, hidden)
    else:
        launch(_add_ray_relu, len(ray_hidden), samples.starts, ray_hidden, hidden)


def add_ray_relu_backward(
    samples: Samples, hidden: Float[Tensor, "samples 64"], grad: Float[Tensor, "samples 64"]
) -> Float[Tensor, "rays 64"]:
    """As in nerf.kernels.torch.hidden_layer."""
    ray_hidden = grad.new_empty(len(samples.starts) - 1, _HIDDEN)
    if hidden.is_cuda:
        launch(_add_ray_relu_backward_gpu, VECTORS * len(ray_hidden), samples.starts, hidden, grad, ray_hidden)
    else:
        launch(_add_ray_relu_backward, len(ray_hidden), samples.starts, hidden, grad, ray_hidden)
    return ray_hidden


def relu_backward(hidden: Float[Tensor, "samples 64"], grad: Float[Tensor, "samples 64"]) -> None:
    """As in nerf.kernels.torch.hidden_layer."""
    if hidden.is_cuda:
        launch(_relu_backward_gpu, VECTORS * len(hidden), hidden, grad)
    else:
        launch(_relu_backward, 4 * len(hidden), hidden, grad)


@wp.func
def _relu(x: Any):
    """max(x, 0), and NaN for NaN, which wp.max alone takes for missing. 0 x changes no finite number."""
    return wp.max(x, type(x)(0.0)) + 0.0 * x


@wp.func
def _relu_gradient(hidden: Any, grad: Any):
    """The gradient where the output is positive, else 0: twice multiplied, what is positive is 1 or more."""
    one = type(hidden)(1.0)
    return wp.cw_mul(grad, wp.min(wp.min(3.0e38 * hidden, one) * 3.0e38, one))


@wp.kernel
def _add_ray_relu(starts: wp.array[int], ray_hidden: wp.array[vec16], hidden: wp.array[vec16]):
    ray = wp.tid()
    a = ray_hidden[4 * ray]
    b = ray_hidden[4 * ray + 1]
    c = ray_hidden[4 * ray + 2]
    d = ray_hidden[4 * ray + 3]
    for i in range(starts[ray], starts[ray + 1]):
        hidden[4 * i] = _relu(hidden[4 * i] + a)
        hidden[4 * i + 1] = _relu(hidden[4 * i + 1] + b)
        hidden[4 * i + 2] = _relu(hidden[4 * i + 2] + c)
        hidden[4 * i + 3] = _relu(hidden[4 * i + 3] + d)


@wp.kernel
def _add_ray_relu_backward(
    starts: wp.array[int], hidden: wp.array[vec16], grad: wp.array[vec16], ray_hidden: wp.array[vec16]
):
    ray = wp.tid()
    end = starts[ray + 1]
    ray_hidden[4 * ray] = vec16(0.0)
    ray_hidden[4 * ray + 1] = vec16(0.0)
    ray_hidden[4 * ray + 2] = vec16(0.0)
    ray_hidden[4 * ray + 3] = vec16(0.0)
    for first in range(starts[ray], end, _PARTIAL_SUM):
        a = vec16(0.0)
        b = vec16(0.0)
        c = vec16(0.0)
        d = vec16(0.0)
        for i in range(first, wp.min(first + _PARTIAL_SUM, end)):
            grad[4 * i] = _relu_gradient(hidden[4 * i], grad[4 * i])
            grad[4 * i + 1] = _relu_gradient(hidden[4 * i + 1], grad[4 * i + 1])
            grad[4 * i + 2] = _relu_gradient(hidden[4 * i + 2], grad[4 * i + 2])
            grad[4 * i + 3] = _relu_gradient(hidden[4 * i + 3], grad[4 * i + 3])
            a += grad[4 * i]
            b += grad[4 * i + 1]
            c += grad[4 * i + 2]
            d += grad[4 * i + 3]
        ray_hidden[4 * ray] = ray_hidden[4 * ray] + a
        ray_hidden[4 * ray + 1] = ray_hidden[4 * ray + 1] + b
        ray_hidden[4 * ray + 2] = ray_hidden[4 * ray + 2] + c
        ray_hidden[4 * ray + 3] = ray_hidden[4 * ray + 3] + d


@wp.kernel
def _relu_backward(hidden: wp.array[vec16], grad: wp.array[vec16]):
    i = wp.tid()
    grad[i] = _relu_gradient(hidden[i], grad[i])


@wp.kernel
def _add_ray_relu_gpu(rays: wp.array[int], ray_hidden: wp.array[wp.vec4], hidden: wp.array[wp.vec4]):
    i = wp.tid()
    hidden[i] = _relu(hidden[i] + ray_hidden[16 * rays[i >> 4] + (i & 15)])


@wp.kernel
def _add_ray_relu_backward_gpu(
    starts: wp.array[int], hidden: wp.array[wp.vec4], grad: wp.array[wp.vec4], ray_hidden: wp.array[wp.vec4]
):
    i = wp.tid()
    ray = i >> 4
    vector = i & 15
    end = starts[ray + 1]
    total = wp.vec4(0.0)
    for first in range(starts[ray], end, _PARTIAL_SUM):
        partial = wp.vec4(0.0)
        for sample in range(first, wp.min(first + _PARTIAL_SUM, end)):
            entry = 16 * sample + vector
            passed = _relu_gradient(hidden[entry], grad[entry])
            grad[entry] = passed
            partial += passed
        total += partial
    ray_hidden[i] = total


@wp.kernel
def _relu_backward_gpu(hidden: wp.array[wp.vec4], grad: wp.array[wp.vec4]):
    i = wp.tid()
    grad[i] = _relu_gradient(hidden[i], grad[i])
