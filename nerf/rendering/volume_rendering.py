"""Volume rendering of samples along a ray (Mildenhall et al. 2020, eq. 3).

``t`` are interval end points, shape (..., N+1), the last of them far; sample i stands at t_i and speaks for the
interval [t_i, t_{i+1}], so that delta_i = t_{i+1} - t_i and delta_N = far - t_N. ``sigma``, ``colour`` and ``weights``
are per interval, shape (..., N).

Stability: transmittance is the exponential of a sum, never a product, and opacity is -expm1 of it. No bound on
sigma delta is needed: every exponential here has a non-positive argument and a derivative that is its own value, so
an optical depth of 1e30, or one that overflows to infinity, is exactly opaque and has an exactly zero gradient.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.fields.interface import Rendering


def volume_weights(
    sigma: Float[Tensor, "*rays n"], t: Float[Tensor, "*rays n+1"]
) -> tuple[Float[Tensor, "*rays n"], Float[Tensor, "*rays"]]:
    """The weights T_i (1 - exp(-sigma_i delta_i)) and the optical depth of the whole ray, sum(sigma_i delta_i)."""
    depths = sigma * (t[..., 1:] - t[..., :-1])
    passed = torch.cumsum(depths, -1)
    # Shifted, not passed - depths: that would cancel (1e30 - 1e30) where a dense interval follows a thin one.
    before = torch.nn.functional.pad(passed[..., :-1], (1, 0))
    return torch.exp(-before) * -torch.expm1(-depths), passed[..., -1]


def composite(
    sigma: Float[Tensor, "*rays n"],
    colour: Float[Tensor, "*rays n 3"],
    t: Float[Tensor, "*rays n+1"],
    background: Float[Tensor, "*#rays 3"],
) -> tuple[Rendering, Float[Tensor, "*rays n"]]:
    """What the rays see over ``background``, and the weights; what they transmit comes from far."""
    weights, optical_depth = volume_weights(sigma, t)
    transmittance = torch.exp(-optical_depth)
    rendering = Rendering(
        colour=(weights[..., None] * colour).sum(-2) + transmittance[..., None] * background,
        depth=(weights * t[..., :-1]).sum(-1) + transmittance * t[..., -1],
        opacity=-torch.expm1(-optical_depth),
    )
    return rendering, weights
