"""Cases of the fields themselves: feature grids, directions, networks, activations, the optimiser."""

import math
from typing import Any

import torch
from torch import Tensor

from nerf.fields import background, mlp
from nerf.fields.mlp import DIRECTION_FEATURES, GEOMETRY_FEATURES, MAX_LOG_DENSITY, ColourPass, DensityPass, Weights
from nerf.fields.vanilla import SOFTPLUS_SHIFT, shifted_softplus
from nerf.kernels import Backend, GridLayout, Samples, grid_layout
from nerf.kernels.torch.adam import BETA1, BETA2, EPSILON
from pipeline.doctor.numerics import Bound, Case
from pipeline.doctor.numerics.space import decades, directions, uniform

LAYOUT = grid_layout(num_levels=4, base_res=6, max_res=384, log2_hashmap_size=12, features_per_level=4)
FEATURES = 20
RATE, COUNT = 0.01, 3


def _table(like: Tensor) -> Tensor:
    return uniform(7, -1, 1, LAYOUT.rows, LAYOUT.features).to(like)


def _weights(like: Tensor) -> Weights:
    drawn = mlp.initial_weights(FEATURES, DIRECTION_FEATURES, torch.Generator().manual_seed(8))
    return Weights(*(part.to(like) for part in drawn))


def _borders() -> tuple[Tensor]:
    """Vertices and faces of cells of every level, their neighbours in float32, the corners of the unit cube."""
    resolutions = torch.tensor(LAYOUT.resolutions)
    cell = (uniform(9, 0, 1, 64, len(resolutions)) * resolutions).floor()
    faces = (cell / resolutions).flatten()
    triples = torch.stack([faces, faces.roll(1), uniform(10, 0, 1, len(faces))], -1)
    up, down = torch.nextafter(triples, torch.tensor(1.0)), torch.nextafter(triples, torch.tensor(0.0))
    corners = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 1e-45], [1e-38, 1, 0.5]])
    return (torch.cat([triples, up, down, corners]),)


def _dyadic(points: Tensor) -> Tensor:
    """Multiples of 2^-13: float32 is exact in saying which cell is theirs, so that gradients can be compared."""
    return (points * 8192).round() / 8192


def _encode(backend: Backend, points: Tensor) -> Tensor:
    return backend.encode(LAYOUT, _table(points), points)


def _encode_points_backward(backend: Backend, grad: Tensor, points: Tensor) -> tuple[Tensor]:
    return (backend.encode_backward_points(LAYOUT, _table(points), points, grad),)


def _trilinear(table: Tensor, points: Tensor, layout: GridLayout = LAYOUT) -> Tensor:
    """Level by level and corner by corner, as the layout's docstring has it."""
    levels = []
    for level, resolution in enumerate(layout.resolutions):
        scaled = points * resolution
        cell = scaled.detach().floor().clamp(0, resolution - 1)
        mean: Any = 0
        for corner in torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3):
            share = torch.where(corner == 1, scaled - cell, 1 - (scaled - cell))
            mean = (
                mean + (share[:, :1] * share[:, 1:2] * share[:, 2:]) * table[_row(layout, level, cell.long() + corner)]
            )
        levels.append(mean)
    return torch.cat(levels, -1)


def _row(layout: GridLayout, level: int, vertex: Tensor) -> Tensor:
    x, y, z = vertex.unbind(-1)
    if layout.is_hashed(level):
        number = (x ^ (y * 2654435761) ^ (z * 805459861)) % layout.level_rows(level)
    else:
        side = layout.resolutions[level] + 1
        number = (x * side + y) * side + z
    return layout.level_offsets[level] + number


def _table_points(like: Tensor) -> Tensor:
    return torch.cat([_dyadic(uniform(11, 0, 1, 2000, 3)), torch.full((200, 3), 0.5)]).to(like)


def _encode_table(backend: Backend, table: Tensor) -> Tensor:
    """A row for each of the table, as cases have them: the first points' features."""
    return backend.encode(LAYOUT, table, _table_points(table))


