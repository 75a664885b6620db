"""The occupancy grid: each cell of the unit cube has an optical thickness and a bit for whether it is occupied.

Cells are numbered brick by brick, so that 64 neighbours share a word: the brick of 4³ cells around cell (x, y, z) has
index b = ((x/4) B + y/4) B + z/4 with B bricks along each axis, and the cell has number 64 b + 16 (x mod 4) +
4 (y mod 4) + z mod 4. Bit i of word b belongs to cell 64 b + i.
"""

import torch
from jaxtyping import Bool, Float, Int, Int32, Int64
from torch import Tensor

from nerf.kernels import BinaryOccupancy

BRICK_CELLS = 64
MAX_EMPTY_DISTANCE = 8  # bricks: a quarter of a cube of 128 cells, so that a ray crosses an empty one in a few hops


def scatter_max(
    cells: int,
    optical_thickness: Float[Tensor, "cells"],
    points: Float[Tensor, "points 3"],
    values: Float[Tensor, "points"],
) -> None:
    """In place: every cell with a point becomes the largest of itself and its points' values, however many.

    It is NaN from then on if one of these is: a broken field stays visible (:func:`occupancy_bits`).
    """
    optical_thickness.scatter_reduce_(0, cell_numbers(cells, points).long(), values, "amax")


def occupancy_bits(optical_thickness: Float[Tensor, "cells"], threshold: float) -> Int64[Tensor, "bricks"]:
    """A bit for each cell whose optical thickness exceeds ``threshold`` or is NaN: left out, a cell where the field is
    broken would look empty."""
    occupied = ~(optical_thickness <= threshold).view(-1, BRICK_CELLS)
    return (occupied.long() << torch.arange(BRICK_CELLS, device=optical_thickness.device)).sum(-1)


def binary_occupancy(bits: Int64[Tensor, "bricks"]) -> BinaryOccupancy:
    """With the empty-space distance of each brick. A distance of n means that the cube of 2 n - 1 bricks per side
    around it holds no occupied cell; it is 0 where the brick itself holds one, and at most
    MAX_EMPTY_DISTANCE."""
    side = round(len(bits) ** (1 / 3))
    reached = (bits != 0).view(side, side, side)
    clear = torch.zeros_like(reached, dtype=torch.uint8)
    for _ in range(MAX_EMPTY_DISTANCE):
        clear += ~reached
        reached = grown(reached)
    return BinaryOccupancy(bits, clear.flatten())


def grown(reached: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """Cells with all their neighbours, across edges and corners too."""
    for axis in range(3):
        wider, last = reached.clone(), reached.shape[axis] - 1
        wider.narrow(axis, 1, last).logical_or_(reached.narrow(axis, 0, last))
        wider.narrow(axis, 0, last).logical_or_(reached.narrow(axis, 1, last))
        reached = wider
    return reached


def cell_numbers(cells: int, points: Float[Tensor, "*points 3"]) -> Int32[Tensor, "*points"]:
    """The cell of each point; points outside the unit cube belong to the nearest."""
    x, y, z = (points * cells).int().clamp(0, cells - 1).unbind(-1)
    bricks = cells // 4
    brick = ((x >> 2) * bricks + (y >> 2)) * bricks + (z >> 2)
    return (brick << 6) + ((x & 3) << 4) + ((y & 3) << 2) + (z & 3)


def is_occupied(bits: Int64[Tensor, "bricks"], numbers: Int32[Tensor, "*points"]) -> Bool[Tensor, "*points"]:
    """The bits of these cells."""
    brick = bits.index_select(0, (numbers >> 6).flatten()).view(numbers.shape)
    return (brick >> (numbers & 63)) & 1 != 0


def cell_corners(cells: int, numbers: Int[Tensor, "chosen"]) -> Float[Tensor, "chosen 3"]:
    """The corner nearest to the origin of each cell, in unit coordinates."""
    brick, within, bricks = numbers >> 6, numbers & 63, cells // 4
    x = 4 * (brick // bricks**2) + (within >> 4)
    y = 4 * (brick // bricks % bricks) + (within >> 2 & 3)
    z = 4 * (brick % bricks) + (within & 3)
    return torch.stack([x, y, z], -1) / cells
