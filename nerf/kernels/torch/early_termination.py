"""What holds between two waves of samples (nerf/rendering/early_termination.py): which rays still have light, and where
they go on."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64, Int32
from torch import Tensor

from nerf.kernels import Lattice, Samples
from nerf.kernels.torch.compositing import OPAQUE
from nerf.kernels.torch.marching import s_to_t, t_to_s


def finish_round(
    lattice: Lattice,
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    threshold: float,
    jitter: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    depth: Float64[Tensor, "rays"],
    near: Float[Tensor, "rays"],
) -> None:
    """In place, after a wave of up to ``lattice.most_samples`` samples of each ray: ``depth`` grows by their optical
    depth, sum sigma dt, and ``near`` becomes where the ray goes on.

    That is where the interval behind its last sample's begins; ``far``, so that nothing is left of it, for a ray that
    had fewer samples than it might have had, or whose transmittance exp(-depth) is below ``threshold`` or no number.
    """
    depth.index_add_(0, samples.ray, (sigma * samples.dt).clamp(max=OPAQUE).double())
    goes_on = (samples.starts.diff() == lattice.most_samples) & (torch.exp(-depth.to(sigma.dtype)) >= threshold)
    ray = goes_on.nonzero()[:, 0]
    last = samples.t.index_select(0, samples.starts.index_select(0, ray + 1) - 1)
    onward = s_to_t(lattice, t_to_s(lattice, last) + (1 - jitter.index_select(0, ray)))
    near.copy_(far)
    near[ray] = torch.minimum(onward, far[ray])


def pack_rounds(waves: Sequence[Samples]) -> tuple[Samples, Int32[Tensor, "samples"]]:
    """The samples of several waves of the same rays packed ray by ray, and where each is among the waves' samples one
    after the other."""
    counts = torch.stack([wave.starts.diff() for wave in waves])
    starts = torch.stack([wave.starts for wave in waves]).sum(0, dtype=torch.int32)
    first = starts[:-1] + counts.cumsum(0, dtype=torch.int32) - counts  # where each wave's samples of a ray go
    ray, t, dt = (torch.cat(parts) for parts in zip(*(wave[1:] for wave in waves), strict=True))
    places = [
        (first[number] - wave.starts[:-1]).index_select(0, wave.ray) + torch.arange(len(wave.ray), device=ray.device)
        for number, wave in enumerate(waves)
    ]
    order = torch.empty_like(ray)
    order[torch.cat(places)] = torch.arange(len(ray), dtype=torch.int32, device=ray.device)
    return Samples(starts, *(part.index_select(0, order) for part in (ray, t, dt))), order
