"""Volume rendering of packed samples (``nerf.kernels.torch.compositing``): a ray is one thread's loop.

Sums run along one ray, in float64 as the reference's do: in float32 a run of 4096 equal numbers is off by 1e-5 or more,
as each addition rounds the same way.
"""

import torch
import warp as wp
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.kernels import Samples
from nerf.kernels.torch.compositing import MIN_KEEP_PROBABILITY, OPAQUE
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.packing import new_packed

wp.set_module_options({"enable_backward": False})

_OPAQUE = wp.constant(OPAQUE)
_MIN_KEEP_PROBABILITY = wp.constant(MIN_KEEP_PROBABILITY)


def visible_samples(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    threshold: float,
    thinning_threshold: float,
    thinning_offset: Float[Tensor, "rays"],
    capacity: int | None = None,
) -> tuple[Samples, Int32[Tensor, "kept"]]:
    """As in nerf.kernels.torch.compositing."""
    rays, device = len(samples.starts) - 1, sigma.device
    counts = torch.zeros(rays + 1, dtype=torch.int32, device=device)
    launch(
        _count_visible, rays, samples.starts, samples.dt, sigma, threshold, thinning_threshold, thinning_offset, counts
    )
    starts, (index, ray), (t, dt) = new_packed(counts, 2, 2, capacity)
    packed = samples.t, samples.dt, sigma
    launch(_keep_visible, rays, samples.starts, starts, *packed, thinning_threshold, thinning_offset, index, ray, t, dt)
    return Samples(starts, ray, t, dt), index


def composite(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    colour: Float[Tensor, "samples 3"],
    background: Float[Tensor, "rays 3"],
    far: Float[Tensor, "rays"],
) -> tuple[Rendering, Float[Tensor, "samples"]]:
    """As in nerf.kernels.torch.compositing."""
    rendering = Rendering(torch.empty_like(background), torch.empty_like(far), torch.empty_like(far))
    weights = torch.zeros_like(sigma)
    packed = samples.starts, samples.t, samples.dt, sigma, colour
    launch(_composite, len(far), *packed, background, far, *rendering, weights)
    return rendering, weights


