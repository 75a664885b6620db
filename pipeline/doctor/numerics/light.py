"""Cases of what rays see: samples placed by a density, volume rendering, what a density grid stops."""

from typing import Any

import torch
from torch import Tensor

from nerf.fields.density_grid import DensityGrid, first_crossing, occupancy, optical_depth
from nerf.fields.interface import Rendering
from nerf.kernels import Backend, Samples
from nerf.rendering.sampling import Spacing, invert_cdf, midpoint_edges, stratified
from nerf.rendering.volume_rendering import composite, volume_weights
from pipeline.doctor.numerics import Bound, Case
from pipeline.doctor.numerics.space import decades, uniform

N = 8  # intervals of a ray


def _ends(like: Tensor) -> Tensor:
    """End points of N intervals between 2 and 6, of unequal lengths that float32 and float64 share."""
    steps = torch.tensor([1.0, 4, 2, 8, 1, 6, 3, 7], dtype=like.dtype, device=like.device) / 8
    return torch.cat([steps.new_full((1,), 2.0), 2 + steps.cumsum(0)])


def packed(like: Tensor) -> Samples:
    """The same intervals on every ray of ``like``, samples at their beginnings."""
    rays, ends = len(like), _ends(like)
    starts = torch.arange(0, rays * N + 1, N, dtype=torch.int32, device=like.device)
    ray = torch.arange(rays, device=like.device).repeat_interleave(N).int()
    return Samples(starts, ray, ends[:-1].repeat(rays), ends.diff().repeat(rays))


def _thin_to_solid(seed: int, rays: int) -> tuple[Tensor, Tensor, Tensor]:
    """Densities over six decades, colours, backgrounds."""
    return decades(seed, -4, 2, rays, N), uniform(seed + 1, 0, 1, rays, N, 3), uniform(seed + 2, 0, 1, rays, 3)


def _hard_densities() -> tuple[Tensor, Tensor, Tensor]:
    """None, denormal, 1e-38, and up to 1e30, alone and one behind the other."""
    sizes = torch.tensor([0.0, 1e-45, 1e-38, 1e-20, 1.0, 88.0, 104.0, 800.0, 1e6, 1e30])
    mixed = sizes[torch.randint(10, (48, N), generator=torch.Generator().manual_seed(3))]
    alone = torch.eye(N) * 1e30
    sigma = torch.cat([sizes[:, None].repeat(1, N), mixed, alone])
    return sigma, uniform(4, 0, 1, len(sigma), N, 3), uniform(5, 0, 1, len(sigma), 3)


