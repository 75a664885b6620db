"""Several effects of rays and of colours in order: forward, backward by hand, gauge and held-out images."""

import torch
from torch import Tensor

from nerf.effects import HeldOutImages, ImageEffects, Images, RayGradients, RenderedRays
from nerf.effects.exposure import ExposureModel, expose
from nerf.effects.pose_refinement import PoseRefinement
from nerf.effects.vignetting import VignettingModel, falloff_terms
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays

VIEW = torch.tensor([0, 2, 2, 1, 0])
BACKGROUND = torch.tensor([0.9, 0.2, 0.4], dtype=torch.float64)


def drawn(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rays() -> Rays:
    directions = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.4 * drawn(1, 5, 3), dim=-1)
    return Rays(drawn(2, 5, 3), directions, torch.ones(5).double(), torch.full((5,), 5.0).double())


def images() -> Images:
    """The first by one camera, the others by another one."""
    poses = torch.cat([torch.eye(3).repeat(3, 1, 1), drawn(3, 3, 3, 1)], dim=2).double()
    return Images(poses, torch.tensor([0, 1, 1]), torch.full((3,), 0.8).double())


def colours() -> ImageEffects:
    """A gain per photo, then the vignetting of its camera."""
    vignetting = VignettingModel(images(), 0.3 * drawn(4, 2, 3).abs(), 0.2 * drawn(14, 2, 1))
    return ImageEffects(colours=(ExposureModel(0.4 * drawn(5, 3, 3)), vignetting))


def refined(*seeds: int) -> ImageEffects:
    """So many corrections of every pose, one after the other."""
    effects = []
    for seed in seeds:
        pose = PoseRefinement(drawn(6, 3, 3))
        pose.turn += 0.3 * drawn(seed, 3, 3)
        pose.offset += 0.3 * drawn(seed + 1, 3, 3)
        vars(pose)["name"] = f"pose_{seed}"
        effects.append(pose)
    return ImageEffects(tuple(effects))


def rendered(colour: Tensor, opacity: Tensor) -> RenderedRays:
    return RenderedRays(Rendering(colour, torch.zeros_like(opacity), opacity), BACKGROUND, rays(), VIEW)


def test_colour_effects_act_in_order_on_the_scenes_own_radiance() -> None:
    effects, opacity = colours(), torch.tensor([1.0, 0.5, 0.2, 0.9, 0.0]).double()
    own, behind = 0.4 * opacity[:, None].expand(5, 3), (1 - opacity)[:, None] * BACKGROUND
    exposure, vignetting = effects.colours
    gains, rows = exposure.parameters["log_gain"], vignetting.rows[VIEW]
    axis = torch.tensor([[0.0, 0.0, 1.0]]).double().expand(5, 3)
    terms = falloff_terms(rays().directions, axis, torch.full((5, 1), 1 / 0.8).double())
    darker = (rows[:, 1:] * terms).sum(1, keepdim=True)
    shown = expose(expose(own, gains[VIEW]), rows[:, :1] - darker) + behind
    residual = effects.residual(rendered(own + behind, opacity), torch.zeros(5, 3).double())
    torch.testing.assert_close(residual, shown)
    turned_about = ImageEffects(colours=effects.colours[::-1])
    assert not torch.equal(turned_about.parameters["exposure.log_gain"], gains + 1)
    assert list(turned_about.parameters) == ["vignetting.falloff", "exposure.log_gain"]


def test_the_gradient_of_colour_effects_by_hand_is_their_derivative() -> None:
    effects, weights = colours(), drawn(7, 5, 3)
    opacity = torch.tensor([1.0, 0.5, 0.2, 0.9, 0.3]).double()
    colour = 0.3 * opacity[:, None].expand(5, 3) + (1 - opacity)[:, None] * BACKGROUND
    by_hand, learnt = effects.backward_residual(rendered(colour, opacity), weights)

    def residual(*values: Tensor) -> Tensor:
        return effects.residual(rendered(*values[:2]), torch.zeros(5, 3).double())

    leaves = [colour.clone().requires_grad_(), opacity.clone().requires_grad_()]
    leaves += [parameter.requires_grad_() for parameter in effects.parameters.values()]
    assert torch.autograd.gradcheck(residual, leaves)
    expected = torch.autograd.grad((residual(*leaves) * weights).sum(), leaves)
    names = ("exposure.log_gain", "vignetting.falloff")
    found = [by_hand.colour, by_hand.opacity, *(learnt[name] for name in names)]
    torch.testing.assert_close(found, list(expected), rtol=1e-10, atol=1e-12)


def test_the_gradient_of_ray_effects_by_hand_is_their_derivative() -> None:
    """Two corrections one after the other: the first one's gradient runs through the second."""
    effects, weights = refined(8, 10), RayGradients(drawn(12, 5, 3), drawn(13, 5, 3))
    first, second = effects.rays
    of_second = second.backward(first.forward(rays(), VIEW), VIEW, weights)
    of_first = first.backward(rays(), VIEW, second.backward_rays(first.forward(rays(), VIEW), VIEW, weights))
    leaves = [part.requires_grad_() for each in effects.rays for part in each.parameters.values()]
    moved = effects.forward_rays(rays(), VIEW)
    expected = torch.autograd.grad(
        (moved.origins * weights.origins).sum() + (moved.directions * weights.directions).sum(), leaves
    )
    torch.testing.assert_close([*of_first.values(), *of_second.values()], list(expected), rtol=1e-10, atol=1e-12)
    with torch.no_grad():
        composed = effects.backward_rays(rays(), VIEW, lambda: weights)
    names = ("pose_8.turn", "pose_8.offset", "pose_10.turn", "pose_10.offset")
    torch.testing.assert_close([composed[name] for name in names], list(expected), rtol=1e-10, atol=1e-12)


def test_without_ray_effects_no_gradient_of_rays_is_computed() -> None:
    def costly() -> RayGradients:
        raise AssertionError("nobody wants it")

    assert colours().backward_rays(rays(), VIEW, costly) == {}


def test_held_out_images_get_what_each_effect_expects_of_them() -> None:
    weights = torch.tensor([[0.25, 0.75, 0.0]]).double()
    unseen = HeldOutImages(Images(*(part[:1] for part in images()[:3])), weights)
    held_out, trained = colours().of_held_out(unseen), colours()
    exposure, vignetting = (effect.rows for effect in held_out.colours)
    torch.testing.assert_close(exposure, weights @ trained.colours[0].rows)
    torch.testing.assert_close(vignetting, trained.colours[1].rows[:1])
    assert not refined(8).of_held_out(unseen).rays
