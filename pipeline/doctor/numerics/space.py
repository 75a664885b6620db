"""Cases of where things are: encoding, contraction, points on rays, boxes, ray stepping."""

import torch
from torch import Tensor

from nerf.fields.positional_encoding import positional_encoding
from nerf.geometry.rays import Rays, clip_to_box, points_on
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import Contraction, contract, uncontract
from nerf.geometry.space_maps.ndc import MIN_DEPTH, Ndc
from nerf.kernels import Backend, RayStepping, Samples
from nerf.kernels.torch.marching import s_to_t, t_to_s
from pipeline.doctor.numerics import Bound, Case

OCTAVES = 16
CONTRACTED = RayStepping(step_size=0.002, cone_angle=0.008, contracted=True, occupancy_resolution=128, max_samples=1024)
NDC = Ndc((0.25, -2.0, 0.125), ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6)), (0.75, 0.5), 0.75)
NEAREST = MIN_DEPTH * NDC.near
PER_RAY = 4


def uniform(seed: int, low: float | int, high: float | int, *shape: int) -> Tensor:
    """Float32 numbers between ``low`` and ``high``, the same for the same seed."""
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def decades(seed: int, low: float | int, high: float | int, *shape: int) -> Tensor:
    """Positive float32 numbers whose decimal logarithms are uniform between ``low`` and ``high``."""
    return 10 ** uniform(seed, low, high, *shape)


def directions(seed: int, count: int) -> Tensor:
    """Unit vectors."""
    return torch.nn.functional.normalize(uniform(seed, -1, 1, count, 3), dim=-1)


def _encoded(x: Tensor) -> Tensor:
    angles = torch.pi * torch.fmod(x[..., None] * 2.0 ** torch.arange(OCTAVES, device=x.device), 2).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


def _folded(x: Tensor) -> Tensor:
    r = x.abs().amax(-1, keepdim=True)
    return torch.where(r > 1, (2 - 1 / r.clamp(min=1)) * x / r.clamp(min=1), x)


def _unfolded(y: Tensor) -> Tensor:
    m = y.abs().amax(-1, keepdim=True)
    return torch.where(m > 1, y / (m.clamp(min=1) * (2 - m)), y)


def _in_ndc(x: Tensor) -> Tensor:
    """Normalised device coordinates with points before the near plane where a thousandth of its depth would be."""
    right, down, depth = ((x - x.new_tensor(NDC.apex)) @ x.new_tensor(NDC.axes).T).unbind(-1)
    depth = torch.where(depth > NEAREST, depth, NEAREST)
    sideways = (each / depth / slope for each, slope in zip((right, down), NDC.slopes, strict=True))
    return NDC.half * torch.stack([*sideways, 1 - 2 * NDC.near / depth], -1)


def _from_ndc(y: Tensor) -> Tensor:
    x, y, z = (y / NDC.half).unbind(-1)
    depth = 2 * NDC.near / (1 - z)
    local = torch.stack([x * NDC.slopes[0] * depth, y * NDC.slopes[1] * depth, depth], -1)
    return local @ local.new_tensor(NDC.axes) + local.new_tensor(NDC.apex)


def _ndc_rays() -> tuple[Tensor, Tensor, Tensor]:
    """From about the apex forward, to distances of the scene beyond the near plane."""
    towards = torch.nn.functional.normalize(uniform(2, -0.5, 0.5, 256, 3) + torch.tensor(NDC.axes[2]), dim=-1)
    return torch.tensor(NDC.apex) + uniform(1, -0.5, 0.5, 256, 3), towards, decades(3, 0.4, 2, 256, 1)


def _hard_ndc_rays() -> tuple[Tensor, Tensor, Tensor]:
    """Along the axis, parallel to the image plane, from far behind, back to the near plane; to far away."""
    right, _, forward = torch.tensor(NDC.axes)
    apex = torch.tensor(NDC.apex)
    origins = torch.stack([apex, apex + 2 * forward, apex - 100 * forward, apex + 50 * forward + right])
    towards = torch.stack([forward, right, forward, -forward])
    return origins, towards, torch.tensor([[1e6], [3.0], [1e4], [49.0]])


