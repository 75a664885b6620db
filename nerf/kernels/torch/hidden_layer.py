"""A rectified hidden layer whose input is part the sample's own and part its ray's.

Of the viewing direction all samples of a ray see the same, so that part is multiplied once per ray and added here.
"""

from jaxtyping import Float
from torch import Tensor

from nerf.kernels import Samples


def add_ray_relu(
    samples: Samples, hidden: Float[Tensor, "samples width"], ray_hidden: Float[Tensor, "rays width"]
) -> None:
    """In place: every sample's row of ``hidden`` plus that of its ray, negative sums becoming zero."""
    hidden.add_(ray_hidden.index_select(0, samples.ray)).relu_()


def add_ray_relu_backward(
    samples: Samples, hidden: Float[Tensor, "samples width"], grad: Float[Tensor, "samples width"]
) -> Float[Tensor, "rays width"]:
    """The gradient of ``ray_hidden``; in place, ``grad`` becomes that of the sum. ``hidden`` is what came out."""
    relu_backward(hidden, grad)
    ray = samples.ray.long()  # by 32-bit numbers torch adds rows several times slower
    return grad.new_zeros(len(samples.starts) - 1, grad.shape[1]).index_add_(0, ray, grad)


def relu_backward(hidden: Float[Tensor, "samples width"], grad: Float[Tensor, "samples width"]) -> None:
    """In place: the gradient of what was rectified, from that of what came out."""
    grad.mul_(hidden.sign())  # several times faster than a mask
