"""Volume rendering of packed samples (Mildenhall et al. 2020, eq. 3).

With the optical depth tau_i = sigma_i dt_i of sample i, T_i = exp(-sum_{j<i} tau_j) is the transmittance before it,
T_{i+1} the one behind it, and w_i = T_i (1 - exp(-tau_i)) its weight; U = exp(-sum tau_j) is the transmittance of
the whole ray.

Sums over a ray are differences of running sums over all packed samples, taken in float64, as long as these are numbers
up to OPAQUE. Otherwise, which takes longer, rays are summed apart: what is no number on one of them, or huge, changes
nothing on another. tau is limited to OPAQUE before it is summed: exp(-OPAQUE) is zero even in float64, so the limit
changes nothing.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.kernels import Samples
from nerf.kernels.torch.packing import no_padding, padded, padded_samples

OPAQUE = 800.0
MIN_KEEP_PROBABILITY = 1 / 16  # of a thin sample to be kept, so that no interval becomes more than 16 times as long


def visible_samples(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    threshold: float,
    thinning_threshold: float,
    thinning_offset: Float[Tensor, "rays"],
    capacity: int | None = None,
) -> tuple[Samples, Int32[Tensor, "kept"]]:
    """The samples that are worth a colour, and their numbers among all.

    These lie in the front part of their ray, before which the transmittance is still ``threshold`` or more; 0 keeps
    everything. ``sigma`` must be the density that will be composited: older ones (the occupancy grid's) would hide a
    surface from the very gradient that is to move it.

    Of those with tau below ``thinning_threshold`` each is kept with probability p = max(tau / thinning_threshold,
    MIN_KEEP_PROBABILITY), and its interval is made 1 / p times as long: it stands for others like it, so that sums of
    tau f over a ray keep their expectation, and so do gradients of densities. Probabilities are added up along the ray,
    beginning with ``thinning_offset``, a random number in [0, 1), and a sample is kept where the sum reaches a whole
    number (systematic sampling; Carpenter et al. 1999), so that long stretches of little density are sampled evenly.
    ``thinning_threshold`` 0 keeps all.
    """
    probability = _keep_probability(sigma * samples.dt, thinning_threshold)
    of_thin = torch.where(probability < 1, probability, 0).double()
    before = sums_before(samples, of_thin) + thinning_offset.double().index_select(0, samples.ray)
    chosen = ~(probability < 1) | ((before + of_thin).floor() > before.floor())
    chosen &= no_padding(samples)
    index = (chosen & (_transmittances(samples, sigma).before >= threshold)).nonzero()[:, 0]
    starts = torch.searchsorted(index, samples.starts.long(), out_int32=True)
    index = index.int()
    ray, t, dt = (each.index_select(0, index) for each in (samples.ray, samples.t, samples.dt / probability))
    kept = Samples(starts, ray, t, dt)
    return (kept, index) if capacity is None else (padded_samples(kept, capacity), padded(index, capacity))


def _keep_probability(tau: Float[Tensor, "samples"], thinning_threshold: float) -> Float[Tensor, "samples"]:
    """Of a sample to be kept; 1 for what is no number, that it may be noticed."""
    return torch.where(tau < thinning_threshold, (tau / thinning_threshold).clamp(min=MIN_KEEP_PROBABILITY), 1)


def composite(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    colour: Float[Tensor, "samples 3"],
    background: Float[Tensor, "rays 3"],
    far: Float[Tensor, "rays"],
) -> tuple[Rendering, Float[Tensor, "samples"]]:
    """What the rays see, and the weights of the samples.

    colour = sum w_i c_i + U background, depth = sum w_i t_i + U far, opacity = 1 - U.
    """
    along = _transmittances(samples, sigma)
    stopped = ray_sums(samples, along.weights[:, None] * torch.cat([colour, samples.t[:, None]], -1))
    rendering = Rendering(
        colour=stopped[:, :3] + along.transmittance[:, None] * background,
        depth=stopped[:, 3] + along.transmittance * far,
        opacity=along.opacity,
    )
    return rendering, along.weights


def composite_backward(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    colour: Float[Tensor, "samples 3"],
    background: Float[Tensor, "rays 3"],
    far: Float[Tensor, "rays"],
    grad: Rendering,
    grad_weights: Float[Tensor, "samples"],
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
    """Gradients of the densities and colours, from those of the rendering and of the weights.

    With g_i = dL/dw_i and G = dL/dU in total, dL/dcolour_i = w_i dL/dcolour and
    dL/dsigma_i = dt_i (T_{i+1} g_i - sum_{k>i} w_k g_k - U G).
    """
    along = _transmittances(samples, sigma)
    grad_seen, grad_depth = (part.index_select(0, samples.ray) for part in (grad.colour, grad.depth))
    g = grad_weights + (grad_seen * colour).sum(-1) + grad_depth * samples.t
    grad_transmittance = (grad.colour * background).sum(-1) + grad.depth * far - grad.opacity
    behind = sums_behind(samples, along.weights * g)
    transmittance = (along.transmittance * grad_transmittance).index_select(0, samples.ray)
    grad_sigma = samples.dt * (along.behind * g - behind - transmittance)
    return grad_sigma, along.weights[:, None] * grad_seen


class _Transmittances(NamedTuple):
    """Along a ray: T_i, T_{i+1} and w_i per sample, U and 1 - U per ray."""

    before: Float[Tensor, "samples"]
    behind: Float[Tensor, "samples"]
    weights: Float[Tensor, "samples"]
    transmittance: Float[Tensor, "rays"]
    opacity: Float[Tensor, "rays"]


def _transmittances(samples: Samples, sigma: Float[Tensor, "samples"]) -> _Transmittances:
    tau = (sigma * samples.dt).clamp(max=OPAQUE)
    depth_before, depth = sums_before(samples, tau), ray_sums(samples, tau)
    before = torch.exp(-depth_before)
    return _Transmittances(
        before, torch.exp(-depth_before - tau), before * -torch.expm1(-tau), torch.exp(-depth), -torch.expm1(-depth)
    )


def ray_sums(samples: Samples, values: Float[Tensor, "samples *channels"]) -> Float[Tensor, "rays *channels"]:
    """Over all samples of a ray."""
    zero = values.new_zeros(len(samples.starts) - 1, *values.shape[1:], dtype=torch.float64)
    return zero.index_add(0, samples.ray.long(), values.double()).to(values.dtype)


def sums_before(samples: Samples, values: Float[Tensor, "*channels samples"]) -> Float[Tensor, "*channels samples"]:
    """For each sample, the sum over those before it on its ray."""
    if not _may_share_a_sum(values):
        return _sums_ray_by_ray(samples, samples.ray, values)
    running = _running(values)
    first = samples.starts.index_select(0, samples.ray)
    return (running[..., :-1] - running.index_select(-1, first)).to(values.dtype)


def sums_behind(samples: Samples, values: Float[Tensor, "*channels samples"]) -> Float[Tensor, "*channels samples"]:
    """For each sample, the sum over those behind it on its ray."""
    if not _may_share_a_sum(values):
        return _sums_ray_by_ray(samples, samples.ray.flip(0), values.flip(-1)).flip(-1)
    running = _running(values)
    end = samples.starts[1:].index_select(0, samples.ray)
    return (running.index_select(-1, end) - running[..., 1:]).to(values.dtype)


def _running(values: Float[Tensor, "*channels samples"]) -> Float[Tensor, "*channels samples+1"]:
    return torch.nn.functional.pad(values, (1, 0)).double().cumsum(-1)


def _may_share_a_sum(values: Float[Tensor, "*channels samples"]) -> bool:
    """Whether all are numbers, and none so large that the others' digits are lost beside it."""
    return not values.numel() or float(values.detach().abs().max()) <= OPAQUE


def _sums_ray_by_ray(
    samples: Samples, ray: Int32[Tensor, "samples"], values: Float[Tensor, "*channels samples"]
) -> Float[Tensor, "*channels samples"]:
    """Over the last sample of the same ray, the last 2, 4, ..., until that is all (Hillis and Steele 1986)."""
    longest, reach = int(samples.starts.diff().max()), 1
    last = torch.where(ray[1:] == ray[:-1], values.double()[..., :-1], 0)
    sums = torch.nn.functional.pad(last, (1, 0))
    while reach < longest - 1:
        sums[..., reach:].add_(torch.where(ray[reach:] == ray[:-reach], sums[..., :-reach], 0))
        reach *= 2
    return sums.to(values.dtype)
