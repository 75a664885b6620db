"""Where along a ray the field is asked (Mildenhall et al. 2020, eq. 2 and section 5.2).

The choice made here: sample positions t_1 < ... < t_N are themselves the interval end points, closed by far, so ``t``
has shape (..., N+1). Sample i stands at t_i and speaks for [t_i, t_{i+1}]: delta_i = t_{i+1} - t_i as published and
delta_N = far - t_N, where the published code has 1e10. What lies before t_1 is not integrated, as published.
``edges`` (..., N+1) and ``weights`` (..., N) of a piecewise-constant PDF differ by one in the same way.

Randomness comes from the generator given; without one every draw is replaced by the middle of its stratum.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Spacing = Literal["linear", "log"]


def stratified(
    near: Float[Tensor, "*rays"],
    far: Float[Tensor, "*rays"],
    count: int,
    generator: torch.Generator | None,
    spacing: Spacing = "linear",
) -> Float[Tensor, "*rays {count}+1"]:
    """One position t_i ~ U[bin i] in each of ``count`` equal bins of [near, far] (eq. 2), and far.

    ``spacing`` "log" divides log t into equal bins, t = near (far/near)^u, and needs near > 0.
    """
    u = _strata(near, count, generator)
    near, far = near[..., None], far[..., None]
    t = torch.lerp(near, far, u) if spacing == "linear" else near * (far / near) ** u
    return torch.cat([t, far], -1)


def midpoint_edges(t: Float[Tensor, "*rays ends"], near: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays ends"]:
    """Edges around the samples of ``t``, half-way between neighbours, from near to far.

    The weight of sample i is spread on both sides of t_i: the surface that stopped the light lies before it.
    (The published code does the same and drops the first and last weight, for which it has no edge.)
    """
    middle = (t[..., 1:-1] + t[..., :-2]) / 2
    return torch.cat([near[..., None], middle, t[..., -1:]], -1)


@torch.no_grad()
def sample_pdf(
    edges: Float[Tensor, "*rays ends"],
    weights: Float[Tensor, "*rays ends-1"],
    count: int,
    generator: torch.Generator | None,
) -> Float[Tensor, "*rays {count}"]:
    """Draw ``count`` ascending positions from the piecewise-constant PDF by inverse transform sampling (section 5.2).

    One draw from each of ``count`` equal shares of the probability. A ray without any weight is sampled alike in
    every bin. No gradient passes, as in the published code.
    """
    return invert_cdf(edges, weights, _strata(weights[..., 0], count, generator))


def invert_cdf(
    edges: Float[Tensor, "*rays ends"], weights: Float[Tensor, "*rays ends-1"], u: Float[Tensor, "*rays m"]
) -> Float[Tensor, "*rays m"]:
    """Positions at which the CDF of the piecewise-constant PDF reaches u in [0, 1].

    No division can fail here: u is scaled to the sum of the weights (all ones where that sum is zero) instead of
    dividing the weights by it, and kept below the last entry of the CDF, so that bisection ends at a bin with
    cdf_i <= u < cdf_{i+1}, which is never an empty one.
    """
    weights = torch.where(weights.sum(-1, keepdim=True) == 0, 1, weights)
    cdf = torch.nn.functional.pad(torch.cumsum(weights, -1), (1, 0))
    total = cdf[..., -1:]
    u = torch.minimum(u * total, torch.nextafter(total, torch.zeros_like(total)))
    # The clamp acts on NaN alone, for which bisection finds no bin: the positions must be NaN, not an index error.
    above = torch.searchsorted(cdf, u, right=True).clamp(max=weights.shape[-1])
    low, high = cdf.gather(-1, above - 1), cdf.gather(-1, above)
    left, right = edges.gather(-1, above - 1), edges.gather(-1, above)
    return torch.lerp(left, right, (u - low) / (high - low))


def _strata(
    like: Float[Tensor, "*rays"], count: int, generator: torch.Generator | None
) -> Float[Tensor, "*rays {count}"]:
    """One number in each of ``count`` equal parts of [0, 1]: uniform in its part, or its middle."""
    shape = (*like.shape, count)
    if generator is None:
        offset = like.new_full(shape, 0.5)
    else:
        offset = torch.rand(shape, generator=generator, dtype=like.dtype, device=like.device)
    return (torch.arange(count, dtype=like.dtype, device=like.device) + offset) / count
