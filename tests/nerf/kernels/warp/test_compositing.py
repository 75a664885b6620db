"""Warp's compositing and losses along rays are the reference's, in value and gradient."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.kernels import Backend, Layers, RayStepping, Samples, warp
from nerf.kernels import torch as reference
from tests.nerf.kernels.agreement import (
    COUNTS,
    STEPPINGS,
    TOLERANCE,
    agree,
    assert_each_close,
    doubled,
    normal,
    packed,
    random_rays,
    relative_error,
    uniform,
)

EVEN, GROWING = STEPPINGS.values()


def seen(device: str, rays: int, samples: int) -> tuple[Tensor, Tensor, Tensor]:
    """Colours, background and far."""
    return uniform(device, 14, samples, 3), uniform(device, 15, rays, 3), 5 + 600 * uniform(device, 16, rays)


def gradients(device: str, rays: int, samples: int) -> tuple[Rendering, Tensor]:
    return (
        Rendering(normal(device, 17, rays, 3), normal(device, 18, rays), normal(device, 19, rays)),
        normal(device, 20, samples),
    )


@pytest.mark.parametrize("scale", [0.01, 1.0, 30.0, 1000.0])
def test_compositing_and_its_gradients(device: str, scale: float) -> None:
    samples, n = packed(device, COUNTS), sum(COUNTS)
    inputs = samples, scale * uniform(device, 21, n), *seen(device, len(COUNTS), n)
    agree("composite", *inputs)
    agree("composite_backward", *inputs, *gradients(device, len(COUNTS), n))


def three_long_rays(device: str, varied: bool) -> tuple[Samples, Tensor]:
    """Rays of 4,096 samples, and a number for each that its interval is proportional to: 1, or 0.5 to 1.5."""
    n = 4096 * 3
    each = uniform(device, 22, n) + 0.5 if varied else torch.ones(n, device=device)
    return packed(device, [4096] * 3, 0.001 * each), each


@pytest.mark.parametrize("density", [0.01, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("varied", [False, True])
def test_rays_of_4096_samples(device: str, varied: bool, density: float) -> None:
    """Equal ones, too: there the roundings of a sum all go the same way."""
    samples, each = three_long_rays(device, varied)
    inputs = samples, density * each, *seen(device, 3, len(each))
    _, weights = agree("composite", *inputs, tolerance=1e-6)
    agree("composite_backward", *inputs, *gradients(device, 3, len(each)), tolerance=1e-6)
    for stepping in (EVEN, GROWING):
        agree("distortion", samples, weights, stepping, tolerance=1e-6)
        agree("distortion_backward", samples, weights, stepping, normal(device, 23, 3), tolerance=1e-6)


@pytest.mark.parametrize("varied", [False, True])
def test_other_sums_along_rays_of_4096_samples(device: str, varied: bool) -> None:
    samples, each = three_long_rays(device, varied)
    rays = random_rays(device, 32).each(lambda part: part[-3:])
    for contracted in (False, True):
        grad = 0.1 * each[:, None].repeat(1, 3)
        agree("sample_points_backward", rays, samples, contracted, grad, tolerance=1e-6)
    weights, opacity, distance = each / 5000, uniform(device, 28, 3), torch.tensor([0.05, 2.0, 5.0], device=device)
    for stepping in (EVEN, GROWING):
        agree("depth_loss", samples, weights, opacity, rays.far, distance, stepping, tolerance=1e-6)
        agree("depth_loss_backward", samples, rays.far, distance, stepping, normal(device, 23, 3), tolerance=1e-6)
    layers, given = Layers(normal(device, 24, 4, 64), normal(device, 25, 3, 64)), 0.1 * each[:, None]
    inputs, ray_hidden = given.repeat(1, 4) - 0.06, torch.zeros(3, 64, device=device)
    agree("mlp_backward", layers, inputs, given.repeat(1, 3), samples, ray_hidden, tolerance=5e-6)


@pytest.mark.parametrize("varied", [False, True])
def test_waves_of_4096_samples(device: str, varied: bool) -> None:
    (samples, each), jitter = three_long_rays(device, varied), uniform(device, 33, 3)
    far, light_left = torch.full((3,), 9.0, device=device), 0.2
    for stepping in (EVEN._replace(max_samples=4096), GROWING._replace(max_samples=4096)):
        depths, nears = [], []
        for backend, kind in ((warp, torch.float32), (reference, torch.float64)):
            depth, near = torch.full((3,), 0.1, dtype=torch.float64, device=device), torch.zeros(3, dtype=kind)
            arguments = samples, 0.3 * each, light_left, jitter, far
            arguments = arguments if backend is warp else doubled(arguments)
            backend.finish_round(stepping, *arguments, depth, near)
            depths.append(depth)
            nears.append(near)
        assert (depths[0] > 1).all() and float((depths[0] / depths[1] - 1).abs().max()) < 1e-6
        assert ((nears[1] > 4) & (nears[1] < 9)).all() and relative_error(*nears) < TOLERANCE


@pytest.mark.parametrize("varied", [False, True])
def test_what_is_done_to_each_of_4096_samples(device: str, varied: bool) -> None:
    samples, each = three_long_rays(device, varied)
    rays = random_rays(device, 32).each(lambda part: part[-3:])
    for contracted in (False, True):
        agree("sample_points", rays, samples, contracted, tolerance=1e-6)
    for thin in (0.0, 0.01):
        kept, _ = agree("visible_samples", samples, each, 0.2, thin, uniform(device, 33, 3), tolerance=1e-6)
        assert kept.starts.diff().min() > (100 if thin else 1000) and len(kept.t) < len(each) / 2
    rounds, _ = agree("pack_rounds", [samples, packed(device, [4096, 0, 1])])
    assert rounds.starts.diff().tolist() == [8192, 4096, 4097]


THICKNESS = st.one_of(st.floats(0, 1e30), st.floats(0, 30), st.sampled_from([0.0, 1e-30, 800.0, 1e30]))


@given(st.lists(THICKNESS, max_size=12), st.lists(THICKNESS, max_size=3))
@settings(max_examples=200)
def test_thickness_from_nothing_to_1e30(first: list[float], second: list[float]) -> None:
    """Each ray by itself. What a sample adds to the gradient of its density is a difference, T g - behind - U G, of
    numbers up to the largest |g| and |G|: the error is relative to them, as to values of 1 in the rendering."""
    counts = [len(first), len(second)]
    samples = packed("cpu", counts, torch.ones(sum(counts)))
    sigma = torch.tensor([*first, *second])
    colour, background, far = seen("cpu", 2, sum(counts))
    inputs, grads = (samples, sigma, colour, background, far), gradients("cpu", 2, sum(counts))
    rendering, weights = warp.composite(*inputs)
    wanted, wanted_weights = reference.composite(*doubled(inputs))
    assert ((weights >= 0) & (weights <= 1)).all() and ((rendering.opacity >= 0) & (rendering.opacity <= 1)).all()
    pairs = list(zip([*rendering, weights], [*wanted, wanted_weights], strict=True))
    scales = [1.0, float(far.max()), 1.0, 1.0]
    on_seen, on_depth = grads[0].colour[samples.ray.long()], grads[0].depth[samples.ray.long()]
    g = grads[1] + (on_seen * colour).sum(-1) + on_depth * samples.t
    on_unstopped = (grads[0].colour * background).sum(-1) + grads[0].depth * far - grads[0].opacity
    scales += [float(torch.cat([g, on_unstopped]).abs().max()), float(grads[0].colour.abs().max())]
    pairs += zip(
        warp.composite_backward(*inputs, *grads), reference.composite_backward(*doubled((*inputs, *grads))), strict=True
    )
    for (one, right), scale in zip(pairs, scales, strict=True):
        assert one.isfinite().all()
        assert not one.numel() or float((one - right).abs().max()) < TOLERANCE * scale


def test_an_opaque_sample_has_no_gradient(device: str) -> None:
    samples = packed(device, [4])
    sigma = torch.tensor([0.0, 1e30, 1.0, 1.0], device=device)
    colour, background, far = seen(device, 1, 4)
    rendering, weights = warp.composite(samples, sigma, colour, background, far)
    assert weights.tolist() == [0, 1, 0, 0] and torch.equal(rendering.colour[0], colour[1])
    grad_sigma, grad_colour = warp.composite_backward(samples, sigma, colour, background, far, *gradients(device, 1, 4))
    assert grad_sigma[0] != 0 and grad_sigma[1:].tolist() == [0, 0, 0]
    assert grad_colour[[0, 2, 3]].abs().max() == 0


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1e20])
@pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])
def test_what_is_wrong_on_one_ray_changes_nothing_on_others(device: str, backend: Backend, wrong: float) -> None:
    """In value and gradient, of the rays before it and behind it."""
    samples, (background, far) = packed(device, [20, 30, 40]), seen(device, 3, 90)[1:]
    elsewhere, grads, on_spread = samples.ray != 1, gradients(device, 3, 90)[0], normal(device, 26, 3)

    def on_others(value: float) -> list[Tensor]:
        colour, given, sigma, weights = seen(device, 3, 90)[0], *(uniform(device, seed, 90) for seed in (20, 21, 25))
        for place, part in ((22, colour), (23, given), (24, weights), (25, sigma)):
            part[place] = value
        inputs = samples, sigma, colour, background, far
        rendering, light = backend.composite(*inputs)
        of_samples = light, *backend.composite_backward(*inputs, grads, given)
        spread = backend.distortion(samples, weights, GROWING)
        pull = backend.distortion_backward(samples, weights, GROWING, on_spread)
        kept, index = backend.visible_samples(samples, sigma, 1e-3, 0.05, on_spread.abs().clamp(max=0.9))
        visible = [part[kept.ray != 1] for part in (index, kept.t, kept.dt)]
        ray_hidden = [part[[0, 2]] for part in (*rendering, spread)]
        return [*(part[elsewhere] for part in (*of_samples, pull)), *ray_hidden, *visible]

    for one, right in zip(on_others(wrong), on_others(0.5), strict=True):
        assert relative_error(one.float(), right) < 1e-6 and right.any()


@pytest.mark.parametrize("threshold", [0.0, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("scale", [1.0, 100.0, 1e30])
def test_the_visible_samples(device: str, scale: float, threshold: float) -> None:
    samples, offset = packed(device, COUNTS), uniform(device, 32, len(COUNTS))
    sigma = scale * uniform(device, 24, sum(COUNTS))
    front, _ = agree("visible_samples", samples, sigma, threshold, 0.0, offset, tolerance=1e-30)
    kept = len(front.t) / sum(COUNTS)
    assert kept == 1 if threshold == 0 else 0 < kept < (0.3 if scale > 1 else 1.01)


@pytest.mark.parametrize("thin", [1e-3, 1e-2, 1.0])
@pytest.mark.parametrize("scale", [0.0, 0.1, 3.0])
def test_the_visible_samples_without_most_of_the_thin_ones(device: str, scale: float, thin: float) -> None:
    samples, offset = packed(device, COUNTS), uniform(device, 32, len(COUNTS))
    sigma = scale * uniform(device, 24, sum(COUNTS)) ** 3
    every, _ = warp.visible_samples(samples, sigma, 1e-3, 0.0, offset)
    some, _ = agree("visible_samples", samples, sigma, 1e-3, thin, offset, tolerance=1e-6)
    assert len(some.t) < len(every.t)
    if not scale:
        assert len(some.t) == pytest.approx(len(every.t) / 16, rel=0.2)


def test_a_density_that_is_no_number_is_visible(device: str) -> None:
    samples, sigma = packed(device, [4]), torch.tensor([1e-6, math.nan, 1.0, 1.0], device=device)
    for backend in (reference, warp):
        assert backend.visible_samples(samples, sigma, 1e-3, 1e-2, uniform(device, 32, 1))[1].tolist() == [1]


@pytest.mark.parametrize("stepping", STEPPINGS.values(), ids=STEPPINGS)
def test_distortion_and_its_gradient(device: str, stepping: RayStepping) -> None:
    samples = packed(device, COUNTS)
    weights = uniform(device, 25, sum(COUNTS))
    agree("distortion", samples, weights, stepping)
    agree("distortion_backward", samples, weights, stepping, normal(device, 26, len(COUNTS)))


@pytest.mark.parametrize("step", [1e-5, 0.002, 0.02, 0.5, 4.0])
def test_losses_of_light_that_ends_close_together_far_out(device: str, step: float) -> None:
    """Half of it in each of two neighbours at about 768, or at a sample before a point: their difference is the loss,
    and that of their logarithms, each rounded, is off by 1e-4 of it."""
    counts = [2, 40, 128]
    samples = packed(device, counts, 768 * step * (0.5 + uniform(device, 32, sum(counts))))
    samples = samples._replace(t=768 + samples.t)
    pairs, alone = torch.zeros(2, sum(counts), device=device)
    pairs[[0, 1, 20, 21, -2, -1]], alone[samples.starts[:-1].long()] = 0.5, 1.0
    for weights in (pairs, alone, uniform(device, 25, sum(counts))):
        agree("distortion", samples, weights, GROWING, tolerance=1e-6)
        agree("distortion_backward", samples, weights, GROWING, normal(device, 26, 3), tolerance=1e-6)
    full, far = torch.ones(3, device=device), torch.full((3,), 1e6, device=device)
    behind = samples.t[samples.starts[:-1].long() + 1]
    agree("depth_loss", samples, alone, full, far, behind, GROWING, tolerance=1e-6)
    nearest = agree("depth_loss_backward", samples, far, behind, GROWING, full)[0][0]
    assert float(nearest) == pytest.approx(math.log(float(behind[0]) / float(samples.t[0])), rel=1e-6)


@pytest.mark.parametrize("stepping", STEPPINGS.values(), ids=STEPPINGS)
def test_depth_loss_and_its_gradient(device: str, stepping: RayStepping) -> None:
    samples, rays = packed(device, COUNTS), len(COUNTS)
    weights, opacity = uniform(device, 27, sum(COUNTS)), uniform(device, 28, rays)
    far, distance = 20 + uniform(device, 29, rays), 8 * uniform(device, 30, rays)
    distance[::3] = 0  # no point is known
    loss = agree("depth_loss", samples, weights, opacity, far, distance, stepping)
    assert (loss[::3] == 0).all() and (loss[1::3] > 0).all()
    arguments = samples, far, distance, stepping, normal(device, 31, rays)
    given, wanted = warp.depth_loss_backward(*arguments), reference.depth_loss_backward(*doubled(arguments))
    for one, right in zip(given, wanted, strict=True):
        assert_each_close(one, right, 0.0)