def _on_mapped_rays(_: Backend, origins: Tensor, towards: Tensor, distance: Tensor) -> Tensor:
    none = torch.zeros_like(distance[:, 0])
    mapped = NDC.map_rays(Rays(origins, towards, none, none + 1e7))
    return points_on(mapped.rays, mapped.from_scene(distance[:, 0])[:, None])[:, 0]


def _samples(t: Tensor) -> Samples:
    """As many samples on every ray as ``t`` has columns."""
    rays, count = t.shape
    starts = torch.arange(0, rays * count + 1, count, dtype=torch.int32, device=t.device)
    ray = torch.arange(rays, device=t.device).repeat_interleave(count).int()
    return Samples(starts, ray, t.reshape(-1).contiguous(), torch.ones_like(t).reshape(-1))


def _rays(origins: Tensor, towards: Tensor) -> Rays:
    none = torch.zeros_like(origins[:, 0])
    return Rays(origins.contiguous(), towards.contiguous(), none, none)


def _unit_points(contracted: bool):
    def function(backend: Backend, origins: Tensor, towards: Tensor, t: Tensor) -> Tensor:
        return backend.sample_points(_rays(origins, towards), _samples(t), contracted).view(len(t), -1)

    def reference(origins: Tensor, towards: Tensor, t: Tensor) -> Tensor:
        points = origins[:, None] + t[..., None] * towards[:, None]
        half = Contraction.half if contracted else Box.half
        return (((_folded(points) if contracted else points) + half) / (2 * half)).flatten(1)

    def backward(backend: Backend, grad: Tensor, origins: Tensor, towards: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        rays, samples = _rays(origins, towards), _samples(t)
        return backend.sample_points_backward(rays, samples, contracted, grad.reshape(-1, 3).contiguous())

    return {"function": function, "reference": reference, "backward": backward, "differentiable": 2, "kernels": True}


def _slabs(origins: Tensor, towards: Tensor, ends: Tensor, half: float) -> tuple[Tensor, Tensor, Tensor]:
    """(near, far, hit) of the cube, axis by axis; an axis along which a ray does not move decides all or nothing."""
    still, within = towards == 0, origins.abs() <= half
    speed = torch.where(still, 1, towards)
    first, second = (-half - origins) / speed, (half - origins) / speed
    everywhere = torch.where(within, torch.inf, -torch.inf)
    enter = torch.where(still, -everywhere, torch.minimum(first, second)).amax(-1).maximum(ends[:, 0])
    leave = torch.where(still, everywhere, torch.maximum(first, second)).amin(-1).minimum(ends[:, 1])
    return enter, leave, enter < leave


def _clipped(origins: Tensor, towards: Tensor, ends: Tensor) -> Tensor:
    near, far, hit = _slabs(origins, towards, ends, Box.half)
    return torch.stack([torch.where(hit, near, ends[:, 1]), torch.where(hit, far, ends[:, 1])], -1)


def _box_rays() -> tuple[Tensor, Tensor, Tensor]:
    return uniform(1, -2, 2, 512, 3), directions(2, 512), torch.tensor([[0.05, 30.0]]).repeat(512, 1)


def _hard_box_rays() -> tuple[Tensor, Tensor, Tensor]:
    """Along axes (zeros of both signs, denormal and barely normal components), from inside, missing, from far away."""
    towards = torch.tensor([[1.0, 0, 0], [0, -0.0, -1], [1, 1e-45, -1e-38], [0.6, 0.8, 0], [-1e-30, 0, 1]])
    origins = torch.tensor([[0.1, 0.2, -0.3], [-3, 0.2, 0.4], [0.5, 5, 0], [-1e6, 0.1, 0.2], [0.3, -0.2, -1000]])
    ends = torch.tensor([[0.05, 30.0], [0, 1e30], [1e-30, 0.1]])
    rows = torch.cartesian_prod(torch.arange(5), torch.arange(5), torch.arange(3)).T
    return origins[rows[0]], towards[rows[1]], ends[rows[2]]


def _on_rays(origins: Tensor, towards: Tensor, t: Tensor) -> Tensor:
    return (origins[:, None] + t[..., None] * towards[:, None]).flatten(1)


def _points_on(_: Backend, origins: Tensor, towards: Tensor, t: Tensor) -> Tensor:
    return points_on(_rays(origins, towards), t).flatten(1)


def _distance(s: Tensor) -> Tensor:
    beyond = CONTRACTED.cone_angle * s > 1
    grown = CONTRACTED.linear_until * torch.exp(torch.where(beyond, CONTRACTED.cone_angle * s - 1, 0))
    return torch.where(beyond, grown, CONTRACTED.step_size * s)


def _coordinate(t: Tensor) -> Tensor:
    relative = t / CONTRACTED.linear_until
    return torch.where(relative > 1, 1 + torch.log(relative.clamp(min=1)), relative) / CONTRACTED.cone_angle


def _interval(s: Tensor) -> Tensor:
    ends = _distance(torch.stack([s, s + 1], -1))
    return torch.cat([ends, ends[..., 1:] - ends[..., :1]], -1)


def _intervals(_: Backend, s: Tensor) -> Tensor:
    start, end = s_to_t(CONTRACTED, s), s_to_t(CONTRACTED, s + 1)
    return torch.stack([start, end, end - start], -1)


def _spread_rays() -> tuple[Tensor, Tensor, Tensor]:
    return uniform(1, -3, 3, 256, 3), directions(2, 256), uniform(3, 0, 30, 256, PER_RAY)


def _far_rays() -> tuple[Tensor, Tensor, Tensor]:
    """Samples from 1e-30 to 1e30 away, in the corners, on the faces and in the middle of the unit cube."""
    t = decades(4, -30, 30, 64, PER_RAY)
    t[:8] = torch.tensor([0.0, 1.0, 1e-45, 2.0])
    towards = directions(5, 64)
    towards[:4] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]])
    return torch.zeros(64, 3), towards, t


