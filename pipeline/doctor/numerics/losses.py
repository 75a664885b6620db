"""Cases of what training minimises and what quality is told in: errors of colours, distortion, depth loss, PSNR."""

from typing import Any

import torch
from torch import Tensor

from nerf.kernels import Backend, RayStepping, Samples
from nerf.training.colour_loss import HUBER_DELTA, huber_loss
from nerf.training.psnr import PSNR_LIMIT, psnr
from pipeline.doctor.numerics import Bound, Case
from pipeline.doctor.numerics.light import N, light, packed
from pipeline.doctor.numerics.space import decades

EVEN, GROWING = RayStepping(0.05, 0.0, False, 8, 100), RayStepping(0.05, 0.2, True, 8, 100)
FAR = 1000.0


def _far_out(like: Tensor, stepping: RayStepping) -> Samples:
    """Packed samples far from the camera, in steps of 0.2 to 2 % of their distance, as ray steps are: around 3
    where steps do not grow, around 768 where they do. float32 and float64 share their places."""
    samples, distance = packed(like), 768.0 if stepping.cone_angle else 3.0
    return samples._replace(t=distance * (1 + samples.t / 64), dt=distance / 64 * samples.dt)


def _distortion(stepping: RayStepping) -> dict[str, Any]:
    def reference(weights: Tensor) -> Tensor:
        t, lengths = (part[:N] for part in _far_out(weights, stepping)[2:])
        m = 1 + torch.log(t / stepping.linear_until) if stepping.cone_angle else t
        lengths = lengths / t if stepping.cone_angle else lengths
        pairs = weights[:, :, None] * weights[:, None] * (m[:, None] - m).abs()
        return (pairs.sum((1, 2)) + (weights.square() * lengths).sum(1) / 3)[:, None]

    def function(backend: Backend, weights: Tensor) -> Tensor:
        return backend.distortion(_far_out(weights, stepping), weights.reshape(-1), stepping)[:, None]

    def backward(backend: Backend, grad: Tensor, weights: Tensor) -> tuple[Tensor]:
        flat = weights.reshape(-1)
        return (backend.distortion_backward(_far_out(weights, stepping), flat, stepping, grad[:, 0]).view(-1, N),)

    return {"function": function, "reference": reference, "backward": backward, "differentiable": 1, "kernels": True}


def _weights() -> tuple[Tensor]:
    return (light(decades(1, -4, 2, 256, N))[0],)


def _hard_weights() -> tuple[Tensor]:
    """All in one interval or in two neighbours, at the end of the ray too; tiny ones; equal ones."""
    pairs = (torch.eye(N) + torch.eye(N).roll(1, 0)) / 2
    return (torch.cat([torch.eye(N), pairs, torch.full((1, N), 1e-4), torch.full((1, N), 1 / N)]),)


def _point_distances(like: Tensor) -> Tensor:
    """Where each ray's sparse point is: around the samples of the first, before and far behind those of others."""
    return torch.tensor([770.0, 780.0, 1.0, 1e-38, 5000.0, 1e30]).to(like).repeat(len(like) // 6 + 1)[: len(like)]


def _depth_loss(backend: Backend, weights: Tensor) -> Tensor:
    samples, opacity = _far_out(weights, GROWING), weights.sum(-1)
    far = torch.full_like(opacity, FAR)
    return backend.depth_loss(samples, weights.reshape(-1), opacity, far, _point_distances(far), GROWING)[:, None]


def _depth_loss_backward(backend: Backend, grad: Tensor, weights: Tensor) -> tuple[Tensor]:
    far = torch.full_like(grad[:, 0], FAR)
    places = _far_out(weights, GROWING), far, _point_distances(far), GROWING
    of_weights, of_opacity = backend.depth_loss_backward(*places, grad[:, 0].contiguous())
    return (of_weights.view(-1, N) + of_opacity[:, None],)


def _depth_loss_plainly(weights: Tensor) -> Tensor:
    def m(t: Tensor) -> Tensor:
        return torch.where(t < GROWING.linear_until, t / GROWING.linear_until, 1 + torch.log(t / GROWING.linear_until))

    t, point = _far_out(weights, GROWING).t[:N].to(weights), m(_point_distances(weights[:, 0]))[:, None]
    ends = torch.cat([t, t.new_tensor([FAR])])
    all_light = torch.cat([weights, 1 - weights.sum(-1, keepdim=True)], -1)
    return (all_light * (m(ends) - point).abs()).sum(-1, keepdim=True)


def _huber(error: Tensor) -> Tensor:
    size = error.abs()
    return torch.where(size <= HUBER_DELTA, size.square(), 2 * HUBER_DELTA * size - HUBER_DELTA**2)


def _psnrs(_: Backend, error: Tensor) -> Tensor:
    return torch.tensor([[psnr(float(each))] for each in error[:, 0]], dtype=torch.float64)


CASES = [
    Case(
        formula="distortion ΣΣ w_i w_j |m_i − m_j| + ⅓ Σ w² l",
        where="nerf/kernels/torch/distortion_loss.py: distortion, distortion_backward",
        typical=_weights,
        extreme=_hard_weights,
        value=Bound(5e-7, "itself"),
        gradient=Bound(5e-7, "row"),
        **_distortion(EVEN),
    ),
    Case(
        formula="distortion where steps grow, m = log t",
        where="nerf/kernels/torch/distortion_loss.py: distortion, distortion_backward",
        typical=_weights,
        extreme=_hard_weights,
        value=Bound(1e-6, "itself"),
        gradient=Bound(5e-7, "row"),
        **_distortion(GROWING),
    ),
    Case(
        formula="depth loss Σ w_i |m(t_i) − m(d)| + U |m(far) − m(d)|",
        where="nerf/kernels/torch/depth_loss.py: depth_loss, depth_loss_backward",
        typical=_weights,
        extreme=_hard_weights,
        function=_depth_loss,
        reference=_depth_loss_plainly,
        backward=_depth_loss_backward,
        differentiable=1,
        kernels=True,
        value=Bound(3e-5, "one"),
        gradient=Bound(3e-5, "one"),
    ),
    Case(
        formula="colour loss e², 2 d |e| − d² where |e| > d",
        where="nerf/training/colour_loss.py: huber_loss",
        typical=lambda: (decades(1, -6, 0, 256, 1),),
        extreme=lambda: (torch.tensor([[0.0], [0.1], [-0.1], [0.1000001], [-0.0999999], [1e30], [-1e30]]),),
        function=lambda _, error: huber_loss(error)[0],
        reference=_huber,
        backward=lambda _, grad, error: (2 * grad * huber_loss(error)[1],),
        differentiable=1,
        value=Bound(5e-7, "itself"),
        gradient=Bound(5e-7, "itself"),
    ),
    Case(
        formula="PSNR −10 log₁₀ MSE",
        where="nerf/training/psnr.py: psnr",
        typical=lambda: (decades(1, -9, 0, 256, 1),),
        extreme=lambda: (torch.tensor([[0.0], [1e-38], [1e-10], [0.999], [1e30]]),),
        function=_psnrs,
        reference=lambda error: torch.where(error > 1e-10, -10 * torch.log10(error), PSNR_LIMIT).cpu(),
        value=Bound(1e-15, "itself"),
    ),
]
