import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.kernels import RayStepping, Samples
from nerf.kernels.torch import composite, composite_backward, distortion, distortion_backward, visible_samples
from nerf.kernels.torch.compositing import MIN_KEEP_PROBABILITY
from nerf.rendering import volume_rendering

COUNTS = (3, 0, 7, 1, 0, 12)
EVEN, GROWING = RayStepping(0.05, 0.0, False, 8, 100), RayStepping(0.05, 0.2, True, 8, 100)


def packed(counts: tuple[int, ...] = COUNTS, dtype: torch.dtype = torch.float64) -> Samples:
    generator = torch.Generator().manual_seed(1)
    starts = torch.tensor([0, *counts]).cumsum(0).int()
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)).int()
    dt = 0.02 + 0.1 * torch.rand(sum(counts), generator=generator, dtype=dtype)
    t = torch.cat([0.1 + part.cumsum(0) for part in dt.split(counts)])
    return Samples(starts, ray, t - dt / 2, dt)


def field(samples: Samples, scale: float = 8.0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    n, dtype = len(samples.t), samples.t.dtype
    sigma = scale * torch.rand(n, generator=generator, dtype=dtype) ** 3
    return sigma, torch.rand(n, 3, generator=generator, dtype=dtype)


def surroundings(rays: int = len(COUNTS), dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    return torch.rand(rays, 3, generator=generator, dtype=dtype), torch.full((rays,), 5.0, dtype=dtype)


def rendered_slowly(samples: Samples, sigma: Tensor, colour: Tensor, background: Tensor, far: Tensor) -> list[list]:
    rays = []
    for ray in range(len(samples.starts) - 1):
        light, seen, depth = 1.0, [0.0, 0.0, 0.0], 0.0
        for i in range(int(samples.starts[ray]), int(samples.starts[ray + 1])):
            weight = light * (1 - math.exp(-sigma[i].item() * samples.dt[i].item()))
            seen = [s + weight * c for s, c in zip(seen, colour[i].tolist(), strict=True)]
            depth += weight * samples.t[i].item()
            light *= math.exp(-sigma[i].item() * samples.dt[i].item())
        seen = [s + light * b for s, b in zip(seen, background[ray].tolist(), strict=True)]
        rays.append([*seen, depth + light * far[ray].item(), 1 - light])
    return rays


def test_the_rendering_is_that_of_a_slow_loop() -> None:
    samples = packed()
    inputs = (samples, *field(samples), *surroundings())
    rendering, _ = composite(*inputs)
    given = torch.cat([rendering.colour, rendering.depth[:, None], rendering.opacity[:, None]], -1)
    slow = torch.tensor(rendered_slowly(*inputs), dtype=torch.float64)
    torch.testing.assert_close(given, slow, rtol=0, atol=1e-13)


def test_equal_rays_are_rendered_as_the_unpacked_compositing_does() -> None:
    samples = packed((9,) * 4)
    sigma, colour = field(samples)
    background, far = surroundings(4)
    ends = torch.cat([torch.zeros(4, 1, dtype=torch.float64), samples.dt.view(4, 9).cumsum(-1)], -1)
    wanted, weights = volume_rendering.composite(sigma.view(4, 9), colour.view(4, 9, 3), ends, background)
    given, given_weights = composite(samples, sigma, colour, background, far)
    torch.testing.assert_close(given.colour, wanted.colour)
    torch.testing.assert_close(given_weights.view(4, 9), weights)


def test_weights_and_unstopped_light_partition_unity() -> None:
    samples = packed()
    rendering, weights = composite(samples, *field(samples), *surroundings())
    total = torch.zeros(len(COUNTS), dtype=torch.float64).index_add(0, samples.ray.long(), weights)
    torch.testing.assert_close(total, rendering.opacity)
    assert rendering.opacity[1] == 0 and rendering.depth[1] == 5


def test_the_gradients_are_those_of_autograd() -> None:
    samples = packed()
    sigma, colour = (tensor.requires_grad_() for tensor in field(samples))
    background, far = surroundings()
    rendering, weights = composite(samples, sigma, colour, background, far)
    generator = torch.Generator().manual_seed(9)
    outputs = (*rendering, weights)
    grads = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in outputs]
    wanted = torch.autograd.grad(outputs, (sigma, colour), grads)
    given = composite_backward(
        samples, sigma.detach(), colour.detach(), background, far, Rendering(*grads[:3]), grads[3]
    )
    torch.testing.assert_close(given, wanted, rtol=0, atol=1e-12)


@given(st.lists(st.floats(0, 1e30), min_size=5, max_size=5), st.sampled_from([torch.float32, torch.float64]))
def test_extreme_densities_have_finite_values_and_gradients(densities: list[float], dtype: torch.dtype) -> None:
    samples = packed((5, 5), dtype)
    sigma = torch.tensor([*densities, 0.0, 1.0, 0.1, 0.0, 2.0], dtype=dtype)
    colour, (background, far) = field(samples)[1], surroundings(2, dtype)
    rendering, weights = composite(samples, sigma, colour, background, far)
    ones = Rendering(torch.ones_like(background), torch.ones_like(far), torch.ones_like(far))
    gradients = composite_backward(samples, sigma, colour, background, far, ones, torch.ones_like(sigma))
    assert all(tensor.isfinite().all() for tensor in (*rendering, weights, *gradients))
    assert ((weights >= 0) & (weights <= 1)).all()
    alone = packed((5,), dtype)._replace(t=samples.t[5:], dt=samples.dt[5:])
    by_itself, _ = composite(alone, sigma[5:], colour[5:], background[1:], far[1:])
    torch.testing.assert_close(rendering.colour[1:], by_itself.colour, rtol=0, atol=1e-6)


def test_an_opaque_sample_hides_all_behind_it() -> None:
    samples = packed((4,))
    sigma = torch.tensor([0.0, 1e30, 1.0, 1.0], dtype=torch.float64)
    colour, (background, far) = field(samples)[1], surroundings(1)
    rendering, weights = composite(samples, sigma, colour, background, far)
    assert torch.equal(rendering.colour[0], colour[1])
    assert weights.tolist() == [0, 1, 0, 0]
    ones = Rendering(torch.ones(1, 3).double(), torch.zeros(1).double(), torch.zeros(1).double())
    grad_sigma, _ = composite_backward(samples, sigma, colour, background, far, ones, torch.zeros(4).double())
    assert grad_sigma[1:].tolist() == [0, 0, 0]
    assert grad_sigma[0] != 0


def test_the_visible_samples_end_where_too_little_light_is_left() -> None:
    samples = packed()
    sigma, _ = field(samples, 60.0)
    kept, index = visible_samples(samples, sigma, 0.1, 0.0, torch.zeros(6))
    wanted = []
    for ray in range(len(COUNTS)):
        light = 1.0
        for i in range(int(samples.starts[ray]), int(samples.starts[ray + 1])):
            if light >= 0.1:
                wanted.append(i)
            light *= math.exp(-sigma[i].item() * samples.dt[i].item())
    assert index.tolist() == wanted and 5 < len(wanted) < 20
    assert torch.equal(kept.t, samples.t[index]) and torch.equal(kept.dt, samples.dt[index])
    assert torch.equal(kept.starts.diff().long(), torch.bincount(kept.ray, minlength=6))
    everything, _ = visible_samples(samples, sigma, 0.0, 0.0, torch.zeros(6))
    assert all(torch.equal(a, b) for a, b in zip(everything, samples, strict=True))


def test_early_termination_changes_less_than_its_threshold() -> None:
    samples = packed((12,) * 20)
    sigma, colour = field(samples, 200.0)
    background, far = surroundings(20)
    kept, index = visible_samples(samples, sigma, 1e-3, 0.0, torch.zeros(20))
    full, _ = composite(samples, sigma, colour, background, far)
    front, _ = composite(kept, sigma[index], colour[index], background, far)
    assert len(index) < 0.8 * len(sigma)
    assert 0 < (full.colour - front.colour).abs().max() < 1e-3


def test_thin_samples_survive_at_their_expected_number() -> None:
    samples, thin = packed((12, 0, 40)), 0.1
    sigma, _ = field(samples)
    kept, index = visible_samples(samples, sigma, 0.1, thin, torch.tensor([0.3, 0.0, 0.9]))
    wanted, lengths = [], []
    for ray, offset in enumerate((0.3, 0.0, 0.9)):
        light, probabilities = 1.0, offset
        for i in range(int(samples.starts[ray]), int(samples.starts[ray + 1])):
            tau = sigma[i].item() * samples.dt[i].item()
            probability = min(max(tau / thin, MIN_KEEP_PROBABILITY), 1.0)
            before, probabilities = math.floor(probabilities), probabilities + (probability if probability < 1 else 0)
            if light >= 0.1 and (probability == 1 or math.floor(probabilities) > before):
                wanted.append(i)
                lengths.append(samples.dt[i].item() / probability)
            light *= math.exp(-tau)
    assert index.tolist() == wanted and 5 < len(wanted) < 40
    torch.testing.assert_close(kept.dt.tolist(), lengths)
    assert torch.equal(kept.t, samples.t[index]) and torch.equal(kept.ray, samples.ray[index])
    assert torch.equal(kept.starts.diff().long(), torch.bincount(kept.ray, minlength=3))


@pytest.mark.parametrize("thin", [0.01, 0.1, 1.0])
def test_over_all_offsets_each_length_is_what_it_was(thin: float) -> None:
    """So sums of tau f are kept in expectation, and thick samples and what is no number are always there."""
    samples, draws = packed((200,)), 2000
    sigma, _ = field(samples, 2.0)
    sigma[::5], sigma[7::50] = 0, 50
    sigma[150:] = math.nan  # of what follows nothing is visible
    total, least = torch.zeros_like(sigma), len(sigma)
    for offset in (torch.arange(draws) + 0.5) / draws:
        kept, index = visible_samples(samples, sigma, 0.0, thin, offset[None])
        total[index] += kept.dt / draws
        least = min(least, len(index))
    tau = sigma * samples.dt
    assert torch.equal((total / samples.dt > 0), torch.arange(200) <= 150)
    torch.testing.assert_close(total[:151], samples.dt[:151], rtol=1.01 / draws / MIN_KEEP_PROBABILITY, atol=0)
    thick = (tau >= thin)[:150]
    assert (tau[:150] >= thin).sum() < least < 151
    assert (total[:150][thick] / samples.dt[:150][thick] - 1).abs().max() < 1e-12


@pytest.mark.parametrize("stepping", [EVEN, GROWING])
def test_distortion_is_the_double_sum(stepping: RayStepping) -> None:
    samples = packed()
    weights = composite(samples, *field(samples), *surroundings())[1]
    if stepping.cone_angle:
        m = torch.where(samples.t < 0.25, samples.t / 0.25, 1 + torch.log(samples.t / 0.25))
        lengths = samples.dt / samples.t.clamp(min=0.25)
    else:
        m, lengths = samples.t, samples.dt
    wanted = []
    for ray in range(len(COUNTS)):
        own = slice(int(samples.starts[ray]), int(samples.starts[ray + 1]))
        w, at = weights[own], m[own]
        pairs = w[:, None] * w * (at[:, None] - at).abs()
        wanted.append(float(pairs.sum() + (w**2 * lengths[own]).sum() / 3))
    torch.testing.assert_close(distortion(samples, weights, stepping).tolist(), wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("scale", [1.0, 1e6])
@pytest.mark.parametrize("stepping", [EVEN, GROWING])
def test_the_gradient_of_the_distortion_is_autograds(stepping: RayStepping, scale: float) -> None:
    """Also of weights so large that rays are summed apart."""
    samples = packed()
    weights = (scale * composite(samples, *field(samples), *surroundings())[1]).requires_grad_()
    grad = torch.arange(1.0, 7.0, dtype=torch.float64)
    wanted = torch.autograd.grad(distortion(samples, weights, stepping), weights, grad)[0]
    given = distortion_backward(samples, weights.detach(), stepping, grad)
    torch.testing.assert_close(given, wanted, rtol=0, atol=scale * 1e-13)
    small = distortion_backward(samples, weights.detach() / scale, stepping, grad)
    torch.testing.assert_close(given / scale, small, rtol=0, atol=1e-13)


def test_no_samples_show_the_background() -> None:
    samples = packed((0, 0))
    background, far = surroundings(2)
    empty = torch.zeros(0, dtype=torch.float64)
    rendering, _ = composite(samples, empty, empty.view(0, 3), background, far)
    assert torch.equal(rendering.colour, background) and torch.equal(rendering.depth, far)
    assert visible_samples(samples, empty, 0.5, 0.1, far)[0].starts.tolist() == [0, 0, 0]
    assert distortion(samples, empty, EVEN).tolist() == [0, 0]
