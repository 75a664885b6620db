"""The distortion loss (``nerf.kernels.torch.distortion_loss``): a ray is one thread's loop. Sums run along one ray, in
float64 as the reference's do.
"""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})

_SERIES_BELOW = wp.constant(0.2)  # the first term that artanh's series leaves out is then below 1e-8 of it


def distortion(samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping) -> Float[Tensor, "rays"]:
    """As in nerf.kernels.torch.distortion_loss."""
    loss = weights.new_empty(len(samples.starts) - 1)
    launch(_distortion, len(loss), log_from(stepping), samples.starts, samples.t, samples.dt, weights, loss)
    return loss


def distortion_backward(
    samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping, grad: Float[Tensor, "rays"]
) -> Float[Tensor, "samples"]:
    """As in nerf.kernels.torch.distortion_loss."""
    grad_weights = torch.zeros_like(weights)
    packed = samples.starts, samples.t, samples.dt, weights
    launch(_distortion_backward, len(grad), log_from(stepping), *packed, grad, grad_weights)
    return grad_weights


def log_from(stepping: RayStepping) -> float:
    """The distance from which losses measure it by its logarithm, as steps grow from there; 0 where they never do."""
    return stepping.linear_until if stepping.cone_angle else 0.0


@wp.func
def normalised_difference(log_from: float, start: float, end: float):
    """m(end) - m(start), where m is the distance as the losses measure it: its logarithm beyond ``log_from``
    (0: nowhere), in multiples of it before (nerf.kernels.torch.marching.normalised_distance).

    No difference of two logarithms: each is off by 5e-7 far out, where neighbours differ by 1e-2. Nor the logarithm of
    end / start, whose rounding is 6e-8 of 1. With z = (end - start) / (end + start), whose difference is exact for
    neighbours, log(end / start) = 2 artanh z; its series is as exact as float64 would be once rounded, and cheaper than
    any logarithm.
    """
    if log_from == 0.0:
        return end - start
    even = (wp.min(end, log_from) - wp.min(start, log_from)) / log_from
    a = wp.max(start, log_from)
    b = wp.max(end, log_from)
    z = (b - a) / (b + a)
    if wp.abs(z) > _SERIES_BELOW:
        return even + wp.log(b / a)
    zz = z * z
    return even + 2.0 * z * (1.0 + zz * (1.0 / 3.0 + zz * (1.0 / 5.0 + zz * (1.0 / 7.0 + zz / 9.0))))


@wp.func
def _normalised_length(log_from: float, t: float, dt: float):
    if log_from == 0.0:
        return dt
    return dt / wp.max(log_from, t)


@wp.kernel
def _distortion(
    log_from: float,
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    weights: wp.array[float],
    loss: wp.array[float],
):
    ray = wp.tid()
    # Sums of w_j and w_j (m - m_j) over the samples before, m being the position of the last: no large numbers meet.
    before = wp.float64(0.0)
    moment = wp.float64(0.0)
    total = wp.float64(0.0)
    last = float(0.0)
    for i in range(starts[ray], starts[ray + 1]):
        t = distances[i]
        w = weights[i]
        own_term = w * _normalised_length(log_from, t, lengths[i]) / 3.0
        moment += before * wp.float64(normalised_difference(log_from, last, t))
        total += wp.float64(w * (2.0 * float(moment) + own_term))
        before += wp.float64(w)
        last = t
    loss[ray] = float(total)


@wp.kernel
def _distortion_backward(
    log_from: float,
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    weights: wp.array[float],
    grad: wp.array[float],
    grad_weights: wp.array[float],
):
    ray = wp.tid()
    start = starts[ray]
    end = starts[ray + 1]
    before = wp.float64(0.0)
    moment = wp.float64(0.0)
    last = float(0.0)
    for i in range(start, end):
        t = distances[i]
        own_term = weights[i] * _normalised_length(log_from, t, lengths[i]) / 3.0
        moment += before * wp.float64(normalised_difference(log_from, last, t))
        grad_weights[i] = grad[ray] * 2.0 * (float(moment) + own_term)
        before += wp.float64(weights[i])
        last = t
    behind = wp.float64(0.0)
    moment = wp.float64(0.0)
    for step in range(end - start):
        i = end - 1 - step
        t = distances[i]
        moment += behind * wp.float64(normalised_difference(log_from, t, last))
        grad_weights[i] = grad_weights[i] + grad[ray] * 2.0 * float(moment)
        behind += wp.float64(weights[i])
        last = t
