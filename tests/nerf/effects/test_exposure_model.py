import math

import pytest
import torch

from nerf.effects import NO_EFFECTS, ColourEffect, ImageEffects, Images, RayEffect, RenderedRays
from nerf.effects.exposure import ExposureModel, expose
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays

VIEW = torch.tensor([0, 2, 2, 1])
GAINS = torch.tensor([[0.5, 0.0, -0.2], [0.0, 0.3, 0.1], [-0.4, 0.1, 0.2]], dtype=torch.float64)
BACKGROUND = torch.tensor([0.9, 0.2, 0.4], dtype=torch.float64)


def exposed(log_gain: torch.Tensor) -> ImageEffects:
    return ImageEffects(colours=(ExposureModel(log_gain),))


def any_rays(like: torch.Tensor) -> Rays:
    """As many rays as ``like`` has numbers; an exposure does not look at them."""
    return Rays(like[:, None].repeat(1, 3), like[:, None].repeat(1, 3), like, like)


def seen(colour: torch.Tensor | None = None, opacity: torch.Tensor | None = None) -> RenderedRays:
    random = torch.Generator().manual_seed(0)
    full = torch.rand(4, dtype=torch.float64, generator=random) if opacity is None else opacity
    own = full[:, None] * (0.1 + 0.6 * torch.rand(4, 3, dtype=torch.float64, generator=random))
    if colour is None:
        colour = own + (1 - full)[:, None] * BACKGROUND
    return RenderedRays(Rendering(colour, torch.zeros_like(full), full), BACKGROUND, any_rays(full), VIEW)


def test_every_effect_keeps_the_contract() -> None:
    colours: ColourEffect = ExposureModel(GAINS)
    rays: RayEffect = PoseRefinement(torch.zeros(3, 3))
    assert isinstance(colours, ColourEffect) and isinstance(rays, RayEffect)
    names = {"exposure.log_gain", "pose_refinement.turn", "pose_refinement.offset"}
    assert set(ImageEffects((rays,), (colours,)).parameters) == names and not NO_EFFECTS.parameters


def test_gains_of_one_show_what_is_rendered() -> None:
    target = torch.rand(4, 3, dtype=torch.float64)
    plain = NO_EFFECTS.residual(seen(), target)
    torch.testing.assert_close(exposed(0 * GAINS).residual(seen(), target), plain, rtol=0, atol=1e-15)


def test_the_gain_is_of_the_scenes_own_light() -> None:
    nothing = seen(BACKGROUND.expand(4, 3), torch.zeros(4, dtype=torch.float64))
    torch.testing.assert_close(exposed(GAINS).residual(nothing, BACKGROUND.expand(4, 3)), torch.zeros(4, 3).double())
    opaque = seen(opacity=torch.ones(4, dtype=torch.float64))
    expected = expose(opaque.rendering.colour, GAINS[VIEW])
    torch.testing.assert_close(exposed(GAINS).residual(opaque, torch.zeros(4, 3).double()), expected)


def test_backward_is_the_derivative_of_the_residual() -> None:
    target, part = torch.zeros(4, 3, dtype=torch.float64), exposed(GAINS)
    grad = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    given = seen()
    rendering, of_gain = part.backward_residual(given, grad)
    colour, opacity = (x.clone().requires_grad_() for x in (given.rendering.colour, given.rendering.opacity))
    gains = part.parameters["exposure.log_gain"].requires_grad_()
    residual = part.residual(given._replace(rendering=Rendering(colour, given.rendering.depth, opacity)), target)
    expected = torch.autograd.grad((residual * grad).sum(), [colour, opacity, gains])
    torch.testing.assert_close([rendering.colour, rendering.opacity, of_gain["exposure.log_gain"]], list(expected))


def test_a_full_pixel_asks_for_no_more_than_being_full() -> None:
    bright = seen(torch.full((4, 3), 0.95, dtype=torch.float64), torch.ones(4, dtype=torch.float64))
    part = exposed(torch.full((3, 3), math.log(2), dtype=torch.float64))
    for full in (252, 255):  # of 255, in the precision of training, too
        assert (part.residual(bright, torch.full((4, 3), full / 255).double()) == 0).all()
        single = seen(torch.full((4, 3), 0.95), torch.ones(4))._replace(background=BACKGROUND.float())
        brighter = exposed(torch.full((3, 3), math.log(2)))
        assert (brighter.residual(single, torch.full((4, 3), full, dtype=torch.uint8) / 255) == 0).all()
    for within in (251 / 255, 0.9):
        assert (part.residual(bright, torch.full((4, 3), within).double()) > 0.1).all(), (
            "too bright where the photo is not full"
        )


@pytest.mark.parametrize("log_gain", [-1e30, -16.0, -1e-30, 0.0, 1e-30, 16.0, 1e30])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_extremes_are_finite_in_value_and_gradient(log_gain: float, kind: torch.dtype) -> None:
    """Colours of nothing to 1e30 before every opacity, shown by photos of every gain, black and full."""
    colours, opacities = torch.tensor([0.0, 1e-30, 0.04, 1.0, 1e12, 1e30]), torch.tensor([0.0, 1e-7, 1.0])
    colour, opacity = (part.flatten().to(kind) for part in torch.meshgrid(colours, opacities, indexing="ij"))
    rendering = Rendering(colour[:, None].repeat(1, 3), 0 * opacity, opacity)
    view = torch.zeros(len(colour), dtype=torch.int64)
    given = RenderedRays(rendering, BACKGROUND.to(kind), any_rays(opacity), view)
    part = exposed(torch.full((1, 3), log_gain, dtype=kind))
    for target in (0.0, 1.0):
        residual = part.residual(given, torch.full_like(rendering.colour, target))
        assert residual.isfinite().all() and residual.abs().max() > 0.1
        of_rendering, of_parameters = part.backward_residual(given, residual.clamp(-0.1, 0.1))  # as robust errors pull
        assert all(each.isfinite().all() for each in (*of_rendering, *of_parameters.values()))
        assert of_rendering.colour.abs().max() > 0


def test_the_mean_gain_is_kept_by_the_gauge() -> None:
    part = ExposureModel.initial(Images(torch.zeros(3, 3, 4), VIEW[:3], torch.ones(3)), GAINS)
    assert torch.equal(part.log_gain.amin(0), torch.zeros(3).double())
    torch.testing.assert_close(part.log_gain - part.log_gain[:1], GAINS - GAINS[:1])
    before = part.log_gain.mean(0).clone()
    part.log_gain += torch.tensor([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0.3]])
    part.fix_gauge()
    torch.testing.assert_close(part.log_gain.mean(0), before)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_reference_exposure_is_that_of_a_usual_photo(count: int) -> None:
    gains = torch.linspace(0, 1, count)[:, None].repeat(1, 3)
    (reference,) = ExposureModel.of_new_view(gains).rows
    assert (gains.min(0).values <= reference).all() and (reference <= gains.max(0).values).all()
    assert abs(float(reference[0]) - 0.5) <= 0.5 / max(1, count - 1) + (count == 1) * 0.5


def test_what_a_photo_shows_leads_back_to_the_scene() -> None:
    colour = 0.05 + 0.8 * torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    effect, rays = ExposureModel(GAINS), any_rays(torch.zeros(4, dtype=torch.float64))
    shown = effect.forward(colour, rays, VIEW)
    assert (shown - colour).abs().max() > 0.05
    torch.testing.assert_close(effect.inverse(shown, rays, VIEW), colour)
