"""Laws of vignetting, its gradients by hand, extremes, its gauge, and what held-out images, new views and files get."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf.effects import ColourEffect, HeldOutImages, ImageEffects, Images, RenderedRays
from nerf.effects.exposure import expose
from nerf.effects.statistics.vignetting import log_falloff
from nerf.effects.vignetting import MEAN_TERMS, UNKNOWN_CORNER, VignettingModel, falloff_terms
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays

CORNER = 30.0  # degrees from the axis
CORNER_U = math.sin(math.radians(CORNER) / 2) ** 2
PER_CORNER = torch.full((21, 1), 1 / (4 * CORNER_U)).double()
FALLOFF = torch.tensor([[0.3, 0.2, 0.1], [0.0, 0.0, 0.7]], dtype=torch.float64)
ROWS = torch.cat([torch.full((2, 1), 0.7).double(), FALLOFF], dim=1)
VIEW = torch.tensor([0, 2, 1, 0, 1])


def squared_chord(degrees: float) -> float:
    return 4 * math.sin(math.radians(degrees) / 2) ** 2


def images(*camera: int, corner: float = CORNER) -> Images:
    """Cameras that look along z; ``corner`` in degrees."""
    count = len(camera)
    poses = torch.cat([torch.eye(3).repeat(count, 1, 1), torch.zeros(count, 3, 1)], dim=2).double()
    return Images(poses, torch.tensor(camera), torch.full((count,), squared_chord(corner), dtype=torch.float64))


def rays_at(*degrees: float) -> Rays:
    """At these angles to the axis."""
    angle = torch.tensor(degrees).double().deg2rad()
    directions = torch.stack([angle.sin(), 0 * angle, angle.cos()], dim=1)
    return Rays(0 * directions, directions, 0 * angle, 0 * angle + 1)


def of_two_cameras() -> VignettingModel:
    """The first image by one, two by the other."""
    return VignettingModel.restored(images(0, 1, 1), ROWS[[0, 1, 1]])


def grey(count: int, level: float = 0.3) -> Tensor:
    return torch.full((count, 3), level, dtype=torch.float64)


@pytest.mark.parametrize("camera", [0, 1])
def test_light_falls_from_the_axis_to_the_corner(camera: int) -> None:
    effect: ColourEffect = of_two_cameras()
    assert isinstance(effect, ColourEffect)
    view = torch.full((61,), camera)
    shown = effect.forward(grey(61), rays_at(*range(61)), view)
    torch.testing.assert_close(shown[0], expose(grey(1)[0], torch.full((3,), 0.7).double()))
    assert (shown[:31].diff(dim=0) < 0).all()
    at_corner = float(0.7 - FALLOFF[camera].sum())
    torch.testing.assert_close(shown[30], expose(grey(1)[0], torch.full((3,), at_corner).double()))
    assert (shown[31:] == shown[31]).all(), "what no pixel sees is as dark as the corner"


def test_the_curve_that_is_drawn_is_that_which_is_learnt() -> None:
    u = torch.linspace(0, 1, 21).double()
    directions = torch.stack([(u * (1 - u * CORNER_U)).sqrt(), 0 * u, 1 - 2 * u * CORNER_U], dim=1)
    directions[:, 0] *= 2 * math.sqrt(CORNER_U)
    learnt = falloff_terms(directions, torch.tensor([[0.0, 0, 1]]).double().expand(21, 3), PER_CORNER) @ FALLOFF[0]
    np.testing.assert_allclose(log_falloff(u.numpy(), FALLOFF[0].numpy()), learnt.numpy(), atol=1e-12)
    assert 0 == float(learnt[0]) < float(learnt[-1])


def test_gradients_by_hand_are_the_derivative() -> None:
    effect, rays = of_two_cameras(), rays_at(0.0, 10.0, 20.0, 25.0, 29.0)
    colour = torch.linspace(0.02, 0.9, 15, dtype=torch.float64).view(5, 3).requires_grad_()
    effect.falloff.requires_grad_()

    def shown(colour: Tensor, _falloff: Tensor) -> Tensor:
        return effect.forward(colour, rays, VIEW)

    assert torch.autograd.gradcheck(shown, (colour, effect.falloff))
    grad = torch.linspace(-1, 1, 15, dtype=torch.float64).view(5, 3)
    expected = torch.autograd.grad((shown(colour, effect.falloff) * grad).sum(), [colour, effect.falloff])
    with torch.no_grad():
        by_hand, learnt = effect.backward(colour.detach(), rays, VIEW, grad)
    torch.testing.assert_close([by_hand, learnt["falloff"]], list(expected))


@pytest.mark.parametrize("falloff", [0.0, 1e-30, 1.0, 1e30])
@pytest.mark.parametrize("corner", [0.0, 1e-6, 30.0, 90.0, 180.0])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_extremes_are_finite(falloff: float, corner: float, kind: torch.dtype) -> None:
    """Cameras of one pixel, of the whole sphere, rays behind the camera; colours from nothing to 1e30."""
    near = images(0, corner=corner)
    near = Images(near.scene_from_camera.to(kind), near.camera, near.corner.to(kind))
    effect = VignettingModel(near, torch.full((1, 3), falloff, dtype=kind), torch.zeros(1, 1, dtype=kind))
    rays = rays_at(0.0, 1e-6, 30.0, 90.0, 180.0).each(lambda part: part.to(kind))
    view = torch.zeros(5, dtype=torch.int64)
    for level in (0.0, 1e-30, 0.5, 1e30):
        colour = torch.full((5, 3), level, dtype=kind)
        assert effect.forward(colour, rays, view).isfinite().all()
        of_colour, learnt = effect.backward(colour, rays, view, torch.ones_like(colour))
        assert of_colour.isfinite().all() and learnt["falloff"].isfinite().all()


def test_an_image_of_one_pixel_has_no_corner() -> None:
    effect = VignettingModel.restored(images(0, corner=0.0), ROWS[:1])
    shown = effect.forward(grey(2), rays_at(0.0, 1.0), torch.zeros(2, dtype=torch.int64))
    torch.testing.assert_close(shown, expose(grey(2), torch.full((2, 3), 0.7).double()))


def test_the_darkest_corner_begins_as_one() -> None:
    effect = VignettingModel.initial(images(0, 1, 1), FALLOFF[[0, 1, 1]])
    assert effect.rows[:, 0].tolist() == pytest.approx([0.7] * 3)
    corner = effect.forward(grey(1), rays_at(CORNER), torch.tensor([1]))
    torch.testing.assert_close(corner, grey(1))
    unknown = VignettingModel.initial(images(0, 1), None)
    assert unknown.rows.tolist() == [pytest.approx([UNKNOWN_CORNER, 0, 0, 0])] * 2


def test_the_mean_gain_over_an_image_does_not_move() -> None:
    """What is learnt is no exposure: over a grid of pixels of 4 : 3 the log gain keeps its mean to a hundredth."""
    x, y = torch.meshgrid(*(torch.linspace(-n, n, 41).double() for n in (0.08, 0.06)), indexing="ij")
    directions = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1).view(-1, 3), dim=-1)
    rays = Rays(0 * directions, directions, directions[:, 0], directions[:, 0])
    corner = math.degrees(math.atan(0.1))
    effect, view = VignettingModel.initial(images(0, corner=corner), FALLOFF[:1]), torch.zeros(41 * 41).long()

    def mean_log_gain() -> float:
        light = effect.forward(grey(1, 0.5).expand(len(directions), 3), rays, view)[:, 0]
        return float(((light + 0.055) / 0.555).log().mean()) * 2.4

    before = mean_log_gain()
    effect.falloff += torch.tensor([[0.5, 0.1, 0.4]])
    assert abs(mean_log_gain() - before) < 0.02 < abs(before), MEAN_TERMS


def test_the_gauge_lets_no_gain_rise() -> None:
    effect = of_two_cameras()
    effect.falloff -= 0.25
    effect.fix_gauge()
    assert (effect.falloff >= 0).all() and effect.falloff.max() > 0


def test_saturated_pixels_do_not_pull() -> None:
    """The middle would be brighter than an image can show: its coefficients are told by the other pixels alone."""
    effects = ImageEffects(colours=(of_two_cameras(),))
    rays, view = rays_at(0.0, 20.0), torch.tensor([0, 0])
    rendering = Rendering(grey(2, 0.95), torch.zeros(2).double(), torch.ones(2).double())
    seen = RenderedRays(rendering, torch.zeros(3).double(), rays, view)
    residual = effects.residual(seen, grey(2, 1.0))
    assert (residual == 0).all()
    _, learnt = effects.backward_residual(seen, residual)
    assert (learnt["vignetting.falloff"] == 0).all()


def test_held_out_images_have_their_cameras_vignetting() -> None:
    weights = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.25, 0.25]]).double()
    expected = of_two_cameras().of_held_out(HeldOutImages(images(1, 2), weights)).rows
    torch.testing.assert_close(expected[0], ROWS[1])
    torch.testing.assert_close(expected[1], ROWS.mean(0), msg="an unknown camera: as its neighbours")


def test_rows_of_files_make_it_again() -> None:
    effect = of_two_cameras()
    again = VignettingModel.restored(images(0, 1, 1), effect.rows)
    torch.testing.assert_close([again.falloff, again.mean_log_gain], [effect.falloff, effect.mean_log_gain])
    assert VignettingModel.row_length == effect.rows.shape[1]


def test_new_views_are_as_bright_as_the_middle_everywhere() -> None:
    effect = VignettingModel.of_new_view(of_two_cameras().rows)
    shown = effect.forward(grey(3), rays_at(0.0, 30.0, 180.0), torch.zeros(3, dtype=torch.int64))
    torch.testing.assert_close(shown, expose(grey(3), torch.full((3, 3), 0.7).double()))
    assert VignettingModel.new_view_words(ROWS) == "without vignetting of 1.01 EV at the corners"


def test_what_a_photo_shows_leads_back_to_the_scene() -> None:
    effect, rays, view = of_two_cameras(), rays_at(0, 10, 20, 30), torch.tensor([0, 1, 2, 0])
    shown = effect.forward(grey(4), rays, view)
    assert float(shown.diff(dim=0).abs().max()) > 0.05
    torch.testing.assert_close(effect.inverse(shown, rays, view), grey(4))
