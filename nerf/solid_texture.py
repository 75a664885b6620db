"""Procedural solid textures: colour as a function of a 3-D point, rich in detail at every scale and never repeating.

Every texture maps points (in a shape's own frame) to linear reflectance. The detail comes from value noise: random
numbers on a lattice, interpolated smoothly, summed over octaves (Perlin 1985, fractional Brownian motion).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

Points = Float[Tensor, "*points 3"]
Values = Float[Tensor, "*points"]
Colour = tuple[float, float, float]
Texture = Callable[[Points], Float[Tensor, "*points 3"]]

LATTICE = 64
OCTAVE_SCALE = 2.03  # not 2: lattices of two octaves must never line up
# Turned by 1 radian about (1, 2, 3) between octaves, so that no direction shows the lattice.
OCTAVE_TURN = torch.linalg.matrix_exp(torch.tensor([[0.0, -3, 2], [3, 0, -1], [-2, 1, 0]]) / math.sqrt(14))


class Noise(NamedTuple):
    """Smooth random functions of space, in [0, 1], all drawn from one ``lattice`` (wrapped by one layer)."""

    lattice: Float[Tensor, "size size size"]

    def octave(self, points: Points) -> Values:
        """Value noise with cells of side 1."""
        cell = points.floor()
        inside = points - cell
        smooth = cell % LATTICE + inside.square() * (3 - 2 * inside)
        grid = (smooth.flip(-1) * (2 / LATTICE) - 1).reshape(1, 1, 1, -1, 3)
        lattice = self.lattice.permute(2, 1, 0).to(points)[None, None]
        return torch.nn.functional.grid_sample(lattice, grid.flip(-1), align_corners=True).reshape(points.shape[:-1])

    def fractal(self, points: Points, octaves: int) -> Values:
        """Octaves of noise, each half as strong as the one before, centred on 0.5 with unit-scale features."""
        turn = OCTAVE_SCALE * OCTAVE_TURN.to(points)
        total = torch.zeros_like(points[..., 0])
        for octave in range(octaves):
            total = total + 0.5 ** (octave + 1) * (self.octave(points) - 0.5)
            points = points @ turn + 17.3
        return total + 0.5

    def per_cell(self, cells: Points) -> Values:
        """A random number in [0, 1) for each triple of whole numbers."""
        i, j, k = (cells.long() % LATTICE).unbind(-1)
        return self.lattice[i, j, k].to(cells)


def make_noise(seed: int) -> Noise:
    """The noise of ``seed``, the same on every machine."""
    lattice = torch.rand(3 * [LATTICE], generator=torch.Generator().manual_seed(seed))
    return Noise(torch.nn.functional.pad(lattice[None, None], 6 * [0, 1][:0] or (0, 1) * 3, mode="circular")[0, 0])
