"""What must hold for all input: partition of light, order, continuity, flat pictures, grids without a surface."""

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from nerf.fields.density_grid import DensityGrid
from nerf.fields.positional_encoding import positional_encoding
from nerf.geometry.rays import Rays, clip_to_box
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import contract, uncontract
from nerf.kernels import Backend, RayStepping, Samples, grid_layout, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import binary_occupancy, cell_numbers
from nerf.rendering.sampling import invert_cdf
from nerf.rendering.volume_rendering import composite, volume_weights
from stages.evaluate.image_metrics import ssim
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.surface import is_watertight
from tests.refusals import refused

BACKENDS = pytest.mark.parametrize("backend", [reference, warp], ids=["torch", "warp"])
DENSITY = st.one_of(st.just(0.0), st.floats(-45, 30).map(lambda e: 10.0**e), st.floats(0, 100))
LENGTH = st.integers(0, 8192).map(lambda n: n / 1024)  # of which float32 knows the sums, in any order
INTERVALS = st.lists(st.tuples(DENSITY, LENGTH), min_size=1, max_size=12)
NUMBER = st.floats(-1e6, 1e6, width=32)
FRACTION = st.floats(0, 1, width=32)
EPSILON = torch.finfo(torch.float32).eps
DENORMAL = 1e-37  # below it float32 has fewer digits
LAYOUT = grid_layout(3, 3, 48, 10, 4)


def one_ray(intervals: list[tuple[float, float]]) -> tuple[Tensor, Tensor]:
    """Densities and end points, from 1 on."""
    sigma, lengths = (torch.tensor(part, dtype=torch.float32) for part in zip(*intervals, strict=True))
    return sigma, torch.cat([torch.ones(1), 1 + lengths.cumsum(0)])


