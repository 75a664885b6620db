"""Sparse depth supervision: how far from the sparse point at its pixel a ray terminates.

Where few photos look, many shapes explain their colours, and a field settles for one of them early. At some pixels more
is known than a colour: the photo shows a point there whose distance was triangulated. The idea of a loss on it is Deng
et al.'s (2022, "Depth-supervised NeRF"), who compare distributions of ray termination by their divergence, with an
uncertainty for every point. Here it is the mean distance between where the ray terminates and the point, the first
Wasserstein distance to all of its weight being there: always finite, and the gradient of an outlier is no larger than
that of a good point.
"""

from jaxtyping import Float
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.torch.marching import normalised_distance


def depth_loss(
    samples: Samples,
    weights: Float[Tensor, "samples"],
    opacity: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    distance: Float[Tensor, "rays"],
    stepping: RayStepping,
) -> Float[Tensor, "rays"]:
    """sum_i w_i |m(t_i) - m(d)| + U |m(far) - m(d)| of each ray, where U = 1 - opacity is the transmittance at far
    and d the ``distance`` of its point; 0 for rays whose d is 0, of which none is known.

    Positions m are measured as in the distortion loss (nerf/kernels/torch/marching.py: normalised_distance), so that
    where steps grow a tenth too far costs the same at any distance. In float64: logarithms of nearly the same
    distance cancel.
    """
    of_samples, of_rest = _distances_to_point(samples, far, distance, stepping)
    rest = (1 - opacity) * of_rest
    return rest.index_add(0, samples.ray, weights * of_samples).to(weights.dtype)


def depth_loss_backward(
    samples: Samples,
    far: Float[Tensor, "rays"],
    distance: Float[Tensor, "rays"],
    stepping: RayStepping,
    grad: Float[Tensor, "rays"],
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "rays"]]:
    """Gradients of the weights and of the opacities."""
    of_samples, of_rest = _distances_to_point(samples, far, distance, stepping)
    grad_weights = grad.index_select(0, samples.ray) * of_samples
    return grad_weights.to(grad.dtype), (-grad * of_rest).to(grad.dtype)


def _distances_to_point(
    samples: Samples, far: Float[Tensor, "rays"], distance: Float[Tensor, "rays"], stepping: RayStepping
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "rays"]]:
    """How far samples and the ends of rays are from their point, float64; 0 on rays without one."""
    known, point = distance > 0, normalised_distance(stepping, distance.double())
    of_samples = (normalised_distance(stepping, samples.t.double()) - point.index_select(0, samples.ray)).abs()
    of_rest = (normalised_distance(stepping, far.double()) - point).abs()
    return of_samples * known.index_select(0, samples.ray), of_rest * known
