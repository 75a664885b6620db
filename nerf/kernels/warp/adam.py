"""Adam for gradients that are zero almost everywhere (``nerf.kernels.torch.adam``)."""

import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels.torch.adam import LEAST_ROOT, MEAN_DECAY, SQUARE_DECAY
from nerf.kernels.warp.launch import launch, vec16

wp.set_module_options({"enable_backward": False})

_MEAN_SHARE = wp.constant(1 - MEAN_DECAY)
_SQUARE_SHARE = wp.constant(1 - SQUARE_DECAY)
_LEAST_SQUARE = wp.constant(LEAST_ROOT**2)
_LANES = 16


def adam(
    parameter: Float[Tensor, "*shape"],
    gradient: Float[Tensor, "*shape"],
    mean: Float[Tensor, "*shape"],
    square: Float[Tensor, "*shape"],
    rate: float,
    count: int,
) -> None:
    """As in nerf.kernels.torch.adam."""
    mean_share, square_share = 1 - MEAN_DECAY**count, 1 - SQUARE_DECAY**count
    scales, tensors = (rate / mean_share, 1 / square_share), (parameter, gradient, mean, square)
    whole, rest = divmod(parameter.numel(), _LANES)
    if rest:
        flat = [tensor.view(-1) for tensor in tensors]
        launch(_adam, rest, *scales, *(tensor[-rest:] for tensor in flat))
        tensors = tuple(tensor[:-rest] for tensor in flat)
    launch(_adam16, whole, *scales, *tensors)


@wp.func
def _live(gradient: vec16):
    """1 where the gradient is not exactly zero, also where it is no number, which wp.min takes for missing; else 0.

    Twice, as once does not take the smallest numbers up to 1.
    """
    one = vec16(1.0)
    return wp.min(wp.min(wp.abs(gradient) * 3.0e38, one) * 3.0e38, one)


@wp.func
def _roots(x: vec16):
    return vec16(
        wp.sqrt(x[0]),
        wp.sqrt(x[1]),
        wp.sqrt(x[2]),
        wp.sqrt(x[3]),
        wp.sqrt(x[4]),
        wp.sqrt(x[5]),
        wp.sqrt(x[6]),
        wp.sqrt(x[7]),
        wp.sqrt(x[8]),
        wp.sqrt(x[9]),
        wp.sqrt(x[10]),
        wp.sqrt(x[11]),
        wp.sqrt(x[12]),
        wp.sqrt(x[13]),
        wp.sqrt(x[14]),
        wp.sqrt(x[15]),
    )


@wp.kernel
def _adam16(
    rate: float,
    correction: float,
    parameter: wp.array[vec16],
    gradient: wp.array[vec16],
    mean: wp.array[vec16],
    square: wp.array[vec16],
):
    i = wp.tid()
    g = gradient[i]
    live = _live(g)
    if wp.max(live) == 0.0:  # of the gradients themselves it would pass over what is not a number
        return
    m = mean[i] + _MEAN_SHARE * wp.cw_mul(live, g - mean[i])
    v = square[i] + _SQUARE_SHARE * wp.cw_mul(live, wp.cw_mul(g, g) - square[i])
    root = _roots(wp.max(correction * v, vec16(_LEAST_SQUARE)))
    parameter[i] = parameter[i] - wp.cw_div(wp.cw_mul(live, rate * m), root)
    mean[i] = m
    square[i] = v
    gradient[i] = vec16(0.0)


@wp.kernel
def _adam(
    rate: float,
    correction: float,
    parameter: wp.array[float],
    gradient: wp.array[float],
    mean: wp.array[float],
    square: wp.array[float],
):
    i = wp.tid()
    g = gradient[i]
    if g == 0.0:
        return
    m = mean[i] + _MEAN_SHARE * (g - mean[i])
    v = square[i] + _SQUARE_SHARE * (g * g - square[i])
    parameter[i] = parameter[i] - rate * m / wp.sqrt(wp.max(correction * v, _LEAST_SQUARE))
    mean[i] = m
    square[i] = v
    gradient[i] = 0.0
