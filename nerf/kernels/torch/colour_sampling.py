"""What rays see of samples that are only drawn, wave by wave (``nerf.rendering.early_termination``): colours of a few
samples stand for all.

Most samples stop hardly any light. So a ray's light is cut into quanta, equal shares but for a first one of half the
size, and only samples at which a quantum ends have their colour computed: each with the weight of all that was stopped
since the one before. No more than a quantum is shown in another sample's colour, and a surface keeps its weight.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from nerf.kernels import Drawn, Samples
from nerf.kernels.torch.compositing import OPAQUE, sums_before


def select_colour_samples(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    quantum: float,
    depth: Float64[Tensor, "rays"],
    shown: Float[Tensor, "rays"],
) -> Drawn:
    """Of a wave, the samples at which floor(W / quantum + 1/2) grows, W = 1 - exp(-sum sigma dt) being the share of its
    ray's light that is stopped so far. What is no number is left out.

    In place, ``depth`` grows by the optical depth of all of the wave's samples, and ``shown`` becomes W at the last
    sample that was kept, in this wave or before it.
    """
    tau = (sigma * samples.dt).clamp(max=OPAQUE).double()
    before = depth.index_select(0, samples.ray) + sums_before(samples, tau)
    depth.index_add_(0, samples.ray, tau)
    stopped = _stopped(before + tau)
    index = (_quanta(stopped, quantum) > _quanta(_stopped(before), quantum)).nonzero()[:, 0]
    starts = torch.searchsorted(index, samples.starts.long(), out_int32=True)
    ray, t, dt = (each.index_select(0, index) for each in samples[1:])
    stopped = stopped.index_select(0, index)
    already = stopped.roll(1)
    begins = starts[:-1][starts.diff() > 0]
    already[begins] = shown.double().index_select(0, ray[begins])
    shown[ray[begins]] = stopped[starts[1:][starts.diff() > 0] - 1].to(shown.dtype)
    return Drawn(Samples(starts, ray, t, dt), index.int(), (stopped - already).to(sigma.dtype))


def _stopped(depth: Float64[Tensor, "samples"]) -> Float64[Tensor, "samples"]:
    return -torch.expm1(-depth)


def _quanta(stopped: Float64[Tensor, "samples"], quantum: float) -> Float64[Tensor, "samples"]:
    return (stopped / quantum + 0.5).floor()


def accumulate_colours(drawn: Drawn, colour: Float[Tensor, "kept 3"], seen: Float[Tensor, "rays 4"]) -> None:
    """In place, ``seen`` grows by what the samples show, sum w c, and sum w t."""
    each = drawn.weights[:, None] * torch.cat([colour, drawn.samples.t[:, None]], -1)
    seen += torch.zeros_like(seen, dtype=torch.float64).index_add(0, drawn.samples.ray, each.double()).to(seen.dtype)
