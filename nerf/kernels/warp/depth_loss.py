"""The loss at sparse points (``nerf.kernels.torch.depth_loss``): a ray is one thread's loop."""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.warp.distortion_loss import log_from, normalised_difference
from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})


def depth_loss(
    samples: Samples,
    weights: Float[Tensor, "samples"],
    opacity: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    distance: Float[Tensor, "rays"],
    stepping: RayStepping,
) -> Float[Tensor, "rays"]:
    """As in nerf.kernels.torch.depth_loss."""
    loss = torch.zeros_like(distance)
    packed = samples.starts, samples.t, weights
    launch(_depth_loss, len(distance), log_from(stepping), *packed, opacity, far, distance, loss)
    return loss


def depth_loss_backward(
    samples: Samples,
    far: Float[Tensor, "rays"],
    distance: Float[Tensor, "rays"],
    stepping: RayStepping,
    grad: Float[Tensor, "rays"],
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "rays"]]:
    """As in nerf.kernels.torch.depth_loss."""
    grad_weights, grad_opacity = torch.zeros_like(samples.t), torch.zeros_like(distance)
    places = samples.starts, samples.t, far, distance
    launch(_depth_loss_backward, len(distance), log_from(stepping), *places, grad, grad_weights, grad_opacity)
    return grad_weights, grad_opacity


@wp.kernel
def _depth_loss(
    log_from: float,
    starts: wp.array[int],
    distances: wp.array[float],
    weights: wp.array[float],
    opacity: wp.array[float],
    far: wp.array[float],
    distance: wp.array[float],
    loss: wp.array[float],
):
    ray = wp.tid()
    if distance[ray] == 0.0:
        return
    point = distance[ray]
    total = wp.float64((1.0 - opacity[ray]) * wp.abs(normalised_difference(log_from, point, far[ray])))
    for i in range(starts[ray], starts[ray + 1]):
        total += wp.float64(weights[i] * wp.abs(normalised_difference(log_from, point, distances[i])))
    loss[ray] = float(total)


@wp.kernel
def _depth_loss_backward(
    log_from: float,
    starts: wp.array[int],
    distances: wp.array[float],
    far: wp.array[float],
    distance: wp.array[float],
    grad: wp.array[float],
    grad_weights: wp.array[float],
    grad_opacity: wp.array[float],
):
    ray = wp.tid()
    if distance[ray] == 0.0:
        return
    point = distance[ray]
    grad_opacity[ray] = -grad[ray] * wp.abs(normalised_difference(log_from, point, far[ray]))
    for i in range(starts[ray], starts[ray + 1]):
        grad_weights[i] = grad[ray] * wp.abs(normalised_difference(log_from, point, distances[i]))