def weights_of(backend: Backend, sigma: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Of one packed ray: weights and opacity."""
    count = len(sigma)
    samples = Samples(torch.tensor([0, count]).int(), torch.zeros(count).int(), t[:-1].contiguous(), t.diff())
    rendering, weights = backend.composite(samples, sigma, torch.ones(count, 3), torch.zeros(1, 3), t[-1:].contiguous())
    return weights, rendering.opacity[0]


@BACKENDS
@given(intervals=INTERVALS)
def test_weights_partition_the_light(backend: Backend, intervals: list[tuple[float, float]]) -> None:
    """Each in [0, 1], together at most 1 and the opacity; what is left falls from interval to interval."""
    sigma, t = one_ray(intervals)
    for weights, opacity in (weights_of(backend, sigma, t), _unpacked(sigma, t)):
        assert ((weights >= 0) & (weights <= 1)).all() and 0 <= opacity <= 1
        assert float(weights.double().sum()) == pytest.approx(float(opacity), abs=len(sigma) * EPSILON)
        left = 1 - weights.double().cumsum(0)
        assert (left.diff() <= 0).all() and left[-1] >= -len(sigma) * EPSILON


def _unpacked(sigma: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    weights, depth = volume_weights(sigma, t)
    return weights, -torch.expm1(-depth)


@BACKENDS
@given(intervals=INTERVALS, order=st.randoms())
def test_opacity_does_not_depend_on_the_order_of_intervals(backend: Backend, intervals, order) -> None:
    shuffled = list(intervals)
    order.shuffle(shuffled)
    for measure in (lambda *ray: weights_of(backend, *ray), _unpacked):
        opacity, again = (float(measure(*one_ray(each))[1]) for each in (intervals, shuffled))
        assert again == pytest.approx(opacity, abs=1e-5)


@BACKENDS
@given(intervals=INTERVALS, at=st.integers(0, 11), share=FRACTION)
def test_splitting_an_interval_changes_nothing(backend: Backend, intervals, at: int, share: float) -> None:
    """It is cut where float32 can tell the cut; tau of 1e30 times a rounded length is opaque all the same."""
    sigma, t = one_ray(intervals)
    at %= len(sigma)
    cut = torch.lerp(t[at], t[at + 1], share)
    finer = torch.cat([t[: at + 1], cut[None], t[at + 1 :]])
    twice = torch.cat([sigma[: at + 1], sigma[at:]])
    for measure in (lambda *ray: weights_of(backend, *ray), _unpacked):
        weights, opacity = measure(sigma, t)
        finer_weights, finer_opacity = measure(twice, finer)
        assert float(finer_opacity) == pytest.approx(float(opacity), abs=1e-5)
        assert float(finer_weights[at : at + 2].sum()) == pytest.approx(float(weights[at]), abs=1e-5)


def test_a_white_ray_before_white_is_white_however_dense() -> None:
    sigma, t = one_ray([(0.0, 1.0), (1e-30, 2.0), (0.3, 1.0), (1e30, 1.0), (5.0, 0.0)])
    seen, _ = composite(sigma, torch.ones(5, 3), t, torch.ones(3))
    torch.testing.assert_close(seen.colour, torch.ones(3))


@given(st.lists(st.floats(0, 1, width=32), min_size=4, max_size=4), st.lists(FRACTION, min_size=2, max_size=9))
def test_the_inverse_cdf_ascends_with_u_within_the_bins(weights: list[float], us: list[float]) -> None:
    """Bins of no length among them."""
    edges = torch.tensor([0.5, 1.0, 1.0, 4.0, 8.0])
    t = invert_cdf(edges, torch.tensor(weights), torch.tensor([0.0, *sorted(us), 1.0]))
    assert t.isfinite().all() and t[0] >= 0.5 and t[-1] <= 8 and (t.diff() >= -8 * EPSILON).all()


@given(NUMBER)
def test_the_encoding_has_period_two_up_to_a_million(x: float) -> None:
    """As far as float32 can say x + 2: the true number is taken from what it says."""
    encoded = positional_encoding(torch.tensor([[x], [x + 2.0]]), 16)
    shift = float(torch.tensor([x + 2.0], dtype=torch.float32).double() - torch.tensor([x]).double()) - 2
    assert encoded.isfinite().all() and encoded.abs().max() <= 1
    if shift == 0:
        assert (encoded[0] - encoded[1]).abs().max() < 1e-6


@given(st.lists(st.floats(-(2.0**60), 2.0**60, width=32), min_size=3, max_size=3))
def test_contraction_keeps_directions_and_order(point: list[float]) -> None:
    x = torch.tensor(point)
    y, farther = contract(x), contract(2 * x)
    assert y.abs().max() <= 2 and (farther.abs() + DENORMAL >= y.abs() * (1 - 4 * EPSILON)).all()
    assert (y * x.sign() >= 0).all()
    if x.abs().max() < 100:
        torch.testing.assert_close(uncontract(y), x, rtol=2e-4, atol=DENORMAL)


@given(st.lists(st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5]), min_size=3, max_size=3), st.floats(-3, 3, width=32))
def test_axis_parallel_rays_meet_the_box_where_it_is(towards: list[float], at: float) -> None:
    """From inside, from outside, away from it and past it; both backends march nowhere else. A ray that runs within a
    face may count either way."""
    assume(abs(at) != float(torch.tensor(Box.half)))
    if not any(towards):
        towards = [0.0, 1.0, 0.0]
    directions = torch.nn.functional.normalize(torch.tensor([towards]), dim=-1)
    rays = Rays(torch.tensor([[at, 0.1, -0.2]]), directions, torch.zeros(1), torch.tensor([10.0]))
    cut = clip_to_box(rays, -Box.half, Box.half)
    t = torch.linspace(0, 10, 5001)
    inside = ((rays.origins + t[:, None] * directions).abs() <= Box.half).all(-1).double().mean() * 10
    assert float(cut.far - cut.near) == pytest.approx(float(inside), abs=5e-3)
    where, stepping = binary_occupancy(torch.full((8,), -1)), RayStepping(0.05, 0.0, False, 8, 1000)
    for backend in (reference, warp):
        samples = backend.march(where, stepping, rays, torch.full((1,), 0.5))
        assert ((samples.t >= cut.near) & (samples.t <= cut.far)).all()
        assert float(samples.dt.sum()) == pytest.approx(float(cut.far - cut.near), abs=0.051)


@BACKENDS
@given(st.integers(0, 48), FRACTION, FRACTION, st.sampled_from([3, 12, 48]))
def test_features_are_continuous_at_cell_borders(backend: Backend, vertex, y: float, z: float, cells: int) -> None:
    """The last float32 before a face and the first behind it differ by no more than they are apart."""
    face = torch.tensor((vertex % (cells + 1)) / cells)
    x = torch.stack([torch.nextafter(face, torch.tensor(-1.0)), face, torch.nextafter(face, torch.tensor(2.0))])
    points = torch.stack([x, torch.full((3,), y), torch.full((3,), z)], -1)
    table = torch.randn(LAYOUT.rows, 4, generator=torch.Generator().manual_seed(1))
    features = backend.encode(LAYOUT, table, points)
    assert features.diff(dim=0).abs().max() < 48 * 4 * EPSILON * float(table.abs().max())
    ones = backend.encode(LAYOUT, torch.ones_like(table), points)
    torch.testing.assert_close(ones, torch.ones_like(ones), rtol=0, atol=1e-6)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(0, 2 * math.pi))
def test_harmonics_of_one_degree_keep_their_length_under_turns(vector: list[float], angle: float) -> None:
    if math.hypot(*vector) < 1e-3:
        vector = [0.0, 0.0, 1.0]
    d = torch.nn.functional.normalize(torch.tensor([vector], dtype=torch.float32), dim=-1)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    values = reference.spherical_harmonics(torch.cat([d, d @ turn.T])).square()
    for degree in range(4):
        own = values[:, degree**2 : (degree + 1) ** 2].sum(-1)
        torch.testing.assert_close(own, torch.full((2,), (2 * degree + 1) / (4 * math.pi)), rtol=1e-5, atol=0)


@given(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3))
def test_every_point_has_a_cell_of_the_cache(point: list[float]) -> None:
    assert 0 <= int(cell_numbers(8, torch.tensor(point, dtype=torch.float32))) < 512


@given(st.lists(FRACTION, min_size=3, max_size=3), st.lists(FRACTION, min_size=3, max_size=3))
@settings(max_examples=25)
def test_ssim_of_flat_pictures_is_that_of_their_means(a: list[float], b: list[float]) -> None:
    """Nothing varies: similarity is (2 ab + c) / (a² + b² + c), and E[x²] - E[x]² must not make more of it."""
    one, other = (torch.tensor(colour).expand(14, 15, 3).contiguous() for colour in (a, b))
    similarity = ssim(one, other)
    wanted = np.mean([(2 * x * y + 1e-4) / (x * x + y * y + 1e-4) for x, y in zip(a, b, strict=True)])
    assert similarity == pytest.approx(wanted, abs=3e-4)
    assert ssim(one, one) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("density", [0.0, 1e-30, 3.0, 1e30])
def test_a_grid_without_a_surface_is_refused(density: float) -> None:
    """Empty, full, constant: no level lies strictly inside."""
    corner = torch.ones(3)
    with refused("mesh.too-thin", "density 7"):
        extract_surface(DensityGrid(torch.full((6, 6, 6), density), -corner, corner), 7.0)


@pytest.mark.parametrize("density", [1e4, 1e30])
def test_full_vertices_close_a_surface_single_ones_vanish(
    density: float,
) -> None:
    values = torch.zeros(7, 7, 7)
    values[2:5, 2:5, 2:5] = density
    surface = extract_surface(DensityGrid(values, -torch.ones(3), torch.ones(3)), 7.0)
    assert is_watertight(surface) and np.isfinite(surface.vertices).all()
    assert 1 / 3 < np.abs(surface.vertices).max() < 2 / 3
    alone = torch.zeros(7, 7, 7)
    alone[3, 3, 3] = density
    with refused("mesh.too-thin"):
        extract_surface(DensityGrid(alone, -torch.ones(3), torch.ones(3)), 7.0)
