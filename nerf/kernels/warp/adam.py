"""Adam for gradients that are zero almost everywhere (``nerf.kernels.torch.adam``)."""

import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels.torch.adam import BETA1, BETA2, EPSILON
from nerf.kernels.warp.launch import launch, vec16

wp.set_module_options({"enable_backward": False})

_ONE_MINUS_BETA1 = wp.constant(1 - BETA1)
_ONE_MINUS_BETA2 = wp.constant(1 - BETA2)
_EPSILON_SQUARED = wp.constant(EPSILON**2)


def adam(
    parameter: Float[Tensor, "*shape"],
    gradient: Float[Tensor, "*shape"],
    exp_avg: Float[Tensor, "*shape"],
    exp_avg_sq: Float[Tensor, "*shape"],
    learning_rate: float,
    step: int,
) -> None:
    """As in nerf.kernels.torch.adam."""
    bias_correction1, bias_correction2 = 1 - BETA1**step, 1 - BETA2**step
    factors, tensors = (
        (learning_rate / bias_correction1, 1 / bias_correction2),
        (parameter, gradient, exp_avg, exp_avg_sq),
    )
    width, kernel = (4, _adam4) if parameter.is_cuda else (16, _adam16)
    vectors, rest = divmod(parameter.numel(), width)
    if rest:
        flat = [tensor.view(-1) for tensor in tensors]
        launch(_adam, rest, *factors, *(tensor[-rest:] for tensor in flat))
        tensors = tuple(tensor[:-rest] for tensor in flat)
    launch(kernel, vectors, *factors, *tensors)


# In C++, as Warp takes the root of each number of a vector by itself, and thrice as long for rows of zeros.
@wp.func_native(
    f"""
#ifndef __CUDA_ARCH__
    constexpr float ONE_MINUS_BETA1 = {1 - BETA1}f, ONE_MINUS_BETA2 = {1 - BETA2}f, EPSILON_SQUARED = {EPSILON**2}f;
"""
    """
    typedef float row __attribute__((vector_size(64), aligned(4), may_alias));
    assert(i >= 0 && i < gradient.shape[0] && i < parameter.shape[0]);
    assert(i < exp_avg.shape[0] && i < exp_avg_sq.shape[0]);
    const row g = *(const row*)(gradient.data + i);
    const auto live = g != 0.0f;  // NaN, too
    if (!__builtin_reduce_or(live))
        return;
    row p = *(const row*)(parameter.data + i);
    row m = *(const row*)(exp_avg.data + i);
    row v = *(const row*)(exp_avg_sq.data + i);
    m = live ? m + ONE_MINUS_BETA1 * (g - m) : m;
    v = live ? v + ONE_MINUS_BETA2 * (g * g - v) : v;
    const row slope = __builtin_elementwise_sqrt(__builtin_elementwise_max(correction * v, row{} + EPSILON_SQUARED));
    *(row*)(parameter.data + i) = live ? p - learning_rate * m / slope : p;
    *(row*)(exp_avg.data + i) = m;
    *(row*)(exp_avg_sq.data + i) = v;
    *(row*)(gradient.data + i) = row{};
#endif
"""
)
def _update_row(
    i: int,
    learning_rate: float,
    correction: float,
    parameter: wp.array[vec16],
    gradient: wp.array[vec16],
    exp_avg: wp.array[vec16],
    exp_avg_sq: wp.array[vec16],
):
    """Sixteen entries, a cache line of each array."""


@wp.kernel
def _adam16(
    learning_rate: float,
    correction: float,
    parameter: wp.array[vec16],
    gradient: wp.array[vec16],
    exp_avg: wp.array[vec16],
    exp_avg_sq: wp.array[vec16],
):
    _update_row(wp.tid(), learning_rate, correction, parameter, gradient, exp_avg, exp_avg_sq)


@wp.func
def _nonzero(gradient: wp.vec4):
    """1 where the gradient is not exactly zero, NaN included, which wp.min takes for missing; else 0.

    Twice, as once does not take the smallest numbers up to 1.
    """
    one = wp.vec4(1.0)
    return wp.min(wp.min(wp.abs(gradient) * 3.0e38, one) * 3.0e38, one)


@wp.func
def _sqrt(x: wp.vec4):
    return wp.vec4(wp.sqrt(x[0]), wp.sqrt(x[1]), wp.sqrt(x[2]), wp.sqrt(x[3]))


@wp.kernel
def _adam4(
    learning_rate: float,
    correction: float,
    parameter: wp.array[wp.vec4],
    gradient: wp.array[wp.vec4],
    exp_avg: wp.array[wp.vec4],
    exp_avg_sq: wp.array[wp.vec4],
):
    """For a GPU, whose neighbouring threads should touch neighbouring memory."""
    i = wp.tid()
    g = gradient[i]
    nonzero = _nonzero(g)
    if wp.max(nonzero) == 0.0:  # of the gradients themselves it would pass over NaN
        return
    m = exp_avg[i] + _ONE_MINUS_BETA1 * wp.cw_mul(nonzero, g - exp_avg[i])
    v = exp_avg_sq[i] + _ONE_MINUS_BETA2 * wp.cw_mul(nonzero, wp.cw_mul(g, g) - exp_avg_sq[i])
    denominator = _sqrt(wp.max(correction * v, wp.vec4(_EPSILON_SQUARED)))
    parameter[i] = parameter[i] - wp.cw_div(wp.cw_mul(nonzero, learning_rate * m), denominator)
    exp_avg[i] = m
    exp_avg_sq[i] = v
    gradient[i] = wp.vec4(0.0)


@wp.kernel
def _adam(
    learning_rate: float,
    correction: float,
    parameter: wp.array[float],
    gradient: wp.array[float],
    exp_avg: wp.array[float],
    exp_avg_sq: wp.array[float],
):
    i = wp.tid()
    g = gradient[i]
    if g == 0.0:
        return
    m = exp_avg[i] + _ONE_MINUS_BETA1 * (g - exp_avg[i])
    v = exp_avg_sq[i] + _ONE_MINUS_BETA2 * (g * g - exp_avg_sq[i])
    parameter[i] = parameter[i] - learning_rate * m / wp.sqrt(wp.max(correction * v, _EPSILON_SQUARED))
    exp_avg[i] = m
    exp_avg_sq[i] = v
    gradient[i] = 0.0
