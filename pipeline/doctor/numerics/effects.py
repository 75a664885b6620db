"""Cases of what stands between a field and an image: vignetting, and the gain that it is."""

import math

import torch
from torch import Tensor

from nerf.effects import Images
from nerf.effects.vignetting import MEAN_TERMS, VignettingModel
from nerf.geometry.rays import Rays
from nerf.kernels import Backend
from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from pipeline.doctor.numerics import Bound, Case
from pipeline.doctor.numerics.space import decades, uniform

CORNER = math.radians(40.0)


def _vignetting(falloff: Tensor) -> VignettingModel:
    """Every row of ``falloff`` a camera of one image, which looks along z; the mean gain over an image is one."""
    count = len(falloff)
    poses = torch.eye(4).to(falloff)[:3].repeat(count, 1, 1)
    corner = falloff.new_full((count,), 4 * math.sin(CORNER / 2) ** 2)
    numbers = torch.arange(count, device=falloff.device)
    return VignettingModel(Images(poses, numbers, corner), falloff, falloff.new_zeros(count, 1))


def _rays(directions: Tensor) -> Rays:
    return Rays(0 * directions, directions, directions[:, 0], directions[:, 0])


def _shown(_: Backend, colour: Tensor, falloff: Tensor, directions: Tensor) -> Tensor:
    effect = _vignetting(falloff)
    return effect.forward(colour, _rays(directions), effect.camera)


def _shown_backward(
    _: Backend, grad: Tensor, colour: Tensor, falloff: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    effect = _vignetting(falloff)
    of_colour, learnt = effect.backward(colour, _rays(directions), effect.camera, grad)
    return of_colour, learnt["falloff"]


def _shown_plainly(colour: Tensor, falloff: Tensor, directions: Tensor) -> Tensor:
    angle = torch.atan2(directions[:, :2].norm(dim=1), directions[:, 2])
    u = (torch.sin(angle / 2) ** 2 / math.sin(CORNER / 2) ** 2).clamp(max=1)[:, None]
    terms = torch.cat([1 - (1 - u) ** 3, 3 * u**2 - 2 * u**3, u**3], dim=1)
    log_gain = (falloff * (falloff.new_tensor(MEAN_TERMS) - terms)).sum(1, keepdim=True)
    return linear_to_srgb(log_gain.exp() * srgb_to_linear(colour))


def _towards(*degrees: float) -> Tensor:
    angle = torch.tensor(degrees).deg2rad()
    return torch.stack([0.6 * angle.sin(), 0.8 * angle.sin(), angle.cos()], dim=1)


def _hard_vignetting() -> tuple[Tensor, Tensor, Tensor]:
    """At the axis and beside it, at the corner, beyond it, behind; black to 1e10; no falloff and 23 stops."""
    away = _towards(0.0, 1e-4, 1e-2, 40.0, 90.0, 180.0)
    colour = torch.tensor([0.0, 1e-38, 1e-4, 0.04, 1.0, 1e10])[:, None].expand(6, 3)
    falloff = torch.tensor([[0.0, 0, 0], [1e-38, 1e-30, 0], [5.0, 5, 5], [0.3, 0.2, 0.1], [0, 16, 0], [1, 0, 1]])
    return colour.repeat(6, 1), falloff.repeat_interleave(6, 0), away.repeat(6, 1).roll(1, 0)


CASES = [
    Case(
        formula="vignetting s(exp(mean p − p(u)) s⁻¹(c))",
        where="nerf/effects/vignetting.py: forward, backward, falloff_terms",
        typical=lambda: (
            decades(1, -3, 0, 256, 3),
            uniform(2, 0, 0.5, 256, 3),
            _towards(*uniform(3, 0, 40, 256).tolist()),
        ),
        extreme=_hard_vignetting,
        function=_shown,
        reference=_shown_plainly,
        backward=_shown_backward,
        differentiable=2,
        value=Bound(2e-5, "row"),
        gradient=Bound(3e-5, "row"),
    ),
]
