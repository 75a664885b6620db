"""Opacity-quantised colour sampling (``nerf.kernels.torch.colour_sampling``): a ray is one thread's loop."""

import torch
import warp as wp
from jaxtyping import Float, Float64
from torch import Tensor

from nerf.kernels import ColourSamples, Samples
from nerf.kernels.warp.compositing import opacity_of, optical_thickness
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.packing import new_packed

wp.set_module_options({"enable_backward": False})


def select_colour_samples(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    opacity_step: float,
    optical_depth: Float64[Tensor, "rays"],
    accumulated: Float[Tensor, "rays"],
) -> ColourSamples:
    """As in nerf.kernels.torch.colour_sampling."""
    rays, device = len(optical_depth), sigma.device
    counts = torch.zeros(rays + 1, dtype=torch.int32, device=device)
    selected_index, selected_weights = torch.empty_like(samples.ray), torch.empty_like(sigma)
    packed = samples.starts, samples.dt, sigma
    launch(
        _select, rays, *packed, 1 / opacity_step, optical_depth, accumulated, counts, selected_index, selected_weights
    )
    starts, (index, ray), (t, dt, weights) = new_packed(counts, 2, 3)
    selected = samples.starts, starts, samples.t, samples.dt, selected_index, selected_weights
    launch(_pack, rays, *selected, index, ray, t, dt, weights)
    return ColourSamples(Samples(starts, ray, t, dt), index, weights)


def accumulate_colours(
    selected: ColourSamples, colour: Float[Tensor, "kept 3"], rendered: Float[Tensor, "rays 4"]
) -> None:
    """As in nerf.kernels.torch.colour_sampling."""
    launch(_accumulate, len(rendered), selected.samples.starts, selected.samples.t, selected.weights, colour, rendered)


@wp.kernel
def _select(
    starts: wp.array[int],
    lengths: wp.array[float],
    sigma: wp.array[float],
    steps_per_opacity: float,
    optical_depth: wp.array[wp.float64],
    accumulated: wp.array[float],
    counts: wp.array[int],
    selected_index: wp.array[int],
    weights: wp.array[float],
):
    ray = wp.tid()
    start = starts[ray]
    end = starts[ray + 1]
    counts[ray + 1] = 0
    if start == end:
        return
    tau = optical_depth[ray]
    previous = accumulated[ray]
    steps_before = wp.floor(opacity_of(float(tau)) * steps_per_opacity + 0.5)
    entry = int(start)
    for i in range(start, end):
        tau += wp.float64(optical_thickness(sigma[i], lengths[i]))
        opacity = opacity_of(float(tau))
        completed = wp.floor(opacity * steps_per_opacity + 0.5)
        # Written in any case, as a branch that is taken half of the time costs more.
        selected_index[entry] = i
        weights[entry] = opacity - previous
        is_selected = completed > steps_before
        previous = wp.where(is_selected, opacity, previous)
        entry += int(is_selected)
        steps_before = completed
    optical_depth[ray] = tau
    accumulated[ray] = previous
    counts[ray + 1] = entry - start


@wp.kernel
def _pack(
    starts: wp.array[int],
    kept_starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    selected_index: wp.array[int],
    weights: wp.array[float],
    index: wp.array[int],
    rays: wp.array[int],
    kept_distances: wp.array[float],
    kept_lengths: wp.array[float],
    kept_weights: wp.array[float],
):
    ray = wp.tid()
    start = starts[ray]
    first = kept_starts[ray]
    for entry in range(first, kept_starts[ray + 1]):
        i = selected_index[start + entry - first]
        index[entry] = i
        rays[entry] = ray
        kept_distances[entry] = distances[i]
        kept_lengths[entry] = lengths[i]
        kept_weights[entry] = weights[start + entry - first]


@wp.kernel
def _accumulate(
    starts: wp.array[int],
    distances: wp.array[float],
    weights: wp.array[float],
    colour: wp.array[wp.vec3],
    rendered: wp.array[wp.vec4],
):
    ray = wp.tid()
    sum_colour = wp.vec3d()
    sum_distance = wp.float64(0.0)
    for i in range(starts[ray], starts[ray + 1]):
        sum_colour += wp.vec3d(weights[i] * colour[i])
        sum_distance += wp.float64(weights[i] * distances[i])
    added = wp.vec3(sum_colour)
    rendered[ray] += wp.vec4(added[0], added[1], added[2], float(sum_distance))
