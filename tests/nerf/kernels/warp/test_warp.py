"""Warp's kernels give what the torch reference gives, in value and gradient, and refuse what they cannot read.

Marching and compositing have files of their own; how close is close enough: agreement.py.
"""

import math
import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from nerf.kernels import Backend, Layers, grid_layout, warp
from nerf.kernels import torch as reference
from nerf.kernels.warp import occupancy
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.mlp import TILE
from tests.devices import skip_without
from tests.nerf.kernels.agreement import (
    BOUNDED,
    CONTRACTED,
    COUNTS,
    TOLERANCE,
    agree,
    assert_each_close,
    normal,
    occupied_of,
    packed,
    random_rays,
    relative_error,
    uniform,
)


def test_the_measure_of_error_sees_errors() -> None:
    wanted = torch.tensor([3.0, 1e-3, 0.0])
    assert relative_error(wanted.clone(), wanted) == 0
    assert relative_error(wanted + 0.03, wanted) == pytest.approx(0.01, rel=1e-5)
    with pytest.raises(AssertionError):
        relative_error(torch.tensor([math.nan]), torch.tensor([1.0]))
    assert_each_close(wanted, wanted.double(), 0.0)
    for wrong in ([3.0, 1.02e-3, 0.0], [3.0, 1e-3, 1e-6], [3.0, 1e-3, math.nan]):
        with pytest.raises(AssertionError):
            assert_each_close(torch.tensor(wrong), wanted.double(), 1e-7)


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
def test_encoding_of_any_points(device: str, layout) -> None:
    """In float32 on both sides: which cell a point is in, and where in it, is rounded alike."""
    table, points = normal(device, 2, layout.rows, 4), 1.4 * uniform(device, 39, 3001, 3) - 0.2
    assert not torch.equal(points, (points * 8192).round() / 8192)
    features = warp.encode(layout, table, points)
    assert relative_error(features, reference.encode(layout, table, points)) < TOLERANCE
    of_points = warp.encode_backward_points(layout, table, points, features)
    assert relative_error(of_points, reference.encode_backward_points(layout, table, points, features)) < TOLERANCE


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_gradients_of_the_encoding(device: str, layout) -> None:
    table, points = normal(device, 2, layout.rows, 4), grid_points(device)
    grad = normal(device, 3, len(points), layout.width)
    agree("encode_backward_points", layout, table, points, grad)
    given, wanted = normal(device, 4, layout.rows, 4), normal(device, 4, layout.rows, 4).double()
    for level, (first, end) in enumerate(pairwise(layout.level_offsets)):
        before = given.clone()
        warp.encode_backward_table(layout, range(level, level + 1), points, grad, given)
        reference.encode_backward_table(layout, range(level, level + 1), points.double(), grad.double(), wanted)
        outside = torch.ones(layout.rows, dtype=torch.bool, device=device)
        outside[first:end] = False
        assert torch.equal(given[outside], before[outside]), "levels share no rows"
        assert relative_error(given, wanted) < TOLERANCE


def test_a_grid_of_other_features_is_refused() -> None:
    layout = grid_layout(2, 2, 4, 10, 2)
    with pytest.raises(ValueError, match="these kernels are for 4 features per vertex, not 2"):
        warp.encode(layout, torch.zeros(layout.rows, 2), torch.zeros(3, 3))


# Directions


@pytest.mark.parametrize("rays", [0, 320])
def test_spherical_harmonics(device: str, rays: int) -> None:
    agree("spherical_harmonics", torch.nn.functional.normalize(normal(device, 22, rays, 3), dim=-1))


# Networks


@pytest.mark.parametrize("outputs", [3, 16, 17])
@pytest.mark.parametrize("inputs", [4, 16, 20, 32, 36])
def test_networks_and_their_gradients(device: str, inputs: int, outputs: int) -> None:
    samples, layers = packed(device, COUNTS), Layers(normal(device, 27, inputs, 64), normal(device, 28, outputs, 64))
    ray_hidden, count = normal(device, 29, len(COUNTS), 64), sum(COUNTS)
    ray_hidden[5:8, ::2] = 0
    given, grad = normal(device, 30, count, inputs), normal(device, 26, count, outputs)
    for few in (count, 1, 7, TILE, TILE + 1):
        agree("mlp_forward", layers, given[:few])
        agree("mlp_forward", layers, given[:few], samples.ray.flip(0)[:few], ray_hidden)
        assert agree("mlp_backward", layers, given[:few], grad[:few]).ray_hidden is None
    agree("mlp_backward", layers, given, grad, samples, ray_hidden)


