"""The occupancy grid (``nerf.kernels.torch.occupancy``)."""

import torch
import warp as wp
from jaxtyping import Float, Int64
from torch import Tensor

from nerf.kernels.torch.occupancy import BRICK_CELLS, cell_corners
from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})

__all__ = ["cell_corners", "occupancy_bits", "scatter_max"]  # cell_corners runs once in 16 steps: torch will do


def scatter_max(
    cells: int,
    optical_thickness: Float[Tensor, "cells"],
    points: Float[Tensor, "points 3"],
    values: Float[Tensor, "points"],
) -> None:
    """As in nerf.kernels.torch.occupancy."""
    launch(_scatter_max, len(points), cells, optical_thickness, points, values)
    launch(_propagate_nan, len(points), cells, optical_thickness, points, values)


def occupancy_bits(optical_thickness: Float[Tensor, "cells"], threshold: float) -> Int64[Tensor, "bricks"]:
    """As in nerf.kernels.torch.occupancy."""
    bits = optical_thickness.new_empty(len(optical_thickness) // BRICK_CELLS, dtype=torch.int64)
    launch(_occupancy_bits, len(bits), optical_thickness, threshold, bits)
    return bits


@wp.func
def cell_number(cells: int, x: int, y: int, z: int):
    """The number of cell (x, y, z), brick by brick."""
    bricks = cells >> 2
    brick = ((x >> 2) * bricks + (y >> 2)) * bricks + (z >> 2)
    return (brick << 6) + ((x & 3) << 4) + ((y & 3) << 2) + (z & 3)


@wp.func
def cell_of(cells: int, point: wp.vec3):
    """The number of the cell around a point; points outside the unit cube belong to the nearest."""
    scaled = float(cells) * point
    x = wp.clamp(int(scaled[0]), 0, cells - 1)
    y = wp.clamp(int(scaled[1]), 0, cells - 1)
    z = wp.clamp(int(scaled[2]), 0, cells - 1)
    return cell_number(cells, x, y, z)


@wp.kernel
def _scatter_max(cells: int, optical_thickness: wp.array[float], points: wp.array[wp.vec3], values: wp.array[float]):
    """Numbers alone: Warp's maximum takes NaN for missing. A cell that is NaN stays so."""
    i = wp.tid()
    cell = cell_of(cells, points[i])
    if optical_thickness[cell] < values[i]:
        wp.atomic_max(optical_thickness, cell, values[i])


@wp.kernel
def _propagate_nan(cells: int, optical_thickness: wp.array[float], points: wp.array[wp.vec3], values: wp.array[float]):
    """A cell is NaN where one of its values is. A launch by itself: on a GPU a maximum might undo it."""
    i = wp.tid()
    if wp.isnan(values[i]):
        optical_thickness[cell_of(cells, points[i])] = values[i]


@wp.kernel
def _occupancy_bits(optical_thickness: wp.array[float], threshold: float, bits: wp.array[wp.int64]):
    brick = wp.tid()
    word = wp.int64(0)
    for cell in range(64):
        if not (optical_thickness[64 * brick + cell] <= threshold):
            word = word | (wp.int64(1) << wp.int64(cell))
    bits[brick] = word
