"""Between two rounds of ray marching (nerf/rendering/early_termination.py): which rays continue, and from where."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64, Int32
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.torch.compositing import OPAQUE
from nerf.kernels.torch.marching import s_to_t, t_to_s
from nerf.kernels.torch.packing import no_padding


def finish_round(
    stepping: RayStepping,
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    threshold: float,
    jitter: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    optical_depth: Float64[Tensor, "rays"],
    near: Float[Tensor, "rays"],
) -> None:
    """In place, after a round of up to ``stepping.max_samples`` samples of each ray: ``optical_depth`` grows by theirs,
    sum sigma dt, and ``near`` becomes where the ray continues.

    That is where the interval behind its last sample's begins; ``far``, so that nothing is left of it, for a ray that
    had fewer samples than it might have had, or whose transmittance exp(-optical_depth) is below ``threshold`` or NaN.
    """
    optical_depth.index_add_(0, samples.ray, (sigma * samples.dt).clamp(max=OPAQUE).double())
    continues = (samples.starts.diff() == stepping.max_samples) & (
        torch.exp(-optical_depth.to(sigma.dtype)) >= threshold
    )
    ray = continues.nonzero()[:, 0]
    last = samples.t.index_select(0, samples.starts.index_select(0, ray + 1) - 1)
    next_near = s_to_t(stepping, t_to_s(stepping, last) + (1 - jitter.index_select(0, ray)))
    near.copy_(far)
    near[ray] = torch.minimum(next_near, far[ray])


def pack_rounds(rounds: Sequence[Samples]) -> tuple[Samples, Int32[Tensor, "samples"]]:
    """The samples of several rounds of the same rays packed ray by ray, and where each is among the rounds' samples one
    after the other."""
    counts = torch.stack([each.starts.diff() for each in rounds])
    starts = torch.stack([each.starts for each in rounds]).sum(0, dtype=torch.int32)
    first = starts[:-1] + counts.cumsum(0, dtype=torch.int32) - counts  # where each round's samples of a ray go
    ray, t, dt = (torch.cat(parts) for parts in zip(*(each[1:] for each in rounds), strict=True))
    places = [
        (first[number] - each.starts[:-1]).index_select(0, each.ray) + torch.arange(len(each.ray), device=ray.device)
        for number, each in enumerate(rounds)
    ]
    chosen = torch.cat([no_padding(each) for each in rounds])
    order = torch.zeros_like(ray)
    order[torch.cat(places)[chosen]] = torch.arange(len(ray), dtype=torch.int32, device=ray.device)[chosen]
    inside = no_padding(Samples(starts, ray, t, dt))
    return Samples(starts, *(torch.where(inside, part.index_select(0, order), 0) for part in (ray, t, dt))), order