def test_what_is_not_positive_has_no_gradient(device: str) -> None:
    """Zeros of both signs and the smallest and largest numbers of float32, each in hidden units of its own."""
    units = torch.tensor([0.0, -0.0, 1e-45, -1e-45, 1e-38, 3e38, -3e38, 1e-20], device=device).repeat(8)
    layers = Layers(torch.stack([units, *torch.zeros(3, 64, device=device)]), torch.ones(4, 64, device=device))
    inputs = torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(50, 1)
    found = warp.mlp_backward(layers, inputs, torch.ones(50, 4, device=device))
    assert torch.equal(found.hidden[0], 200.0 * (units > 0)) and not found.hidden[1:].any()
    assert torch.equal(warp.mlp_forward(layers, 0 * inputs), torch.zeros(50, 4, device=device))


# Adam

# Of parameter, gradient, mean and square. Parameters and means are sums of numbers up to 10 that may cancel, of which
# float32 has the sixth digit behind the point; squares do not, but the least of them are below float32.
FLOORS = 1e-6, 0.0, 1e-6, 1e-37


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
    for one, right, floor in zip(given, wanted, FLOORS, strict=True):
        assert_each_close(one, right, floor)
    assert not given[1].any()
    still = before[1] == 0
    for one, old in zip(given, before, strict=True):
        assert torch.equal(one[still], old[still]), "an entry without gradient changes nothing"
    moved = given[0] != before[0]
    assert not moved[still].any() and (size < 100 or moved.float().mean() > 0.3)