def composite_backward(
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    colour: Float[Tensor, "samples 3"],
    background: Float[Tensor, "rays 3"],
    far: Float[Tensor, "rays"],
    grad: Rendering,
    grad_weights: Float[Tensor, "samples"],
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
    """As in nerf.kernels.torch.compositing."""
    grad_sigma, grad_colour = torch.zeros_like(sigma), torch.zeros_like(colour)
    packed = samples.starts, samples.t, samples.dt, sigma, colour
    arguments = *packed, background, far, *grad, grad_weights, grad_sigma, grad_colour
    launch(_composite_backward, len(far), *arguments)
    return grad_sigma, grad_colour


@wp.func
def optical_thickness(sigma: float, length: float):
    """At most OPAQUE. Not by wp.min, which takes NaN for missing: a density of NaN would look solid."""
    tau = sigma * length
    return wp.where(tau > _OPAQUE, _OPAQUE, tau)


@wp.func
def opacity_of(tau: float):
    """1 - exp(-tau); by its series where the difference would lose digits."""
    if tau < 0.1:
        return tau * (1.0 - tau / 2.0 * (1.0 - tau / 3.0 * (1.0 - tau / 4.0 * (1.0 - tau / 5.0))))
    return 1.0 - wp.exp(-tau)


@wp.func
def _keep_probability(tau: float, thinning_threshold: float):
    """Of a sample; 1 for NaN."""
    if tau < thinning_threshold:
        return wp.max(tau / thinning_threshold, _MIN_KEEP_PROBABILITY)
    return 1.0


@wp.kernel
def _count_visible(
    starts: wp.array[int],
    lengths: wp.array[float],
    sigma: wp.array[float],
    threshold: float,
    thinning_threshold: float,
    offsets: wp.array[float],
    counts: wp.array[int],
):
    ray = wp.tid()
    tau = wp.float64(0.0)
    running = wp.float64(offsets[ray])
    count = int(0)
    i = int(starts[ray])
    end = starts[ray + 1]
    while i < end and wp.exp(-float(tau)) >= threshold:
        sample_tau = optical_thickness(sigma[i], lengths[i])
        tau += wp.float64(sample_tau)
        probability = _keep_probability(sample_tau, thinning_threshold)
        if probability < 1.0:
            before = wp.floor(running)
            running += wp.float64(probability)
            count += int(wp.floor(running) - before)
        else:
            count += 1
        i += 1
    counts[ray + 1] = count


@wp.kernel
def _keep_visible(
    starts: wp.array[int],
    kept_starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    sigma: wp.array[float],
    thinning_threshold: float,
    offsets: wp.array[float],
    index: wp.array[int],
    rays: wp.array[int],
    kept_distances: wp.array[float],
    kept_lengths: wp.array[float],
):
    ray = wp.tid()
    running = wp.float64(offsets[ray])
    entry = int(kept_starts[ray])
    end = kept_starts[ray + 1]
    i = int(starts[ray])
    while entry < end:
        probability = _keep_probability(optical_thickness(sigma[i], lengths[i]), thinning_threshold)
        kept = bool(True)
        if probability < 1.0:
            before = wp.floor(running)
            running += wp.float64(probability)
            kept = wp.floor(running) > before
        if kept:
            index[entry] = i
            rays[entry] = ray
            kept_distances[entry] = distances[i]
            kept_lengths[entry] = lengths[i] / probability
            entry += 1
        i += 1


@wp.kernel
def _composite(
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    sigma: wp.array[float],
    colour: wp.array[wp.vec3],
    background: wp.array[wp.vec3],
    far: wp.array[float],
    rgb: wp.array[wp.vec3],
    depth: wp.array[float],
    opacity: wp.array[float],
    weights: wp.array[float],
):
    ray = wp.tid()
    tau = wp.float64(0.0)
    sum_colour = wp.vec3d()
    sum_depth = wp.float64(0.0)
    for i in range(starts[ray], starts[ray + 1]):
        sample_tau = optical_thickness(sigma[i], lengths[i])
        weight = wp.exp(-float(tau)) * opacity_of(sample_tau)
        tau += wp.float64(sample_tau)
        weights[i] = weight
        sum_colour += wp.vec3d(weight * colour[i])
        sum_depth += wp.float64(weight * distances[i])
    transmittance = wp.exp(-float(tau))
    rgb[ray] = wp.vec3(sum_colour) + transmittance * background[ray]
    depth[ray] = float(sum_depth) + transmittance * far[ray]
    opacity[ray] = opacity_of(float(tau))


@wp.kernel
def _composite_backward(
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    sigma: wp.array[float],
    colour: wp.array[wp.vec3],
    background: wp.array[wp.vec3],
    far: wp.array[float],
    grad_rgb: wp.array[wp.vec3],
    grad_depth: wp.array[float],
    grad_opacity: wp.array[float],
    grad_weights: wp.array[float],
    grad_sigma: wp.array[float],
    grad_colour: wp.array[wp.vec3],
):
    ray = wp.tid()
    start = starts[ray]
    end = starts[ray + 1]
    tau = wp.float64(0.0)
    for i in range(start, end):
        grad_sigma[i] = float(tau)  # optical depth before the sample, for the second pass
        tau += wp.float64(optical_thickness(sigma[i], lengths[i]))
    ray_grad_rgb = grad_rgb[ray]
    ray_grad_depth = grad_depth[ray]
    grad_transmittance = wp.dot(ray_grad_rgb, background[ray]) + ray_grad_depth * far[ray] - grad_opacity[ray]
    behind = wp.float64(wp.exp(-float(tau)) * grad_transmittance)
    for step in range(end - start):
        i = end - 1 - step
        sample_tau = optical_thickness(sigma[i], lengths[i])
        before = wp.exp(-grad_sigma[i])
        weight = before * opacity_of(sample_tau)
        g = grad_weights[i] + wp.dot(ray_grad_rgb, colour[i]) + ray_grad_depth * distances[i]
        grad_sigma[i] = lengths[i] * (before * wp.exp(-sample_tau) * g - float(behind))
        grad_colour[i] = weight * ray_grad_rgb
        behind += wp.float64(weight * g)
