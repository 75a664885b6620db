"""Cavities: empty space inside of things, which no photo looks into. A field is a shell where its photos tell no more.

The wall of a cavity that is closed is a component that no photo sees, and goes by itself. A pit in the shell makes it a
part of the outer surface, and its gap a hole. So such space is filled before there is a surface. Through a narrow gap
hardly anything is to be seen: free space hangs together where cubes of (2 RADIUS + 1)³ grid points fit into it (its
morphological opening, Serra 1982, "Image Analysis and Mathematical Morphology").
"""

from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import label

from nerf.kernels.torch.occupancy import grown

RADIUS = 3  # grid points: pits that led into a cavity were four to six wide (docs/experiments/mesh.md)
CORNERS = 3  # grid points, from a cavity on, into corners where no cube fits
MAX_SEEN = 0.1  # of the photos that look there; more see a room from inside, which is no cavity
SAMPLES = 20_000  # of the grid points in question, evenly spread, for which photos are asked


def fill_cavities(occupancy: np.ndarray, seen: Callable[[np.ndarray], np.ndarray]) -> int:
    """Set the ``occupancy`` (x, y, z) of cavities to one, in place, and return how many grid points that were.

    What hangs together with the border of the grid is none. ``seen``: the share of the photos, of those whose frustums
    hold a grid point, that see it, of points given as indices (n, 3).
    """
    free = occupancy < 0.5
    number, count = _labelled(~_dilated(~free, RADIUS))
    inside = np.ones(count + 1, bool)
    inside[0] = False
    for axis in range(3):
        inside[np.unique(np.take(number, [0, -1], axis))] = False
    if not inside.any():
        return 0
    places = np.argwhere(inside[number])
    asked = places[:: -(-len(places) // SAMPLES)]
    part = number[tuple(asked.T)]
    share = np.bincount(part, seen(asked), count + 1) / np.maximum(np.bincount(part, minlength=count + 1), 1)
    hidden = inside & (share <= MAX_SEEN)  # so is what is too small to be asked for
    elsewhere = _dilated((number > 0) & ~hidden[number], RADIUS)
    cavities = _dilated(hidden[number], RADIUS)
    for _ in range(CORNERS):
        cavities = _dilated(cavities, 1) & free & ~elsewhere
    occupancy[cavities] = 1.0
    return int(cavities.sum())


def _labelled(marked: np.ndarray) -> tuple[np.ndarray, int]:
    """The number of each marked point's component, from 1 on, 0 elsewhere; and how many there are."""
    number = np.zeros(marked.shape, np.int32)
    count = label(marked, output=number)
    assert isinstance(count, int)
    return number, count


def _dilated(marked: np.ndarray, radius: int) -> np.ndarray:
    """All points in cubes of (2 radius + 1)³ around the marked ones, as far as they lie in the grid."""
    found = torch.from_numpy(marked)
    for _ in range(radius):
        found = grown(found)
    return found.numpy()