CASES = [
    Case(
        formula="γ(x) = sin, cos of 2ᵏπx, k < 16",
        where="nerf/fields/positional_encoding.py: positional_encoding",
        typical=lambda: (uniform(1, -0.9, 0.9, 512, 3),),
        extreme=lambda: (
            torch.cat(
                [
                    torch.tensor([[0.0, -0.0, 1e-45], [1e-38, 0.5, -0.5], [1.0, -1.0, 1e30], [-1e30, 3e-5, 1e10]]),
                    uniform(2, -1e3, 1e3, 128, 3),
                    uniform(3, -1e6, 1e6, 128, 3),
                ]
            ),
        ),
        function=lambda _, x: positional_encoding(x, OCTAVES),
        reference=_encoded,
        value=Bound(1e-6, "one"),
        gradient=Bound(5e-6, "row"),
        differentiable=1,
    ),
    Case(
        formula="contraction (2 − 1/r) x/r",
        where="nerf/geometry/space_maps/contraction.py: contract",
        typical=lambda: (uniform(1, -3, 3, 512, 3),),
        extreme=lambda: (
            torch.tensor(
                [
                    [0.0, -0.0, 1e-45],
                    [1.0, 1.0, -1.0],
                    [0.99999994, 0.5, 0.0],
                    [1.0000001, 0.5, 0.0],
                    [2.0, -2.0, 2.0],
                    [1e19, 1.0, -1e10],
                    [1e30, 1e30, 0.0],
                    [3e38, -1.0, 1e-38],
                ]
            ),
        ),
        function=lambda _, x: contract(x),
        reference=_folded,
        value=Bound(5e-7, "itself"),
        gradient=Bound(2e-6, "row"),
        differentiable=1,
    ),
    Case(
        formula="its inverse y / (m (2 − m))",
        where="nerf/geometry/space_maps/contraction.py: uncontract",
        typical=lambda: (uniform(1, -1.9, 1.9, 512, 3),),
        extreme=lambda: (
            torch.tensor([[0.0, 1e-45, -0.0], [1.0, -1.0, 0.5], [1.0000001, 0.1, 0.0], [1.9999999, 1.0, -1e-30]]),
        ),
        function=lambda _, y: uncontract(y),
        reference=_unfolded,
        value=Bound(5e-7, "itself"),
        gradient=Bound(5e-6, "row"),
        differentiable=1,
    ),
    Case(
        formula="normalised device coordinates (x/z, y/z, 1 − 2 n/z)",
        where="nerf/geometry/space_maps/ndc.py: forward, pull_back",
        typical=lambda: (torch.tensor(NDC.apex) + uniform(1, -0.5, 3, 512, 3) @ torch.tensor(NDC.axes),),
        extreme=lambda: (
            torch.tensor(NDC.apex)
            + torch.tensor([[0.3, 0.2, 0.75], [1.0, -2.0, 1e4], [1e19, 0, 1e20], [0.1, 0.1, -1.0], [100.0, 1.0, -1e3]])
            @ torch.tensor(NDC.axes),
        ),
        function=lambda _, x: NDC.forward(x),
        reference=_in_ndc,
        value=Bound(1.5e-5, "row"),
        gradient=Bound(3e-5, "row"),
        differentiable=1,
        backward=lambda _, grad, x: (NDC.pull_back(x, grad),),
    ),
    Case(
        formula="their inverse, z = 2 n / (1 − z')",
        where="nerf/geometry/space_maps/ndc.py: inverse",
        typical=lambda: (uniform(1, -0.89, 0.89, 512, 3),),
        extreme=lambda: (torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.2, -0.9], [0.5, 0.9, 0.893]]),),
        function=lambda _, y: NDC.inverse(y),
        reference=_from_ndc,
        value=Bound(2e-5, "row"),
        gradient=Bound(4e-5, "row"),
        differentiable=1,
    ),
    Case(
        formula="straight rays through them",
        where="nerf/geometry/space_maps/ndc.py: map_rays",
        typical=_ndc_rays,
        extreme=_hard_ndc_rays,
        function=_on_mapped_rays,
        reference=lambda origins, towards, distance: _in_ndc(origins + distance * towards),
        value=Bound(1e-5, "one"),
    ),
    Case(
        formula="o + t d",
        where="nerf/geometry/rays.py: points_on",
        typical=_spread_rays,
        extreme=_far_rays,
        function=_points_on,
        reference=_on_rays,
        value=Bound(5e-7, "row"),
        gradient=Bound(1e-6, "row"),
        differentiable=2,
    ),
    Case(
        formula="unit coordinates of samples, bounded",
        where="nerf/kernels/torch/marching.py: sample_points, sample_points_backward",
        typical=_spread_rays,
        extreme=lambda: tuple(part[:8] for part in _far_rays()),
        value=Bound(1e-6, "row"),
        gradient=Bound(2e-6, "row"),
        **_unit_points(False),
    ),
    Case(
        formula="unit coordinates of samples, contracted",
        where="nerf/kernels/torch/marching.py: sample_points, sample_points_backward",
        typical=_spread_rays,
        extreme=_far_rays,
        value=Bound(5e-7, "one"),
        gradient=Bound(5e-6, "row"),
        **_unit_points(True),
    ),
    Case(
        formula="ray–box interval by slabs",
        where="nerf/geometry/rays.py: clip_to_box",
        typical=_box_rays,
        extreme=_hard_box_rays,
        function=lambda _, o, d, e: torch.stack(clip_to_box(Rays(o, d, *e.unbind(-1)), -Box.half, Box.half)[2:], -1),
        reference=_clipped,
        value=Bound(2e-6, "row"),
    ),
    Case(
        formula="t(s) = step s, then step/cone exp(cone s − 1)",
        where="nerf/kernels/torch/marching.py: s_to_t",
        typical=lambda: (uniform(1, 0, 1500, 512, 1),),
        extreme=lambda: (torch.tensor([[0.0], [1e-45], [1e-30], [125.0], [125.00001], [8000.0], [9000.0]]),),
        function=lambda _, s: s_to_t(CONTRACTED, s),
        reference=_distance,
        value=Bound(5e-6, "itself"),
    ),
    Case(
        formula="s(t), its inverse",
        where="nerf/kernels/torch/marching.py: t_to_s",
        typical=lambda: (decades(1, -3, 3, 512, 1),),
        extreme=lambda: (torch.tensor([[0.0], [1e-45], [1e-30], [0.25], [0.25000003], [1e30], [1e37]]),),
        function=lambda _, t: t_to_s(CONTRACTED, t),
        reference=_coordinate,
        value=Bound(1e-6, "itself"),
    ),
    Case(
        formula="dt = t(s + 1) − t(s)",
        where="nerf/kernels/torch/marching.py: march",
        typical=lambda: (uniform(1, 0, 1200, 512),),
        extreme=lambda: (torch.tensor([0.0, 124.0, 124.5, 125.0, 1200.0]),),
        function=_intervals,
        reference=_interval,
        value=Bound(5e-6, "row"),
    ),
]
