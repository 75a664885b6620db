"""The density cache: how much light each cell of the unit cube may stop, and one bit for whether to look there.

Cells are numbered brick by brick, so that 64 neighbours share a word: the brick of 4³ cells around cell (x, y, z) has
index b = ((x/4) B + y/4) B + z/4 with B bricks along each axis, and the cell has number 64 b + 16 (x mod 4) +
4 (y mod 4) + z mod 4. Bit i of word b belongs to cell 64 b + i.
"""

import torch
from jaxtyping import Float, Int, Int32, Int64
from torch import Tensor

BRICK_CELLS = 64


def raise_cache(
    cells: int,
    thickness: Float[Tensor, "cache"],
    points: Float[Tensor, "points 3"],
    values: Float[Tensor, "points"],
) -> None:
    """In place: every cell with a point becomes the largest of itself and its points' values, however many."""
    thickness.scatter_reduce_(0, cell_numbers(cells, points).long(), values, "amax")


def occupied_bits(thickness: Float[Tensor, "cache"], threshold: float) -> Int64[Tensor, "bricks"]:
    """A bit for each cell thicker than ``threshold``, and for each whose thickness is not a number: left out, a cell
    where the field is broken would look empty."""
    occupied = ~(thickness <= threshold).view(-1, BRICK_CELLS)
    return (occupied.long() << torch.arange(BRICK_CELLS, device=thickness.device)).sum(-1)


def cell_numbers(cells: int, points: Float[Tensor, "*points 3"]) -> Int32[Tensor, "*points"]:
    """The cell of each point; points outside the unit cube belong to the nearest."""
    x, y, z = (points * cells).int().clamp(0, cells - 1).unbind(-1)
    bricks = cells // 4
    brick = ((x >> 2) * bricks + (y >> 2)) * bricks + (z >> 2)
    return (brick << 6) + ((x & 3) << 4) + ((y & 3) << 2) + (z & 3)


def cell_corners(cells: int, numbers: Int[Tensor, "chosen"]) -> Float[Tensor, "chosen 3"]:
    """The corner nearest to the origin of each cell, in unit coordinates."""
    brick, within, bricks = numbers >> 6, numbers & 63, cells // 4
    x = 4 * (brick // bricks**2) + (within >> 4)
    y = 4 * (brick // bricks % bricks) + (within >> 2 & 3)
    z = 4 * (brick % bricks) + (within & 3)
    return torch.stack([x, y, z], -1) / cells
