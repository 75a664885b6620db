"""Warp's kernels give what the torch reference gives, in value and gradient.

They are compared with the reference in float64 on the same float32 inputs. ``relative_error`` is the largest
difference over the largest wanted number, of the whole tensor unless said otherwise: single entries may be
differences of large numbers, of which no float32 program has more digits.
"""

import math
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nerf.contraction import uncontract
from nerf.kernels import BOX, Backend, Lattice, Occupied, Samples, grid_layout, reference, warp
from nerf.kernels.cache import cell_corners, cell_numbers, occupied
from nerf.kernels.marching import lattice_coordinate, unit_coordinates
from nerf.kernels.warp import cache
from nerf.kernels.warp.launch import launch
from nerf.model import Rendering
from nerf.rays import Rays, clip_to_box
from tests.devices import DEVICES, skip_without

TOLERANCE = 1e-5
BOUNDED = Lattice(2 * BOX * 3**0.5 / 256, 0.0, False, 32, 1024)
FOLDED = Lattice(0.01, 0.02, True, 32, 1024)
LATTICES = {"bounded": BOUNDED, "folded": FOLDED}


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """Everything below runs on the CPU and, where there is one, on a GPU."""
    skip_without(request.param)
    with torch.device(request.param):
        yield request.param


def generator(device: str, seed: int) -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def normal(device: str, seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=generator(device, seed), device=device)


def uniform(device: str, seed: int, *shape: int) -> Tensor:
    return torch.rand(shape, generator=generator(device, seed), device=device)


