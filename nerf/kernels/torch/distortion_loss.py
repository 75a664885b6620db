"""The distortion loss: how far the weights of a ray are spread (Barron et al. 2022, eq. 15)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.torch.compositing import ray_sums, sums_before, sums_behind
from nerf.kernels.torch.marching import normalised_distance


def distortion(samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping) -> Float[Tensor, "rays"]:
    """How far the weights of a ray are spread: sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i² l_i (Barron et al. 2022,
    eq. 15), in one pass since the samples are in order: the first sum is 2 sum_i w_i sum_{j<i} w_j (m_i - m_j).

    Positions m and lengths l are measured as step sizes grow, dm = dt / max(t_1, t), where steps grow from t_1 on
    (beyond it m is log t + const), and as distances if they do not.

    All in float64: m sum w_j - sum w_j m_j cancels for weights that stand close together far out.
    """
    m, lengths = _measure(samples, stepping)
    w = weights.double()
    before, moment_before = sums_before(samples, torch.stack([w, w * m]))
    return ray_sums(samples, 2 * w * (m * before - moment_before) + w.square() * lengths / 3).to(weights.dtype)


def distortion_backward(
    samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping, grad: Float[Tensor, "rays"]
) -> Float[Tensor, "samples"]:
    """Gradient of the weights: 2 sum_j w_j |m_i - m_j| + 2/3 w_i l_i."""
    m, lengths = _measure(samples, stepping)
    w = weights.double()
    both = torch.stack([w, w * m])
    before, moment_before = sums_before(samples, both)
    behind, moment_behind = sums_behind(samples, both)
    apart = m * (before - behind) - moment_before + moment_behind
    return grad.index_select(0, samples.ray) * (2 * apart + 2 / 3 * w * lengths).to(weights.dtype)


def _measure(samples: Samples, stepping: RayStepping) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples"]]:
    """Positions and lengths in the measure of the stepping, float64."""
    t, dt = samples.t.double(), samples.dt.double()
    lengths = dt / (stepping.linear_until * (t / stepping.linear_until).clamp(min=1)) if stepping.cone_angle else dt
    return normalised_distance(stepping, t), lengths
