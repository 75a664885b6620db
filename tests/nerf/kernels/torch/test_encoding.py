import itertools

import pytest
import torch
from torch import Tensor

from nerf.kernels import GridLayout, grid_layout
from nerf.kernels.torch import encode, encode_backward_points, encode_backward_table

LAYOUT = grid_layout(num_levels=3, base_res=3, max_res=9, log2_hashmap_size=7, features_per_level=2)


def test_levels_grow_to_the_finest() -> None:
    assert grid_layout(
        num_levels=4, base_res=16, max_res=128, log2_hashmap_size=9, features_per_level=2
    ).resolutions == (16, 32, 64, 128)
    assert grid_layout(
        num_levels=1, base_res=16, max_res=128, log2_hashmap_size=9, features_per_level=2
    ).resolutions == (128,)


def random_inputs(layout: GridLayout = LAYOUT, count: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    table = torch.randn(layout.rows, layout.features, dtype=torch.float64, generator=generator)
    points = torch.rand(count, 3, dtype=torch.float64, generator=generator)
    return table, points, torch.randn(count, layout.width, dtype=torch.float64, generator=generator)


def row_of_vertex(layout: GridLayout, level: int, vertex: tuple[int, ...]) -> int:
    x, y, z = vertex
    if layout.is_hashed(level):
        number = (x ^ (y * 2654435761) & 0xFFFFFFFF ^ (z * 805459861) & 0xFFFFFFFF) % layout.level_rows(level)
    else:
        side = layout.resolutions[level] + 1
        number = (x * side + y) * side + z
    return layout.level_offsets[level] + number


def encoded_slowly(layout: GridLayout, table: Tensor, point: Tensor) -> list[float]:
    features = []
    for level, resolution in enumerate(layout.resolutions):
        cell = [min(int(c * resolution), resolution - 1) for c in point.tolist()]
        for feature in range(layout.features):
            value = 0.0
            for corner in itertools.product((0, 1), repeat=3):
                share = 1.0
                for c, low, up in zip(point.tolist(), cell, corner, strict=True):
                    u = c * resolution - low
                    share *= u if up else 1 - u
                row = row_of_vertex(layout, level, tuple(low + up for low, up in zip(cell, corner, strict=True)))
                value += share * table[row, feature].item()
            features.append(value)
    return features


def test_the_layout_is_dense_until_the_table_is_too_small() -> None:
    assert LAYOUT.resolutions == (3, 5, 9)
    assert LAYOUT.level_offsets == (0, 64, 64 + 128, 64 + 128 + 128)
    assert [LAYOUT.is_hashed(level) for level in range(3)] == [False, True, True]
    assert (LAYOUT.rows, LAYOUT.width) == (320, 6)
    assert grid_layout(1, 7, 7, 9, 4).level_offsets == (0, 512)
    assert not grid_layout(1, 7, 7, 9, 4).is_hashed(0)


def test_features_are_those_of_a_slow_loop() -> None:
    table, points, _ = random_inputs()
    slow = torch.tensor([encoded_slowly(LAYOUT, table, point) for point in points], dtype=torch.float64)
    torch.testing.assert_close(encode(LAYOUT, table, points), slow, rtol=0, atol=1e-12)


def test_a_linear_table_gives_a_linear_function() -> None:
    layout = grid_layout(1, 4, 4, 10, 3)
    axis = torch.arange(5, dtype=torch.float64) / 4
    vertices = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    slopes = torch.tensor([[1.0, 2, -3], [0, 1, 5], [7, 0, 2]], dtype=torch.float64)
    points = random_inputs()[1]
    torch.testing.assert_close(encode(layout, vertices @ slopes, vertices), vertices @ slopes, rtol=0, atol=1e-14)
    torch.testing.assert_close(encode(layout, vertices @ slopes, points), points @ slopes, rtol=0, atol=1e-13)


def test_the_table_gradient_is_the_transposed_map_and_is_added() -> None:
    table, points, grad = random_inputs()
    given = torch.full_like(table, 0.5)
    for level in range(len(LAYOUT.resolutions)):
        encode_backward_table(LAYOUT, range(level, level + 1), points, grad, given)
    wanted = torch.autograd.grad(encode(LAYOUT, table.requires_grad_(), points), table, grad)[0]
    torch.testing.assert_close(given - 0.5, wanted, rtol=0, atol=1e-12)
    assert (wanted == 0).any() and (wanted != 0).any()


def test_the_point_gradient_agrees_with_finite_differences() -> None:
    table, points, grad = random_inputs()
    gradient = encode_backward_points(LAYOUT, table, points, grad)
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = 1e-7
        change = encode(LAYOUT, table, points + shift) - encode(LAYOUT, table, points - shift)
        torch.testing.assert_close(gradient[:, axis], (change * grad).sum(-1) / 2e-7, rtol=1e-5, atol=1e-6)


def test_points_on_the_border_belong_to_the_last_cell() -> None:
    table, _, grad = random_inputs(count=2)
    border = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    inside = border.clamp(1e-12, 1 - 1e-12)
    torch.testing.assert_close(encode(LAYOUT, table, border), encode(LAYOUT, table, inside))
    torch.testing.assert_close(
        encode_backward_points(LAYOUT, table, border, grad), encode_backward_points(LAYOUT, table, inside, grad)
    )


@pytest.mark.parametrize("count", [0, 1])
def test_few_points_do(count: int) -> None:
    table, points, grad = random_inputs(count=count)
    given = torch.zeros_like(table)
    for level in range(len(LAYOUT.resolutions)):
        encode_backward_table(LAYOUT, range(level, level + 1), points, grad, given)
    assert encode(LAYOUT, table, points).shape == (count, 6)
    assert encode_backward_points(LAYOUT, table, points, grad).shape == (count, 3)
    assert given.any().item() == (count > 0)