def light(sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Weights, and the light that nothing stops; from running sums, interval by interval."""
    tau = sigma * _ends(sigma).diff()
    passed, weights = torch.zeros_like(tau[:, 0]), []
    for column in tau.unbind(-1):
        weights.append(torch.exp(-passed) * -torch.expm1(-column))
        passed = passed + column
    return torch.stack(weights, -1), passed


def _seen(sigma: Tensor, colour: Tensor, background: Tensor) -> Tensor:
    weights, passed = light(sigma)
    ends, unstopped = _ends(sigma), torch.exp(-passed)[:, None]
    depth = (weights * ends[:-1]).sum(-1, keepdim=True) + unstopped * ends[-1]
    seen = (weights[..., None] * colour).sum(1) + unstopped * background
    return torch.cat([seen, depth, -torch.expm1(-passed)[:, None], weights], -1)


def _composite(_: Backend, sigma: Tensor, colour: Tensor, background: Tensor) -> Tensor:
    (seen, depth, opacity), weights = composite(sigma, colour, _ends(sigma).repeat(len(sigma), 1), background)
    return torch.cat([seen, depth[:, None], opacity[:, None], weights], -1)


def _composite_packed(backend: Backend, sigma: Tensor, colour: Tensor, background: Tensor) -> Tensor:
    far = _ends(sigma)[-1].expand(len(sigma)).contiguous()
    (seen, depth, opacity), weights = backend.composite(
        packed(sigma), sigma.reshape(-1), colour.reshape(-1, 3), background, far
    )
    return torch.cat([seen, depth[:, None], opacity[:, None], weights.view(-1, N)], -1)


def _composite_packed_backward(
    backend: Backend, grad: Tensor, sigma: Tensor, colour: Tensor, background: Tensor
) -> tuple[Tensor, Tensor]:
    far = _ends(sigma)[-1].expand(len(sigma)).contiguous()
    of_rendering = Rendering(*(part.contiguous() for part in (grad[:, :3], grad[:, 3], grad[:, 4])))
    arguments = packed(sigma), sigma.reshape(-1), colour.reshape(-1, 3), background, far
    of_sigma, of_colour = backend.composite_backward(*arguments, of_rendering, grad[:, 5:].reshape(-1))
    return of_sigma.view(-1, N), of_colour.view(-1, N, 3)


def _stratified(spacing: Spacing):
    return lambda _, near, far: stratified(near, far, N, None, spacing)


def _strata(like: Tensor) -> Tensor:
    return (torch.arange(N, dtype=like.dtype, device=like.device) + 0.5) / N


def _even(near: Tensor, far: Tensor) -> Tensor:
    inner = near[:, None] + (far - near)[:, None] * _strata(near)
    return torch.cat([inner, far[:, None]], -1)


def _log(near: Tensor, far: Tensor) -> Tensor:
    inner = torch.exp(torch.log(near)[:, None] + torch.log(far / near)[:, None] * _strata(near))
    return torch.cat([inner, far[:, None]], -1)


def _cdf_at(edges: Tensor, weights: Tensor, t: Tensor) -> Tensor:
    """The share of the probability before ``t``, in float64."""
    edges, weights, t = edges.double(), weights.double(), t.double()
    share = ((t[:, None] - edges[:, :-1, None]) / edges.diff(dim=-1)[..., None]).clamp(0, 1)
    weights = torch.where(weights.sum(-1, keepdim=True) == 0, 1, weights)
    return (weights[..., None] * share).sum(1) / weights.sum(-1, keepdim=True)


def _spiky_weights() -> tuple[Tensor, Tensor, Tensor]:
    """None at all, equal ones, a spike of each size in each bin, a spike over a floor, alternating zeros."""
    sizes = torch.tensor([1e-37, 1e-30, 1.0, 1e30])
    spikes = (sizes[:, None, None] * torch.eye(N)).view(-1, N)
    others = torch.stack([torch.zeros(N), torch.ones(N), torch.tensor([1e-6, 1, 1e-6, 1, 0, 0, 0, 1]), torch.eye(N)[3]])
    weights = torch.cat([spikes, others, spikes.clamp(max=1) + 1e-7])
    rows = len(weights)
    return _ends(weights).repeat(rows, 1), weights, torch.linspace(0, 1, 17).repeat(rows, 1)


def _occupancy(density: Tensor, level: float = 7.0) -> Tensor:
    return -torch.expm1(-torch.log(density.new_tensor(2.0)) * density / level)


def _occupied(_: Backend, density: Tensor) -> Tensor:
    corner = torch.ones(3, device=density.device)
    return occupancy(DensityGrid(density[None], -corner, corner), 7.0).values[0]


def _crossing(values: Tensor) -> Tensor:
    """Where a rising line of values reaches 1/2 between 2 and 2.125, its only interval."""
    low, high = values.unbind(-1)
    share = torch.where(low >= 0.5, 0, (0.5 - low) / torch.where(low >= 0.5, 1, high - low))
    return (2 + share / 8)[:, None]


COMPOSITED: dict[str, Any] = {
    "where": "nerf/rendering/volume_rendering.py: composite, volume_weights",
    "typical": lambda: _thin_to_solid(1, 256),
    "extreme": _hard_densities,
}

PACKED: dict[str, Any] = COMPOSITED | {
    "where": "nerf/kernels/torch/compositing.py: composite, composite_backward",
}

CASES = [
    Case(
        formula="stratified samples, even",
        where="nerf/rendering/sampling.py: stratified",
        typical=lambda: (uniform(1, 0.05, 1, 256), uniform(2, 1, 1000, 256)),
        extreme=lambda: (torch.tensor([0.0, 1.0, 5.0, 1e-38]), torch.tensor([1e30, 1.000001, 5.0, 1.0])),
        function=_stratified("linear"),
        reference=_even,
        value=Bound(5e-7, "itself"),
    ),
    Case(
        formula="stratified samples near (far/near)ᵘ",
        where="nerf/rendering/sampling.py: stratified",
        typical=lambda: (uniform(1, 0.05, 1, 256), uniform(2, 1, 1000, 256)),
        extreme=lambda: (torch.tensor([1e-30, 5.0, 1e-4]), torch.tensor([1.0, 5.0, 1e4])),
        function=_stratified("log"),
        reference=_log,
        value=Bound(5e-7, "itself"),
    ),
    Case(
        formula="edges half-way between samples",
        where="nerf/rendering/sampling.py: midpoint_edges",
        typical=lambda: (_ends(torch.zeros(1)).repeat(64, 1) * decades(1, -2, 2, 64, 1), torch.zeros(64)),
        extreme=lambda: (torch.tensor([0.0, 1e-30, 1e30])[:, None].repeat(1, N + 1), torch.zeros(3)),
        function=lambda _, t, near: midpoint_edges(t, near),
        reference=lambda t, near: torch.cat([near[:, None], (t[:, 1:-1] + t[:, :-2]) / 2, t[:, -1:]], -1),
        value=Bound(3e-7, "itself"),
    ),
    Case(
        formula="inverse CDF: CDF(t(u)) = u",
        where="nerf/rendering/sampling.py: invert_cdf",
        typical=lambda: (
            _ends(torch.zeros(1)).repeat(256, 1),
            decades(1, -6, 0, 256, N),
            uniform(2, 0, 1, 256, 17),
        ),
        extreme=_spiky_weights,
        function=lambda _, edges, weights, u: _cdf_at(edges, weights, invert_cdf(edges, weights, u)),
        reference=lambda edges, weights, u: u,
        value=Bound(5e-6, "one"),
    ),
    Case(
        formula="w_i = T_i (1 − exp(−σ_i δ_i)), colour, depth, opacity",
        function=_composite,
        reference=_seen,
        value=Bound(3e-6, "one"),
        gradient=Bound(5e-6, "one"),
        differentiable=2,
        **COMPOSITED,
    ),
    Case(
        formula="opacity of thin media",
        where="nerf/rendering/volume_rendering.py: volume_weights",
        typical=lambda: (decades(1, -30, 1, 512, 1),),
        extreme=lambda: (torch.tensor([[0.0], [1e-45], [1e-38], [1e-7], [1.0], [1e30]]),),
        function=lambda _, sigma: volume_weights(sigma, torch.tensor([1.0, 2.0]).to(sigma).repeat(len(sigma), 1))[0],
        reference=lambda sigma: -torch.expm1(-sigma),
        value=Bound(3e-7, "itself"),
        gradient=Bound(3e-7, "one"),
        differentiable=1,
    ),
    Case(
        formula="the same of packed samples, gradient by hand",
        function=_composite_packed,
        reference=_seen,
        backward=_composite_packed_backward,
        value=Bound(2e-6, "one"),
        gradient=Bound(1e-5, "one"),
        differentiable=2,
        kernels=True,
        **PACKED,
    ),
    Case(
        formula="occupancy 1 − 2^(−σ/level)",
        where="nerf/fields/density_grid.py: occupancy",
        typical=lambda: (decades(1, -6, 3, 512, 1),),
        extreme=lambda: (torch.tensor([[0.0], [1e-38], [1e-30], [7.0], [1e4], [1e30]]),),
        function=_occupied,
        reference=_occupancy,
        value=Bound(5e-7, "itself"),
    ),
    Case(
        formula="optical depth by trapezoids",
        where="nerf/fields/density_grid.py: optical_depth",
        typical=lambda: (decades(1, -4, 2, 256, N),),
        extreme=lambda: _hard_densities()[:1],
        function=lambda _, sigma: optical_depth(sigma, _ends(sigma)[:-1].expand_as(sigma)),
        reference=lambda sigma: torch.nn.functional.pad(
            torch.cumsum((sigma[:, 1:] + sigma[:, :-1]) / 2 * _ends(sigma)[:-1].diff(), -1), (1, 0)
        ),
        value=Bound(5e-7, "row"),
    ),
    Case(
        formula="first crossing of a level",
        where="nerf/fields/density_grid.py: first_crossing",
        typical=lambda: (torch.cat([uniform(1, 0, 0.4, 256, 1), uniform(2, 0.5, 9, 256, 1)], -1),),
        extreme=lambda: (torch.tensor([[0.0, 1e30], [0.49999997, 0.5], [0.5, 0.5], [1e30, 1e30], [1e-45, 0.5]]),),
        function=lambda _, values: first_crossing(values, torch.tensor([2.0, 2.125]).to(values).expand_as(values), 0.5)[
            :, None
        ],
        reference=_crossing,
        value=Bound(3e-7, "itself"),
    ),
]
