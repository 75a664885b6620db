"""Laws of gains, gradients against autograd, extremes, and gains found again."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf.effects import exposure, foreground_radiance
from nerf.effects.appearance import AppearanceModel
from nerf.effects.exposure import ExposureModel, expose, expose_backward, fit_log_gain
from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from nerf.rendering.srgb_arrays import LINEAR_THRESHOLD

EXTREMES = [0.0, 1e-30, 1e-8, 0.04, LINEAR_THRESHOLD, 0.0405, 0.5, 1.0, 2.0, 1e4, 1e12, 1e20, 1e30]
gains = st.floats(-3, 3)


def colours(count: int = 3000, brightest: float = 1.2) -> Tensor:
    """In float64, half of them about the threshold of the sRGB curve."""
    random = torch.Generator().manual_seed(1)
    scale = torch.where(torch.arange(count) % 2 == 0, brightest, 3 * LINEAR_THRESHOLD)[:, None]
    return scale * torch.rand(count, 3, generator=random, dtype=torch.float64)


def gain(*logs: float) -> Tensor:
    return torch.tensor(logs if len(logs) == 3 else logs * 3, dtype=torch.float64)


@pytest.mark.parametrize("log_gain", [-2.0, -0.5, 0.1, 0.7, 2.5])
def test_a_gain_multiplies_light(log_gain: float):
    c = colours()
    by_light = linear_to_srgb(math.exp(log_gain) * srgb_to_linear(c))
    torch.testing.assert_close(expose(c, gain(log_gain)), by_light, atol=1e-7, rtol=1e-12)
    assert (expose(c, gain(log_gain)) - c).abs().max() > 0.02


@given(gains, gains)
def test_gains_add_up(first: float, second: float):
    twice = expose(expose(colours(), gain(first)), gain(second))
    torch.testing.assert_close(twice, expose(colours(), gain(first + second)), atol=1e-6, rtol=1e-9)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_no_gain_changes_no_bit(kind: torch.dtype):
    c = torch.cat([colours().to(kind), torch.tensor(EXTREMES, dtype=kind)[:, None].expand(-1, 3)])
    assert torch.equal(expose(c, torch.zeros(3, dtype=kind)), c)


def test_gains_of_channels_and_of_rays_are_their_own():
    c = colours(4)
    of_rays = torch.stack([gain(0.1 * i, -0.2 * i, 0.3) for i in range(4)])
    shown = expose(c, of_rays)
    for ray in range(4):
        for channel in range(3):
            alone = expose(c[ray], gain(float(of_rays[ray, channel])))[channel]
            assert shown[ray, channel] == alone


def test_what_is_below_black_is_black():
    c = torch.tensor([[-1.0, -1e-9, -1e30]], requires_grad=True)
    log_gain = torch.full((3,), 0.5, requires_grad=True)
    shown = expose(c, log_gain)
    shown.sum().backward()
    assert (shown == 0).all() and c.grad is not None and (c.grad == 0).all()
    assert log_gain.grad is not None and (log_gain.grad == 0).all()


@pytest.mark.parametrize("log_gain", [-1e30, -30.0, -16.0, -1.0, 0.0, 1.0, 16.0, 30.0, 1e30])
def test_exposing_stays_finite(log_gain: float):
    c = torch.tensor(EXTREMES)[:, None].repeat(1, 3).requires_grad_()
    g = torch.full((len(c), 3), log_gain, requires_grad=True)
    shown = expose(c, g)
    shown.sum().backward()
    by_hand = expose_backward(c.detach(), g.detach(), torch.ones(len(c), 3))
    for values in (shown, c.grad, g.grad, *by_hand):
        assert values is not None and torch.isfinite(values).all()
    assert (shown.diff(dim=0) >= 0).all()


def test_gradients_are_those_of_finite_differences():
    c, g = colours(40), gain(-0.6, 0.2, 0.9) * torch.linspace(-1, 1, 40, dtype=torch.float64)[:, None]
    on_one_side = ((c - LINEAR_THRESHOLD).abs() > 1e-4) & ((expose(c, g) - LINEAR_THRESHOLD).abs() > 1e-4)
    rows = on_one_side.all(-1)
    assert rows.sum() > 20
    c, g = c[rows].requires_grad_(), g[rows].requires_grad_()
    assert torch.autograd.gradcheck(expose, (c, g), eps=1e-7)
    with pytest.raises(RuntimeError, match="mismatch"):  # the check can fail
        torch.autograd.gradcheck(lambda c, g: expose(c.detach(), g) + 0 * c, (c, g), eps=1e-7)


@pytest.mark.parametrize("shape", [(3,), (1, 3), (500, 3)])
def test_gradients_by_hand_are_autograds(shape: tuple[int, ...]):
    c = torch.cat([colours(496), torch.tensor([[0.0] * 3, [-1.0] * 3, [1e-12] * 3, [50.0] * 3])]).requires_grad_()
    random = torch.Generator().manual_seed(3)
    g = (4 * torch.rand(shape, generator=random, dtype=torch.float64) - 2).requires_grad_()
    grad = torch.randn(500, 3, generator=random, dtype=torch.float64)
    expose(c, g).backward(grad)
    by_hand = expose_backward(c.detach(), g.detach(), grad)
    torch.testing.assert_close(by_hand, (c.grad, g.grad), atol=1e-12, rtol=1e-9)
    for value in by_hand:
        assert value.abs().max() > 0


def photo_of(c: Tensor, log_gain: Tensor, noise: float) -> Tensor:
    """8 bits, clipped, with noise in sRGB."""
    random = torch.Generator().manual_seed(7)
    shown = expose(c, log_gain) + noise * torch.randn(c.shape, generator=random, dtype=torch.float64)
    return (shown.clamp(0, 1) * 255).round() / 255


TRUE = [(0.0, 0.0, 0.0), (0.7, 0.6, 0.4), (-0.7, -0.9, -0.3), (1.4, 1.2, 1.5), (-1.4, -1.5, -1.3)]


@pytest.mark.parametrize("logs", TRUE)
def test_a_gain_is_found_again_in_noise(logs: tuple[float, ...]):
    c = colours(4000, brightest=0.9)
    found = fit_log_gain(c, photo_of(c, gain(*logs), 0.02))
    torch.testing.assert_close(found, gain(*logs), atol=0.01, rtol=0)


@pytest.mark.parametrize("logs", TRUE)
def test_a_gain_is_found_again_behind_passers_by(logs: tuple[float, ...]):
    c = colours(4000, brightest=0.9)
    photo = photo_of(c, gain(*logs), 0.02)
    photo[::8] = torch.tensor([0.9, 0.1, 0.5], dtype=torch.float64)
    torch.testing.assert_close(fit_log_gain(c, photo), gain(*logs), atol=0.015, rtol=0)


def test_saturated_pixels_do_not_pull():
    c = colours(4000, brightest=1.0)
    photo = photo_of(c, gain(1.2), 0.01)
    assert 0.2 < (photo == 1).double().mean() < 0.7
    torch.testing.assert_close(fit_log_gain(c, photo), gain(1.2), atol=0.02, rtol=0)


@pytest.mark.parametrize("logs", TRUE)
def test_the_fit_minimises_the_error_that_is_judged(logs: tuple[float, ...]):
    """A blurred rendering: its errors are no noise, and there are no outliers to speak of."""
    c = colours(4000, brightest=0.9)
    photo = photo_of(0.8 * c + 0.1, gain(*logs), 0.01)

    def errors(log_gain: Tensor) -> Tensor:
        return (expose(c, log_gain).clamp(max=1) - photo).square().mean(0)

    around = torch.stack([errors(gain(float(g))) for g in torch.linspace(-3, 3, 301)])
    found = errors(fit_log_gain(c, photo))
    assert (found < 1.01 * around.amin(0)).all()
    assert (around.amax(0) > 5 * around.amin(0)).all()


@pytest.mark.parametrize("shown", [0.0, 1e-9, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("truth", [0.0, 0.01, 0.3, 1.0])
def test_flat_pictures_have_finite_gains_that_fit(shown: float, truth: float):
    flat = torch.full((100, 3), shown)
    found = fit_log_gain(flat, torch.full((100, 3), truth))
    assert torch.isfinite(found).all()
    if shown <= exposure.MIN_VALUE:
        assert (found == 0).all()
    else:
        assert (expose(flat, found).clamp(max=1) - truth).abs().max() < 1 / 255


def test_no_pixels_ask_for_no_gain():
    assert torch.equal(fit_log_gain(torch.zeros(0, 3), torch.zeros(0, 3)), torch.zeros(3))


def test_a_fit_looks_at_many_pixels_and_not_at_all(monkeypatch: pytest.MonkeyPatch):
    c = colours(4000, brightest=0.9)
    photo = photo_of(c, gain(0.5), 0.02)
    monkeypatch.setattr(exposure, "MAX_PIXELS", 500)
    few = fit_log_gain(c, photo)
    assert not torch.equal(few, c.new_zeros(3)) and (few - gain(0.5)).abs().max() < 0.03


class Fog:
    """The same half-transparent colour wherever one looks."""

    chunk_rays = 77

    def density(self, points: Tensor) -> Tensor:
        return points[..., 0]

    def density_and_colour(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        return self.density(points), 0.5 + 0 * points

    def render(self, rays: Rays, background: Tensor) -> Rendering:
        opacity = rays.far
        own = opacity[:, None] * self.density_and_colour(rays.origins, rays.directions)[1]
        return Rendering(own + (1 - opacity[:, None]) * background, rays.far, opacity)


def fog_rays() -> Rays:
    return Rays(torch.zeros(5, 3), torch.zeros(5, 3), torch.zeros(5), torch.linspace(0, 1, 5))


def test_exposure_scales_the_scene_and_not_the_background():
    log_gain = torch.tensor([0.5, 0.0, -0.5])
    model = AppearanceModel(Fog(), (ExposureModel(log_gain[None]),))
    assert isinstance(model, RadianceModel) and model.chunk_rays == 77
    points = torch.rand(4, 3)
    assert torch.equal(model.density(points), points[..., 0])
    density, colour = model.density_and_colour(points, points)
    assert torch.equal(density, points[..., 0])
    torch.testing.assert_close(colour, expose(torch.full((4, 3), 0.5), log_gain))
    background = torch.tensor([0.2, 1.0, 0.4])
    seen, plain = model.render(fog_rays(), background), Fog().render(fog_rays(), background)
    torch.testing.assert_close(seen.colour[0], background)
    torch.testing.assert_close(seen.colour[-1], colour[0])
    light = foreground_radiance(plain.colour, plain.opacity, background)
    torch.testing.assert_close(seen.colour, expose(light, log_gain) + plain.colour - light)
    assert torch.equal(seen.depth, plain.depth) and torch.equal(seen.opacity, plain.opacity)


def test_zero_gain_is_the_model_bit_for_bit():
    background = torch.tensor([0.2, 0.9, 0.4])
    seen = AppearanceModel(Fog(), (ExposureModel(torch.zeros(1, 3)),)).render(fog_rays(), background)
    assert all(torch.equal(*pair) for pair in zip(seen, Fog().render(fog_rays(), background), strict=True))
