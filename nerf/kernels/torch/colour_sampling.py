"""Opacity-quantised colour sampling for rendering: few samples of a ray have their colour evaluated.

Most samples add hardly any opacity. So the opacity along a ray is cut into equal steps, the first of half the size.
Only samples at which a step is completed have their colour evaluated, each weighted by all opacity since the one
before. No more opacity than one step takes the colour of another sample, and a surface keeps its weight.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from nerf.kernels import ColourSamples, Samples
from nerf.kernels.torch.compositing import OPAQUE, sums_before


def select_colour_samples(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    opacity_step: float,
    optical_depth: Float64[Tensor, "rays"],
    accumulated: Float[Tensor, "rays"],
) -> ColourSamples:
    """Of one marching round, the samples at which floor(O / opacity_step + 1/2) grows, where O = 1 - exp(-sum sigma dt)
    is the opacity of the ray so far. Samples whose density is NaN are left out.

    In place, ``optical_depth`` grows by that of all of the round's samples, and ``accumulated`` becomes O at the last
    selected sample, of this round or an earlier one.
    """
    tau = (sigma * samples.dt).clamp(max=OPAQUE).double()
    before = optical_depth.index_select(0, samples.ray) + sums_before(samples, tau)
    optical_depth.index_add_(0, samples.ray, tau)
    opacity = _opacity(before + tau)
    index = (_opacity_steps(opacity, opacity_step) > _opacity_steps(_opacity(before), opacity_step)).nonzero()[:, 0]
    starts = torch.searchsorted(index, samples.starts.long(), out_int32=True)
    ray, t, dt = (each.index_select(0, index) for each in samples[1:])
    opacity = opacity.index_select(0, index)
    previous = opacity.roll(1)
    begins = starts[:-1][starts.diff() > 0]
    previous[begins] = accumulated.double().index_select(0, ray[begins])
    accumulated[ray[begins]] = opacity[starts[1:][starts.diff() > 0] - 1].to(accumulated.dtype)
    return ColourSamples(Samples(starts, ray, t, dt), index.int(), (opacity - previous).to(sigma.dtype))


def _opacity(optical_depth: Float64[Tensor, "samples"]) -> Float64[Tensor, "samples"]:
    return -torch.expm1(-optical_depth)


def _opacity_steps(opacity: Float64[Tensor, "samples"], opacity_step: float) -> Float64[Tensor, "samples"]:
    return (opacity / opacity_step + 0.5).floor()


def accumulate_colours(
    selected: ColourSamples, colour: Float[Tensor, "kept 3"], rendered: Float[Tensor, "rays 4"]
) -> None:
    """In place, ``rendered`` grows by what the samples show, sum w c, and sum w t."""
    each = selected.weights[:, None] * torch.cat([colour, selected.samples.t[:, None]], -1)
    rendered += (
        torch.zeros_like(rendered, dtype=torch.float64)
        .index_add(0, selected.samples.ray, each.double())
        .to(rendered.dtype)
    )