def test_the_smallest_gradients_move_what_has_no_past(device: str) -> None:
    """A gradient of 1e-20 counts as much as one of 1: its square is below float32, EPSILON stands in for its root;
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
    for one, right, old, floor in zip(whole, wanted, before, FLOORS, strict=True):
        assert_each_close(one, right, floor)
        assert torch.equal(one[[0, *range(40, 43), 44]], old[[0, *range(40, 43), 44]])


# The occupancy grid


@pytest.mark.parametrize("cells", [4, 32])
def test_the_cache_is_the_reference_s_bit_for_bit(device: str, cells: int) -> None:
    """Several points in one cell; points on and beyond the border; values below what there is."""
    given = uniform(device, 37, cells**3)
    wanted, before = given.clone(), given.clone()
    points, values = grid_points(device), uniform(device, 38, 3001)
    warp.scatter_max(cells, given, points, values)
    reference.scatter_max(cells, wanted, points, values)
    assert torch.equal(given, wanted)
    assert (given > before).float().mean() > 0.01 and not (given < before).any()
    assert torch.equal(warp.occupancy_bits(given, 0.5), reference.occupancy_bits(given, 0.5))


def test_a_cell_at_the_threshold_is_empty(device: str) -> None:
    thickness = torch.full((64,), 0.01, device=device)
    thickness[63] = 0.0100001
    assert warp.occupancy_bits(thickness, 0.01).tolist() == [-(1 << 63)]


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
        few = some.each(lambda part: part[:rays])
        for stepping in (BOUNDED, CONTRACTED):
            marched = warp.march(nowhere, stepping, few, few.near)
            assert marched.starts.tolist() == [0] * (rays + 1) and len(marched.t) == 0
            agree("sample_points", few, samples, stepping.contracted)
            agree("sample_points_backward", few, samples, stepping.contracted, none)
            agree("distortion", samples, empty, stepping)
            agree("distortion_backward", samples, empty, stepping, few.near)
        table = torch.ones(layout.rows, 4, device=device)
        features = agree("encode", layout, table, none)
        agree("encode_backward_points", layout, table, none, features)
        warp.encode_backward_table(layout, range(1), none, features, table)
        agree("visible_samples", samples, empty, 0.5, 0.1, few.near)
        agree("spherical_harmonics", few.directions)
        agree("pack_rounds", [samples, samples])
        depth, near = torch.zeros(rays, dtype=torch.float64, device=device), few.near.clone()
        warp.finish_round(CONTRACTED, samples, empty, 0.5, few.near, few.far, depth, near)
        assert torch.equal(near, few.far) and not depth.any()
        inputs = samples, empty, none, few.directions, few.far
        rendering, _ = agree("composite", *inputs)
        assert torch.equal(rendering.colour, few.directions) and torch.equal(rendering.depth, few.far)
        agree("composite_backward", *inputs, rendering, empty)
        layers, ray_hidden = Layers(*torch.ones(2, 3, 64, device=device)), torch.ones(rays, 64, device=device)
        agree("mlp_forward", layers, none, samples.ray, ray_hidden)
        assert not any(each.any() for each in agree("mlp_backward", layers, none, none, samples, ray_hidden))
        warp.scatter_max(4, torch.ones(64, device=device), none, empty)

    on_a_new_thread(everything)


KERNEL: Any = occupancy._scatter_max
GOOD = torch.zeros(8, 3)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (GOOD.double(), r"points must be contiguous torch.float32 in .* 3 on cpu; it is \(8, 3\) torch.float64"),
        (GOOD.int(), r"points must be contiguous torch.float32 in entries of 3 on cpu; it is \(8, 3\) torch.int32"),
        (torch.zeros(3, 8).T, r"points must be contiguous .*; it is \(8, 3\) torch.float32, not contiguous"),
        (torch.zeros(8, 4)[:, :3], r"points must be contiguous .*; it is \(8, 3\) torch.float32, not contiguous"),
        (torch.zeros(8), r"points must be .* in entries of 3 on cpu; it is \(8,\) torch.float32, contiguous"),
    ],
)
def test_what_a_kernel_cannot_read_is_refused_by_name(points: Tensor, message: str) -> None:
    """A recorded launch looks as closely as the one that is recorded."""
    arguments = torch.zeros(64), points, torch.zeros(8)
    with pytest.raises(TypeError, match=f"_scatter_max: {message}"):
        on_a_new_thread(lambda: launch(KERNEL, 8, 4, *arguments))
    launch(KERNEL, 8, 4, arguments[0], GOOD, arguments[2])
    with pytest.raises(TypeError, match=f"_scatter_max: {message}"):
        launch(KERNEL, 8, 4, *arguments)


def test_tensors_in_two_memories_are_refused() -> None:
    """A tensor of no memory stands for one of another GPU: whether it is on a GPU at all tells neither."""
    with pytest.raises(TypeError, match=r"_scatter_max: points must be .* on cpu; it is .*, contiguous, on meta"):
        launch(KERNEL, 8, 4, torch.zeros(64), GOOD.to("meta"), torch.zeros(8))


@pytest.mark.gpu
@pytest.mark.parametrize("other", ["cpu", "cuda:1"])
def test_tensors_on_a_gpu_and_elsewhere_are_refused(other: str) -> None:
    skip_without("cuda")
    if other == "cuda:1" and torch.cuda.device_count() < 2:
        pytest.skip("no second GPU")
    with pytest.raises(TypeError, match=f"_scatter_max: points must be .* on cuda:0; it is .*, contiguous, on {other}"):
        launch(KERNEL, 8, 4, torch.zeros(64, device="cuda:0"), GOOD.to(other), torch.zeros(8, device="cuda:0"))


def test_numbers_and_tensors_are_not_confused() -> None:
    thickness, values = torch.zeros(64), torch.zeros(8)
    with pytest.raises(TypeError, match=r"_scatter_max: cells must be a number; it is \(8,\) torch.float32"):
        on_a_new_thread(lambda: launch(KERNEL, 8, values, thickness, GOOD, values))
    with pytest.raises(
        TypeError, match=r"_scatter_max: values must be contiguous .* in entries of 1 on cpu; it is 2.0"
    ):
        on_a_new_thread(lambda: launch(KERNEL, 8, 4, thickness, GOOD, 2.0))