def _encode_table_backward(backend: Backend, grad: Tensor, table: Tensor) -> tuple[Tensor]:
    total = torch.zeros_like(table)
    for level in range(len(LAYOUT.resolutions)):
        backend.encode_backward_table(LAYOUT, range(level, level + 1), _table_points(table), grad, total)
    return (total,)


def _harmonics(d: Tensor) -> Tensor:
    """By degree and order from associated Legendre polynomials in z and (x + iy)^m (Sloan 2008)."""
    x, y, z = d.unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(3):
        r, i = real[-1], imaginary[-1]
        real.append(x * r - y * i)
        imaginary.append(x * i + y * r)
    legendre = {(0, 0): torch.ones_like(z), (1, 0): z, (1, 1): -torch.ones_like(z)}
    legendre |= {(2, 0): (3 * z * z - 1) / 2, (2, 1): -3 * z, (2, 2): 3 * torch.ones_like(z)}
    legendre |= {(3, 0): (5 * z**3 - 3 * z) / 2, (3, 1): -1.5 * (5 * z * z - 1), (3, 2): 15 * z}
    legendre[3, 3] = -15 * torch.ones_like(z)
    parts = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            scale = math.sqrt(
                (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
            )
            around = imaginary[m] if order < 0 else real[m]
            parts.append((scale * math.sqrt(2) if m else scale) * legendre[degree, m] * around)
    return torch.stack(parts, -1)


def _sigma(_: Backend, logarithm: Tensor) -> Tensor:
    return mlp.sigma_of(logarithm)[:, None]


def _sigma_backward(backend: Backend, grad: Tensor, logarithm: Tensor) -> tuple[Tensor]:
    """Alone: of a network whose hidden layer is silent, and whose colours ask for nothing."""
    geometry_features = torch.nn.functional.pad(logarithm, (0, GEOMETRY_FEATURES - 1))
    features, sigma = torch.zeros(len(logarithm), FEATURES).to(logarithm), mlp.sigma_of(geometry_features)
    done = DensityPass(features, geometry_features, sigma)
    grad_geometry_features = torch.zeros_like(geometry_features)
    mlp.density_backward(_weights(logarithm), backend, done, grad[:, 0], grad_geometry_features)
    return (grad_geometry_features[:, :1],)


def _density(backend: Backend, features: Tensor) -> Tensor:
    return mlp.density_forward(_weights(features), backend, features).geometry_features


def _density_backward(backend: Backend, grad: Tensor, features: Tensor) -> tuple[Tensor]:
    weights = _weights(features)
    done = mlp.density_forward(weights, backend, features)
    none = torch.zeros_like(features[:, 0])
    return (mlp.density_backward(weights, backend, done, none, grad.clone()).features,)


def _density_plainly(features: Tensor) -> Tensor:
    weights = _weights(features)
    return torch.relu(features @ weights.density_hidden) @ weights.density_out.T


def _each(like: Tensor) -> Samples:
    """A ray of its own for every sample."""
    each = torch.arange(len(like) + 1, dtype=torch.int32, device=like.device)
    return Samples(each, each[:-1], like[:, 0].contiguous(), like[:, 0].contiguous())


def _colour(backend: Backend, geometry_features: Tensor, harmonics: Tensor) -> Tensor:
    weights = _weights(geometry_features)
    ray_hidden = mlp.direction_hidden(weights, harmonics)
    return mlp.colour_forward(weights, backend, _each(geometry_features).ray, geometry_features, ray_hidden)


def _colour_backward(
    backend: Backend, grad: Tensor, geometry_features: Tensor, harmonics: Tensor
) -> tuple[Tensor, Tensor]:
    weights, samples = _weights(geometry_features), _each(geometry_features)
    ray_hidden = mlp.direction_hidden(weights, harmonics)
    colour = mlp.colour_forward(weights, backend, samples.ray, geometry_features, ray_hidden)
    done = ColourPass(harmonics, ray_hidden, colour)
    gradients = mlp.colour_backward(weights, backend, samples, geometry_features, done, grad)
    return gradients.geometry_features, gradients.harmonics


def _colour_plainly(geometry_features: Tensor, harmonics: Tensor) -> Tensor:
    weights = _weights(geometry_features)
    hidden = torch.relu(torch.cat([geometry_features, harmonics], -1) @ weights.colour_hidden)
    return torch.sigmoid(hidden @ weights.colour_out.T)


def _background_directions(like: Tensor) -> Tensor:
    return torch.nn.functional.normalize(_dyadic(directions(12, 512))).to(like)


def _sky(backend: Backend, table: Tensor) -> Tensor:
    return background.background_colour(backend, table, _background_directions(table))


def _sky_backward(backend: Backend, grad: Tensor, table: Tensor) -> tuple[Tensor]:
    directions = _background_directions(table)
    return (
        background.background_backward(
            backend, directions, background.background_colour(backend, table, directions), grad
        ),
    )


def _sky_plainly(table: Tensor) -> Tensor:
    on_sphere = (_background_directions(torch.zeros(1)).to(table) + 1) / 2
    return torch.sigmoid(_trilinear(table, on_sphere, background.BACKGROUND_LAYOUT).view(len(on_sphere), -1, 4).sum(1))[
        :, :3
    ]


def _adam(backend: Backend, gradient: Tensor, mean: Tensor, square: Tensor) -> Tensor:
    """How far an entry moves, in rates."""
    entry = torch.zeros_like(gradient)
    backend.adam(entry, gradient.clone(), mean.clone(), square.clone(), RATE, COUNT)
    return entry / RATE


def _adam_plainly(gradient: Tensor, mean: Tensor, square: Tensor) -> Tensor:
    m = BETA1 * mean + (1 - BETA1) * gradient
    v = BETA2 * square + (1 - BETA2) * gradient.square()
    root = (v / (1 - BETA2**COUNT)).sqrt().clamp(min=EPSILON)
    return torch.where(gradient != 0, -m / (1 - BETA1**COUNT) / root, 0)


def _hard_gradients() -> tuple[Tensor, Tensor, Tensor]:
    """From denormal to the largest whose square float32 holds, with and without a past."""
    sizes = torch.tensor([0.0, -0.0, 1e-45, -1e-38, 1e-30, 1e-20, -1e-15, 1e-12, 1e-8, 1.0, -1e8, 1e15, 1e18])
    gradient = torch.cat([sizes, sizes])[:, None]
    past = torch.cat([torch.zeros_like(sizes), torch.full_like(sizes, 1e-3)])[:, None]
    return gradient, past, past.square()


LOGARITHMS = torch.tensor([[-1e30], [-200.0], [-88.0], [-1e-45], [0.0], [14.999], [15.0], [15.000001], [88.0], [1e30]])
BACKGROUND_SIZES = torch.tensor([0, 1e-38, 1.0, 30.0, 1.0]).repeat(background.BACKGROUND_LAYOUT.rows)[
    : background.BACKGROUND_LAYOUT.rows, None
]

CASES = [
    Case(
        formula="features of points: trilinear means of grid vertices",
        where="nerf/kernels/torch/encoding.py: encode",
        typical=lambda: (uniform(1, 0, 1, 512, 3),),
        extreme=_borders,
        function=_encode,
        reference=lambda points: _trilinear(_table(points), points),
        value=Bound(2e-4, "one"),
        kernels=True,
    ),
    Case(
        formula="its gradient with respect to points",
        where="nerf/kernels/torch/encoding.py: encode_backward_points",
        typical=lambda: (_dyadic(uniform(2, 0, 1, 512, 3)),),
        extreme=lambda: (torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5]]),),
        function=_encode,
        reference=lambda points: _trilinear(_table(points), points),
        backward=_encode_points_backward,
        value=Bound(5e-7, "one"),
        gradient=Bound(5e-6, "row"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="its gradient with respect to the table",
        where="nerf/kernels/torch/encoding.py: encode_backward_table",
        typical=lambda: (_table(torch.zeros(1)),),
        extreme=lambda: (torch.zeros(0, LAYOUT.features),),
        function=_encode_table,
        reference=lambda table: _trilinear(table, _table_points(table)),
        backward=_encode_table_backward,
        value=Bound(1e-6, "one"),
        gradient=Bound(5e-6, "row"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="background model: sigmoid of its table's features on the unit sphere",
        where="nerf/fields/background.py: background_colour, background_backward",
        typical=lambda: (uniform(13, -1, 1, background.BACKGROUND_LAYOUT.rows, 4) * BACKGROUND_SIZES,),
        extreme=lambda: (torch.zeros(0, 4),),
        function=_sky,
        reference=_sky_plainly,
        backward=_sky_backward,
        value=Bound(5e-6, "one"),
        gradient=Bound(5e-6, "one"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="spherical harmonics up to degree 3",
        where="nerf/kernels/torch/spherical_harmonics.py: spherical_harmonics, spherical_harmonics_backward",
        typical=lambda: (directions(1, 512),),
        extreme=lambda: (torch.tensor([[1.0, 0, 0], [0, -1, -0.0], [0, 1e-45, 1], [1e-20, 0, -1]]),),
        function=lambda backend, d: backend.spherical_harmonics(d),
        reference=_harmonics,
        backward=lambda backend, grad, d: (backend.spherical_harmonics_backward(d, grad),),
        value=Bound(5e-7, "one"),
        gradient=Bound(3e-6, "row"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="density exp(min(x, 15))",
        where="nerf/fields/mlp.py: sigma_of, density_backward",
        typical=lambda: (uniform(1, -15, 15, 512, 1),),
        extreme=lambda: (LOGARITHMS,),
        function=_sigma,
        reference=lambda x: torch.exp(torch.where(x <= MAX_LOG_DENSITY, x, MAX_LOG_DENSITY)),
        backward=_sigma_backward,
        value=Bound(3e-7, "itself"),
        gradient=Bound(5e-7, "itself"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="density log(1 + exp(x + shift)) of the vanilla NeRF",
        where="nerf/fields/vanilla.py: shifted_softplus",
        typical=lambda: (uniform(1, -15, 15, 512, 1),),
        extreme=lambda: (LOGARITHMS,),
        function=lambda _, x: shifted_softplus(x),
        reference=lambda x: torch.logaddexp(x + SOFTPLUS_SHIFT, torch.zeros_like(x)),
        value=Bound(5e-6, "itself"),
        gradient=Bound(5e-6, "itself"),
        differentiable=1,
    ),
    Case(
        formula="density network: matrix products and ReLU",
        where="nerf/kernels/torch/mlp.py: mlp_forward, mlp_backward",
        typical=lambda: (uniform(1, -1, 1, 256, FEATURES),),
        extreme=lambda: (uniform(2, -1, 1, 5, FEATURES) * torch.tensor([[1e-4], [1e-38], [0], [1e30], [1e10]]),),
        function=_density,
        reference=_density_plainly,
        backward=_density_backward,
        value=Bound(2e-6, "row"),
        gradient=Bound(2e-6, "row"),
        differentiable=1,
        kernels=True,
    ),
    Case(
        formula="colour network, sigmoid, c (1 − c)",
        where="nerf/fields/mlp.py: colour_forward, colour_backward",
        typical=lambda: (uniform(1, -1, 1, 256, GEOMETRY_FEATURES), uniform(2, -1, 1, 256, DIRECTION_FEATURES)),
        extreme=lambda: (
            uniform(3, -1, 1, 4, GEOMETRY_FEATURES) * torch.tensor([[0], [1e-38], [1e3], [1e30]]),
            uniform(4, -1, 1, 4, DIRECTION_FEATURES),
        ),
        function=_colour,
        reference=_colour_plainly,
        backward=_colour_backward,
        value=Bound(5e-7, "one"),
        gradient=Bound(5e-7, "one"),
        differentiable=2,
        kernels=True,
    ),
    Case(
        formula="Adam that skips entries with zero gradient",
        where="nerf/kernels/torch/adam.py: adam",
        typical=lambda: (decades(1, -10, 10, 64, 1), uniform(2, -1, 1, 64, 1), uniform(3, 0, 1, 64, 1)),
        extreme=_hard_gradients,
        function=_adam,
        reference=_adam_plainly,
        value=Bound(1e-6, "one"),
        kernels=True,
    ),
]