def doubled(value: Any) -> Any:
    """Floating-point tensors as float64, also within tuples; everything else as it is."""
    if isinstance(value, tuple):
        parts = [doubled(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def relative_error(found: Tensor, wanted: Tensor) -> float:
    assert found.dtype == torch.float32 and found.shape == wanted.shape and found.isfinite().all()
    if not wanted.numel():
        return 0.0
    largest = float(wanted.abs().max())
    difference = float((found.double() - wanted.double()).abs().max())
    return difference / largest if largest else difference


def tensors_in(result: Any) -> list[Tensor]:
    return [result] if isinstance(result, Tensor) else [tensor for part in result for tensor in tensors_in(part)]


def agree(function: str, *arguments: Any, tolerance: float = TOLERANCE) -> Any:
    """Warp's result, once it is known to be the reference's."""
    result = getattr(warp, function)(*arguments)
    wanted = getattr(reference, function)(*doubled(arguments))
    for one, right in zip(tensors_in(result), tensors_in(wanted), strict=True):
        if right.is_floating_point():
            assert relative_error(one, right) < tolerance, function
        else:
            assert torch.equal(one, right), function
    return result


def test_the_measure_of_error_sees_errors() -> None:
    wanted = torch.tensor([3.0, 1e-3, 0.0])
    assert relative_error(wanted.clone(), wanted) == 0
    assert relative_error(wanted + 0.03, wanted) == pytest.approx(0.01, rel=1e-5)
    with pytest.raises(AssertionError):
        relative_error(torch.tensor([math.nan]), torch.tensor([1.0]))


def test_it_is_a_backend() -> None:
    assert isinstance(warp, Backend) and isinstance(reference, Backend)
    for shared in ("spherical_harmonics_backward", "cell_corners"):
        assert getattr(warp, shared) is getattr(reference, shared), "tested as the reference's"


# Grids

LAYOUTS = {
    "dense": grid_layout(3, 2, 8, 18, 4),
    "dense and hashed": grid_layout(5, 4, 64, 12, 4),
    "hashed": grid_layout(2, 50, 384, 8, 4),
    "one": grid_layout(1, 1, 1, 18, 4),
    "sixteen": grid_layout(16, 3, 700, 10, 4),
}


def grid_points(device: str, count: int = 3001) -> Tensor:
    """Inside, on and beyond the border. Multiples of 2^-13, so that float32 is exact in saying which cell is theirs."""
    points = 1.4 * uniform(device, 1, count, 3) - 0.2
    points[:100] = points[:100].round()
    points[100:200, 1] = 1.0
    points[200:300] *= 100
    return (points * 8192).round() / 8192


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_encoding(device: str, layout) -> None:
    table, points = normal(device, 2, layout.rows, 4), grid_points(device)
    features = agree("encode", layout, table, points)
    assert features.shape == (len(points), layout.width)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_gradients_of_the_encoding(device: str, layout) -> None:
    table, points = normal(device, 2, layout.rows, 4), grid_points(device)
    grad = normal(device, 3, len(points), layout.width)
    agree("encode_backward_points", layout, table, points, grad)
    given, wanted = normal(device, 4, layout.rows, 4), normal(device, 4, layout.rows, 4).double()
    for level, (first, end) in enumerate(pairwise(layout.first_rows)):
        before = given.clone()
        warp.encode_backward_table(layout, level, points, grad, given)
        reference.encode_backward_table(layout, level, points.double(), grad.double(), wanted)
        outside = torch.ones(layout.rows, dtype=torch.bool, device=device)
        outside[first:end] = False
        assert torch.equal(given[outside], before[outside]), "levels share no rows"
        assert relative_error(given, wanted) < TOLERANCE


def test_a_grid_of_other_features_is_refused() -> None:
    layout = grid_layout(2, 2, 4, 10, 2)
    with pytest.raises(ValueError, match="these kernels are for 4 features per vertex, not 2"):
        warp.encode(layout, torch.zeros(layout.rows, 2), torch.zeros(3, 3))


# Marching


def rays_of(origins: Tensor, directions: Tensor, near: float, far: float) -> Rays:
    ends = (torch.full_like(origins[:, 0], end) for end in (near, far))
    return Rays(origins, directions / directions.norm(dim=-1, keepdim=True), *ends)


def random_rays(device: str, count: int, far: float = 30.0) -> Rays:
    """Origins inside and outside, some directions along one or two axes, some rays that begin on the box."""
    origins, directions = 1.5 * normal(device, 5, count, 3), normal(device, 6, count, 3)
    part = count // 16
    directions[:part, 0] = 0
    directions[part : 2 * part, 1:] = 0
    directions[2 * part : 3 * part, :2] = -0.0
    origins[3 * part : 4 * part, 2] = BOX
    origins[4 * part : 5 * part] = origins[4 * part : 5 * part].clamp(-0.5, 0.5)
    return rays_of(origins, directions, 0.05, far)


def occupied_of(device: str, kind: str, cells: int) -> Occupied:
    if kind in ("empty", "full"):
        return occupied(torch.full((cells**3 // 64,), -1 if kind == "full" else 0, device=device))
    thickness = uniform(device, 7, cells**3)
    if kind == "bricks":  # three bricks of ten, all of their cells
        return occupied(-(thickness.view(-1, 64)[:, 0] < 0.3).long())
    return occupied(reference.occupied_bits(thickness, {"random": 0.5, "sparse": 0.97}[kind]))


def places(lattice: Lattice, rays: Rays, jitter: Tensor, samples: Samples) -> Tensor:
    """Ray and number k on the lattice of each sample, as one integer."""
    near = rays.near if lattice.contracted else clip_to_box(rays, BOX).near
    ray = samples.ray.long()
    k = lattice_coordinate(lattice, samples.t) - (lattice_coordinate(lattice, near) + jitter)[ray]
    assert not len(k) or (k - k.round()).abs().max() < 0.3
    return (ray << 24) + k.round().long()


def decided_by_rounding(lattice: Lattice, rays: Rays, samples: Samples) -> Tensor:
    """Samples so near to a face of their cell, or to far, that the last digit of exp() decides."""
    origin, direction, _, far = (part[samples.ray.long()].double() for part in rays)
    t = samples.t.double()
    scaled = lattice.cells * unit_coordinates(origin + t[:, None] * direction, lattice.contracted)
    to_face = (scaled - scaled.round()).abs().amin(-1)
    return (to_face < 1e-6 * lattice.cells) | ((t / far - 1).abs() < 1e-6)


def assert_same_march(where: Occupied, lattice: Lattice, rays: Rays, jitter: Tensor) -> Samples:
    """Bounded, where samples are a step apart, both give the same numbers on the CPU; folded, exp() and log() may
    differ by their last digit: t by 1e-6 of itself, dt, a difference of two distances, by 1e-6 of t. So may everything
    on a GPU, where torch divides by a number by multiplying with its inverse."""
    given, wanted = (backend.march(where, lattice, rays, jitter) for backend in (warp, reference))
    at, right = (places(lattice, rays, jitter, samples) for samples in (given, wanted))
    in_both, common = torch.isin(at, right), torch.isin(right, at)
    assert decided_by_rounding(lattice, rays, given)[~in_both].all(), "a sample in an empty cell"
    assert decided_by_rounding(lattice, rays, wanted)[~common].all(), "a sample was lost"
    most = (1e-3 if right.is_cuda else 1e-5) * len(right)
    assert (~common).sum() <= most and (~in_both).sum() <= most
    a, b = given.t[in_both], wanted.t[common]
    tolerance = 1e-6 * b if lattice.cone or b.is_cuda else 0 * b
    assert ((a - b).abs() <= tolerance).all()
    assert ((given.dt[in_both] - wanted.dt[common]).abs() <= tolerance).all()
    assert torch.equal(given.starts.diff().long(), torch.bincount(given.ray, minlength=len(jitter)))
    assert given.starts[0] == 0 and given.starts.dtype == given.ray.dtype == torch.int32
    return given


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
@pytest.mark.parametrize("cells", [4, 12, 32, 128])
@pytest.mark.parametrize("kind", ["random", "sparse", "bricks", "full", "empty"])
def test_marching(device: str, kind: str, cells: int, lattice: Lattice) -> None:
    rays = random_rays(device, 320)
    samples = assert_same_march(
        occupied_of(device, kind, cells), lattice._replace(cells=cells), rays, uniform(device, 8, 320)
    )
    assert kind != "empty" or len(samples.t) == 0
    assert kind == "empty" or cells == 4 or len(samples.t) > 20


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
@pytest.mark.parametrize("most", [1, 17])
def test_marching_stops_at_the_cap(device: str, most: int, lattice: Lattice) -> None:
    rays = random_rays(device, 320)
    where = occupied_of(device, "random", 32)
    samples = assert_same_march(where, lattice._replace(most_samples=most), rays, uniform(device, 8, 320))
    assert samples.starts.diff().max() == most


def test_marching_from_far_away_in_folded_space(device: str) -> None:
    rays = random_rays(device, 320, far=1e7)
    origins = rays.origins * torch.logspace(0, 6, 320)[:, None]
    samples = assert_same_march(
        occupied_of(device, "full", 16),
        FOLDED._replace(cells=16),
        rays._replace(origins=origins),
        uniform(device, 8, 320),
    )
    assert samples.t.max() > 5e6


def aimed_rays(device: str, lattice: Lattice, cell: int, count: int) -> Rays:
    """Rays through one cell of the cache: through its inside, its edges and corners, and along its faces."""
    corner = cell_corners(lattice.cells, torch.tensor([cell], device=device))
    inside = uniform(device, 9, count, 3)
    inside[: count // 3] = inside[: count // 3].round()
    unit = (corner + inside / lattice.cells).clamp(1e-6, 1 - 1e-6)
    aim = uncontract(4 * unit - 2) if lattice.contracted else BOX * (2 * unit - 1)
    origins = 3 * normal(device, 10, count, 3)
    origins[: count // 2] /= 10
    share = count // 8
    origins[:share, 0] = aim[:share, 0]  # directions along a face
    origins[share // 2 : share, 1] = aim[share // 2 : share, 1]
    return rays_of(origins, aim - origins, 0.01, 1e3 if lattice.contracted else 30.0)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
@pytest.mark.parametrize("cells", [4, 8, 20, 64])
def test_skipping_bricks_loses_no_sample(device: str, cells: int, lattice: Lattice) -> None:
    """Bit for bit: the samples in the one occupied cell are those that a full cache has there."""
    lattice = lattice._replace(cells=cells, most_samples=4096)
    full = occupied_of(device, "full", cells)
    for cell in (0, cells**3 // 2, 7 * cells**3 // 9, cells**3 - 1):
        rays, jitter = aimed_rays(device, lattice, cell, 1000), uniform(device, 11, 1000)
        every = warp.march(full, lattice, rays, jitter)
        here = cell_numbers(cells, warp.sample_points(rays, every, lattice.contracted)) == cell
        bits = torch.zeros_like(full.bits)
        bits[cell >> 6] = 1 << (cell & 63) if cell & 63 != 63 else -(1 << 63)
        found = warp.march(occupied(bits), lattice, rays, jitter)
        assert here.sum() > 100
        for part, whole in zip(found[1:], every[1:], strict=True):
            assert torch.equal(part, whole[here])


@pytest.mark.parametrize("contracted", [False, True])
def test_sample_points(device: str, contracted: bool) -> None:
    rays = random_rays(device, 320)
    if contracted:
        rays = rays._replace(origins=rays.origins * torch.logspace(0, 6, 320)[:, None])
    lattice = FOLDED if contracted else BOUNDED
    samples = warp.march(occupied_of(device, "random", 32), lattice, rays, uniform(device, 8, 320))
    points = agree("sample_points", rays, samples, contracted)
    assert points.min() > -1e-6 and points.max() < 1 + 1e-6


@pytest.mark.parametrize("contracted", [False, True])
def test_gradients_of_sample_points(device: str, contracted: bool) -> None:
    """Ray by ray, as they fall with the square of the distance."""
    rays = random_rays(device, 320, far=1e3)
    lattice = FOLDED if contracted else BOUNDED
    samples = warp.march(occupied_of(device, "random", 32), lattice, rays, uniform(device, 8, 320))
    grad = normal(device, 12, len(samples.t), 3)
    given = warp.sample_points_backward(rays, samples, contracted, grad)
    wanted = reference.sample_points_backward(*doubled((rays, samples, contracted, grad)))
    assert contracted or 20 < sum(samples.starts.diff() == 0) < 300
    for one, right in zip(given, wanted, strict=True):
        assert max(relative_error(a, b) for a, b in zip(one, right, strict=True)) < TOLERANCE


@pytest.mark.parametrize("rays", [0, 320])
def test_spherical_harmonics(device: str, rays: int) -> None:
    agree("spherical_harmonics", torch.nn.functional.normalize(normal(device, 22, rays, 3), dim=-1))


# Compositing


def packed(device: str, counts: list[int], lengths: Tensor | None = None) -> Samples:
    starts = torch.tensor([0, *counts], device=device).cumsum(0).int()
    ray = torch.repeat_interleave(torch.arange(len(counts), device=device), starts.diff()).int()
    dt = 0.02 + 0.1 * uniform(device, 13, sum(counts)) if lengths is None else lengths
    t = torch.cat([dt[:0], *(0.1 + part.cumsum(0) for part in dt.split(counts))])
    return Samples(starts, ray, t - dt / 2, dt)


COUNTS = [0, 3, 1, 0, 0, 40, 1, 7, 128, 0]
EVEN, GROWING = LATTICES.values()


def seen(device: str, rays: int, samples: int) -> tuple[Tensor, Tensor, Tensor]:
    """Colours, background and far."""
    return uniform(device, 14, samples, 3), uniform(device, 15, rays, 3), 5 + 600 * uniform(device, 16, rays)


def gradients(device: str, rays: int, samples: int) -> tuple[Rendering, Tensor]:
    return (
        Rendering(normal(device, 17, rays, 3), normal(device, 18, rays), normal(device, 19, rays)),
        normal(device, 20, samples),
    )


@pytest.mark.parametrize("scale", [0.01, 1.0, 30.0, 1000.0])
def test_compositing_and_its_gradients(device: str, scale: float) -> None:
    samples, n = packed(device, COUNTS), sum(COUNTS)
    inputs = samples, scale * uniform(device, 21, n), *seen(device, len(COUNTS), n)
    agree("composite", *inputs)
    agree("composite_backward", *inputs, *gradients(device, len(COUNTS), n))


@pytest.mark.parametrize("density", [0.01, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("varied", [False, True])
def test_rays_of_4096_samples(device: str, varied: bool, density: float) -> None:
    """Equal ones, too: there the roundings of a sum all go the same way."""
    n = 4096 * 3
    each = uniform(device, 22, n) + 0.5 if varied else torch.ones(n, device=device)
    samples = packed(device, [4096] * 3, 0.001 * each)
    inputs = samples, density * each, *seen(device, 3, n)
    _, weights = agree("composite", *inputs, tolerance=1e-6)
    agree("composite_backward", *inputs, *gradients(device, 3, n), tolerance=1e-6)
    for lattice in (EVEN, GROWING):
        agree("distortion", samples, weights, lattice, tolerance=1e-6)
        agree("distortion_backward", samples, weights, lattice, normal(device, 23, 3), tolerance=1e-6)


THICKNESS = st.one_of(st.floats(0, 1e30), st.floats(0, 30), st.sampled_from([0.0, 1e-30, 800.0, 1e30]))


@given(st.lists(THICKNESS, max_size=12), st.lists(THICKNESS, max_size=3))
@settings(max_examples=200)
def test_thickness_from_nothing_to_1e30(first: list[float], second: list[float]) -> None:
    """Each ray by itself. What a sample adds to the gradient of its density is a difference, T g - behind - U G, of
    numbers up to the largest |g| and |G|: the error is relative to them, as to values of 1 in the rendering."""
    counts = [len(first), len(second)]
    samples = packed("cpu", counts, torch.ones(sum(counts)))
    sigma = torch.tensor([*first, *second])
    colour, background, far = seen("cpu", 2, sum(counts))
    inputs, grads = (samples, sigma, colour, background, far), gradients("cpu", 2, sum(counts))
    rendering, weights = warp.composite(*inputs)
    wanted, wanted_weights = reference.composite(*doubled(inputs))
    assert ((weights >= 0) & (weights <= 1)).all() and ((rendering.opacity >= 0) & (rendering.opacity <= 1)).all()
    pairs = list(zip([*rendering, weights], [*wanted, wanted_weights], strict=True))
    scales = [1.0, float(far.max()), 1.0, 1.0]
    on_seen, on_depth = grads[0].colour[samples.ray.long()], grads[0].depth[samples.ray.long()]
    g = grads[1] + (on_seen * colour).sum(-1) + on_depth * samples.t
    on_unstopped = (grads[0].colour * background).sum(-1) + grads[0].depth * far - grads[0].opacity
    scales += [float(torch.cat([g, on_unstopped]).abs().max()), float(grads[0].colour.abs().max())]
    pairs += zip(
        warp.composite_backward(*inputs, *grads), reference.composite_backward(*doubled((*inputs, *grads))), strict=True
    )
    for (one, right), scale in zip(pairs, scales, strict=True):
        assert one.isfinite().all()
        assert not one.numel() or float((one - right).abs().max()) < TOLERANCE * scale


def test_an_opaque_sample_has_exactly_no_gradient_and_hides_the_rest(device: str) -> None:
    samples = packed(device, [4])
    sigma = torch.tensor([0.0, 1e30, 1.0, 1.0], device=device)
    colour, background, far = seen(device, 1, 4)
    rendering, weights = warp.composite(samples, sigma, colour, background, far)
    assert weights.tolist() == [0, 1, 0, 0] and torch.equal(rendering.colour[0], colour[1])
    grad_sigma, grad_colour = warp.composite_backward(samples, sigma, colour, background, far, *gradients(device, 1, 4))
    assert grad_sigma[0] != 0 and grad_sigma[1:].tolist() == [0, 0, 0]
    assert grad_colour[[0, 2, 3]].abs().max() == 0


@pytest.mark.parametrize("threshold", [0.0, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("scale", [1.0, 100.0, 1e30])
def test_the_visible_front(device: str, scale: float, threshold: float) -> None:
    samples = packed(device, COUNTS)
    sigma = scale * uniform(device, 24, sum(COUNTS))
    front, _ = agree("visible_front", samples, sigma, threshold, tolerance=1e-30)
    kept = len(front.t) / sum(COUNTS)
    assert kept == 1 if threshold == 0 else 0 < kept < (0.3 if scale > 1 else 1.01)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
def test_distortion_and_its_gradient(device: str, lattice: Lattice) -> None:
    samples = packed(device, COUNTS)
    weights = uniform(device, 25, sum(COUNTS))
    agree("distortion", samples, weights, lattice)
    agree("distortion_backward", samples, weights, lattice, normal(device, 26, len(COUNTS)))


# The hidden layer


def hidden_of(device: str) -> Tensor:
    """With zeros of both signs and the smallest and largest numbers of float32."""
    hidden = normal(device, 27, sum(COUNTS), 64)
    extremes = torch.tensor([0.0, -0.0, 1e-45, -1e-45, 1e-38, 3e38, -3e38, 1e-20])
    return torch.where(uniform(device, 28, *hidden.shape) < 0.5, extremes.repeat(8), hidden)


def test_the_hidden_layer(device: str) -> None:
    samples, hidden = packed(device, COUNTS), hidden_of(device)
    of_ray = normal(device, 29, len(COUNTS), 64)
    of_ray[5:8, ::2] = 0
    given, wanted = hidden.clone(), hidden.clone()
    warp.add_ray_relu(samples, given, of_ray)
    reference.add_ray_relu(samples, wanted, of_ray)
    assert torch.equal(given, wanted) and 0.2 < (given > 0).float().mean() < 0.8


@pytest.mark.parametrize("function", ["add_ray_relu_backward", "relu_backward"])
def test_gradients_of_the_hidden_layer(device: str, function: str) -> None:
    samples, hidden = packed(device, COUNTS), hidden_of(device).relu()
    grad = normal(device, 30, *hidden.shape)
    given, wanted = grad.clone(), grad.double()
    arguments = (samples,) if function == "add_ray_relu_backward" else ()
    of_ray = getattr(warp, function)(*arguments, hidden, given)
    right = getattr(reference, function)(*doubled((*arguments, hidden)), wanted)
    assert torch.equal(given, torch.where(hidden > 0, grad, 0))
    assert (hidden[hidden > 0].min() < 1e-44) and torch.equal(given.double(), wanted)
    if right is not None:
        assert relative_error(of_ray, right) < TOLERANCE


# Adam


def adam_state(device: str, size: int) -> list[Tensor]:
    """Parameter, gradient, mean and square; half of the gradient is exactly zero, some of it as small as can be."""
    gradient = normal(device, 31, size) * 10 ** (8 * uniform(device, 32, size) - 6)
    kind = uniform(device, 33, size)
    gradient = torch.where(kind < 0.5, 0.0, gradient)
    gradient = torch.where(kind < 0.1, 1e-45, torch.where(kind > 0.9, -1e-38, gradient))
    return [normal(device, 34, size), gradient, normal(device, 35, size), uniform(device, 36, size)]


def both_adams(given: list[Tensor], wanted: list[Tensor], count: int, part: slice = slice(None)) -> None:
    for backend, state in ((warp, given), (reference, wanted)):
        parameter, gradient, mean, square = (tensor[part] for tensor in state)
        backend.adam(parameter, gradient, mean, square, 1e-2, count)


@pytest.mark.parametrize("count", [1, 2, 1000])
@pytest.mark.parametrize("size", [0, 1, 15, 16, 17, 100, 40_001])
def test_adam(device: str, size: int, count: int) -> None:
    given = adam_state(device, size)
    before, wanted = [tensor.clone() for tensor in given], [tensor.double() for tensor in given]
    both_adams(given, wanted, count)
    for one, right in zip(given, wanted, strict=True):
        assert relative_error(one, right) < TOLERANCE
    assert not given[1].any()
    still = before[1] == 0
    for one, old in zip(given, before, strict=True):
        assert torch.equal(one[still], old[still]), "an entry without gradient changes nothing"
    moved = given[0] != before[0]
    assert not moved[still].any() and (size < 100 or moved.float().mean() > 0.3)


def test_the_smallest_gradients_move_what_has_no_past(device: str) -> None:
    """A gradient of 1e-20 counts as much as one of 1: its square is below float32, LEAST_ROOT stands in for its root;
    of the smallest, 1e-45, the share in the mean already is below float32."""
    parameter, gradient, mean, square = (torch.zeros(16, device=device) for _ in range(4))
    gradient[:4] = torch.tensor([1e-20, 1e-10, 1.0, 1e-45])
    warp.adam(parameter, gradient, mean, square, 1e-2, 1)
    wanted = [-1e-2 * 1e-20 / 1e-15, -1e-2, -1e-2, 0.0]
    assert parameter[:4].tolist() == pytest.approx(wanted, rel=1e-4)


def test_adam_on_slices_leaves_their_neighbours_alone(device: str) -> None:
    """Slices that begin anywhere in memory: what is read sixteen at a time is not aligned to that."""
    whole = adam_state(device, 200)
    before, wanted = [tensor.clone() for tensor in whole], [tensor.double() for tensor in whole]
    for first, end in ((1, 40), (43, 44), (45, 45), (50, 66), (71, 199)):
        both_adams(whole, wanted, 3, slice(first, end))
        for tensor, old in zip(whole, before, strict=True):
            assert torch.equal(tensor[end:], old[end:])
    for one, right, old in zip(whole, wanted, before, strict=True):
        assert relative_error(one, right) < TOLERANCE
        assert torch.equal(one[[0, *range(40, 43), 44]], old[[0, *range(40, 43), 44]])


# The density cache


@pytest.mark.parametrize("cells", [4, 32])
def test_the_cache_is_the_reference_s_bit_for_bit(device: str, cells: int) -> None:
    """Several points in one cell; points on and beyond the border; values below what there is."""
    given = uniform(device, 37, cells**3)
    wanted, before = given.clone(), given.clone()
    points, values = grid_points(device), uniform(device, 38, 3001)
    warp.raise_cache(cells, given, points, values)
    reference.raise_cache(cells, wanted, points, values)
    assert torch.equal(given, wanted)
    assert (given > before).float().mean() > 0.01 and not (given < before).any()
    assert torch.equal(warp.occupied_bits(given, 0.5), reference.occupied_bits(given, 0.5))


def test_a_cell_at_the_threshold_is_empty(device: str) -> None:
    thickness = torch.full((64,), 0.01, device=device)
    thickness[63] = 0.0100001
    assert warp.occupied_bits(thickness, 0.01).tolist() == [-(1 << 63)]


# What holds for all


def on_a_new_thread(function: Callable[[], None]) -> None:
    """Launches are recorded once per thread: what is asked of a new one is its first."""
    failed: list[BaseException] = []

    def run() -> None:
        try:
            function()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if failed:
        raise failed[0]


@pytest.mark.parametrize("rays", [0, 3])
def test_no_rays_and_no_samples_are_fine_even_at_first(device: str, rays: int) -> None:
    counts = [0] * rays
    layout = LAYOUTS["dense and hashed"]

    def everything() -> None:
        samples, empty, none = packed(device, counts), torch.zeros(0, device=device), torch.zeros(0, 3, device=device)
        nowhere, some = occupied_of(device, "empty", 32), random_rays(device, 320)
        few = Rays(*(part[:rays] for part in some))
        for lattice in (BOUNDED, FOLDED):
            marched = warp.march(nowhere, lattice, few, few.near)
            assert marched.starts.tolist() == [0] * (rays + 1) and len(marched.t) == 0
            agree("sample_points", few, samples, lattice.contracted)
            agree("sample_points_backward", few, samples, lattice.contracted, none)
            agree("distortion", samples, empty, lattice)
            agree("distortion_backward", samples, empty, lattice, few.near)
        table = torch.ones(layout.rows, 4, device=device)
        features = agree("encode", layout, table, none)
        agree("encode_backward_points", layout, table, none, features)
        warp.encode_backward_table(layout, 0, none, features, table)
        agree("visible_front", samples, empty, 0.5)
        agree("spherical_harmonics", few.directions)
        agree("pack_waves", [samples, samples])
        depth, near = torch.zeros(rays, dtype=torch.float64, device=device), few.near.clone()
        warp.end_wave(FOLDED, samples, empty, 0.5, few.near, few.far, depth, near)
        assert torch.equal(near, few.far) and not depth.any()
        inputs = samples, empty, none, few.directions, few.far
        rendering, _ = agree("composite", *inputs)
        assert torch.equal(rendering.colour, few.directions) and torch.equal(rendering.depth, few.far)
        agree("composite_backward", *inputs, rendering, empty)
        hidden = torch.zeros(0, 64, device=device)
        warp.add_ray_relu(samples, hidden, torch.ones(rays, 64, device=device))
        assert not warp.add_ray_relu_backward(samples, hidden, hidden).any()
        warp.relu_backward(hidden, hidden)
        warp.raise_cache(4, torch.ones(64, device=device), none, empty)

    on_a_new_thread(everything)


KERNEL: Any = cache._raise
GOOD = torch.zeros(8, 3)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (GOOD.double(), r"points must be contiguous torch.float32 in entries of 3; it is \(8, 3\) torch.float64"),
        (GOOD.int(), r"points must be contiguous torch.float32 in entries of 3; it is \(8, 3\) torch.int32"),
        (torch.zeros(3, 8).T, r"points must be contiguous .*; it is \(8, 3\) torch.float32, not contiguous"),
        (torch.zeros(8, 4)[:, :3], r"points must be contiguous .*; it is \(8, 3\) torch.float32, not contiguous"),
        (torch.zeros(8), r"points must be .* in entries of 3; it is \(8,\) torch.float32, contiguous"),
    ],
)
def test_what_a_kernel_cannot_read_is_refused_by_name(points: Tensor, message: str) -> None:
    """A recorded launch looks as closely as the one that is recorded."""
    arguments = torch.zeros(64), points, torch.zeros(8)
    with pytest.raises(TypeError, match=f"_raise: {message}"):
        on_a_new_thread(lambda: launch(KERNEL, 8, 4, *arguments))
    launch(KERNEL, 8, 4, arguments[0], GOOD, arguments[2])
    with pytest.raises(TypeError, match=f"_raise: {message}"):
        launch(KERNEL, 8, 4, *arguments)


def test_numbers_and_tensors_are_not_confused() -> None:
    thickness, values = torch.zeros(64), torch.zeros(8)
    with pytest.raises(TypeError, match=r"_raise: cells must be a number; it is \(8,\) torch.float32"):
        on_a_new_thread(lambda: launch(KERNEL, 8, values, thickness, GOOD, values))
    with pytest.raises(TypeError, match=r"_raise: values must be contiguous torch.float32 in entries of 1; it is 2.0"):
        on_a_new_thread(lambda: launch(KERNEL, 8, 4, thickness, GOOD, 2.0))
