"""Procedural solid textures: reflectance as a function of a 3-D point, detailed at every scale, never repeating.

A texture maps points in a shape's own frame to linear-light reflectance in [0, 1]. The detail comes from value
noise: random numbers on a lattice, interpolated smoothly and summed over octaves (Perlin 1985).
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

Points = Float[Tensor, "*points 3"]
Values = Float[Tensor, "*points"]
Colour = tuple[float, float, float]

LATTICE = 64
OCTAVE_SCALE = 2.03  # not 2: the lattices of two octaves must never line up
# One radian about (1, 2, 3), so that no direction shows the lattice.
OCTAVE_TURN = torch.linalg.matrix_exp(torch.tensor([[0.0, -3, 2], [3, 0, -1], [-2, 1, 0]]) / math.sqrt(14))
OCTAVE_SHIFT = 17.3


class Noise(NamedTuple):
    """Smooth random functions of space, all drawn from one lattice of numbers in [0, 1) that wraps around."""

    lattice: Float[Tensor, "size size size"]  # size = LATTICE + 1: the first layer again at the end

    def octave(self, points: Points) -> Values:
        """Value noise in [0, 1] with cells of side 1."""
        cell = points.floor()
        inside = points - cell
        smooth = cell - LATTICE * (cell / LATTICE).floor() + inside.square() * (3 - 2 * inside)
        grid = (smooth.flip(-1) * (2 / LATTICE) - 1).reshape(1, 1, 1, -1, 3)
        lattice = self.lattice.to(points)[None, None]
        return torch.nn.functional.grid_sample(lattice, grid, align_corners=True).reshape(points.shape[:-1])

    def fractal(self, points: Points, octaves: int) -> Values:
        """Octaves of noise in [0, 1] around 0.5, each half as strong as the one before; the coarsest has cells of 1."""
        turn = OCTAVE_SCALE * OCTAVE_TURN.to(points)
        total = torch.full_like(points[..., 0], 0.5)
        for octave in range(octaves):
            total = total + 0.5 ** (octave + 1) * (self.octave(points) - 0.5)
            points = points @ turn + OCTAVE_SHIFT
        return total

    def per_cell(self, i: Values, j: Values, layer: int) -> Values:
        """A random number in [0, 1) for each pair of whole numbers, independent from layer to layer."""
        return self.lattice.to(i)[i.long() % LATTICE, j.long() % LATTICE, layer]


def make_noise(seed: int) -> Noise:
    """The noise of ``seed``."""
    lattice = torch.rand(3 * [LATTICE], generator=torch.Generator().manual_seed(seed))
    return Noise(torch.nn.functional.pad(lattice[None, None], 3 * (0, 1), mode="circular")[0, 0])


def mix(low: Colour | Points, high: Colour | Points, share: Values) -> Points:
    """``low`` where ``share`` is 0 or less, ``high`` where it is 1 or more, linear in between."""
    low, high = (c if isinstance(c, Tensor) else share.new_tensor(c) for c in (low, high))
    return torch.lerp(low.expand(*share.shape, 3), high.expand(*share.shape, 3), share.clamp(0, 1)[..., None])


def _edge(values: Values, width: float) -> Values:
    """A soft step from 0 to 1 around 0, so that no contour is sharper than ``width``."""
    return (values / width + 0.5).clamp(0, 1)


def speckled(noise: Noise, points: Points, colour: Points) -> Points:
    """``colour`` with darker and lighter flecks of two sizes: the landmarks that feature matching lives on."""
    for cells, flecks in ((27.0, 0.35), (44.0, 0.5)):
        fleck = noise.octave(cells * points + cells)
        colour = colour * (1 - flecks * _edge(fleck - 0.72, 0.12) + 0.5 * flecks * _edge(0.26 - fleck, 0.12))[..., None]
    return colour


def mosaic(noise: Noise, points: Points) -> Points:
    """Stone tiles in rings around z, each of its own colour and grain."""
    width = 0.105
    radius = torch.hypot(points[..., 0], points[..., 1])
    turn = torch.atan2(points[..., 1], points[..., 0]) / (2 * math.pi) + 0.5
    ring = (radius / width).floor()
    count = (2 * math.pi * (ring + 0.5) * 0.8).round()
    place = (turn + noise.per_cell(ring, ring, 0)) * count
    tile = place.floor() % count
    grain = noise.fractal(11 * points, 4)
    colour = mix((0.80, 0.70, 0.52), (0.16, 0.36, 0.40), _edge(noise.per_cell(ring, tile, 1) - 0.62, 0.5))
    colour = mix(colour, (0.62, 0.22, 0.11), _edge(noise.per_cell(ring, tile, 2) - 0.78, 0.1))
    colour = colour * (0.35 + 0.75 * grain + 0.45 * noise.per_cell(ring, tile, 3))[..., None]
    colour = speckled(noise, points, colour)
    across, along = radius / width - ring, (place - place.floor() - 0.5).abs()
    to_joint = torch.minimum(0.5 - (across - 0.5).abs(), (0.5 - along) * (2 * math.pi * radius / (count * width)))
    return mix((0.09, 0.08, 0.075), colour, _edge(to_joint + 0.08 * (grain - 0.5) - 0.07, 0.06))


def marble(noise: Noise, points: Points) -> Points:
    """Blue stone with pale veins."""
    warp = noise.fractal(4 * points, 5)
    vein = (9 * points[..., 0] + 6 * points[..., 2] + 11 * warp).sin().abs()
    colour = mix((0.02, 0.07, 0.22), (0.08, 0.26, 0.52), noise.fractal(9 * points + 5, 4) * 1.6 - 0.3)
    return speckled(noise, points, mix((0.85, 0.80, 0.66), colour, _edge(vein - 0.22, 0.35)))


def wrapping(noise: Noise, points: Points) -> Points:
    """Hand-printed paper: a wobbling check of mustard and cream, with splashes of ink."""
    wobbled = points + 0.03 * torch.stack([noise.octave(9 * points + shift) for shift in (3, 41, 87)], dim=-1)
    odd = (wobbled * 7.5 + 0.5).floor().sum(-1) % 2
    colour = mix((0.72, 0.42, 0.06), (0.82, 0.74, 0.55), odd)
    colour = mix(colour, (0.09, 0.22, 0.24), _edge(noise.fractal(14 * points + 9, 3) - 0.60, 0.04))
    return speckled(noise, points, colour * (0.65 + 0.7 * noise.fractal(23 * points, 3))[..., None])


def banded(noise: Noise, points: Points) -> Points:
    """Terracotta with painted bands and a rough glaze."""
    height = points[..., 2] + 0.02 * (noise.octave(8 * points) - 0.5)
    colour = mix((0.46, 0.17, 0.08), (0.62, 0.29, 0.13), noise.fractal(13 * points, 4) * 2 - 0.5)
    colour = mix(colour, (0.86, 0.80, 0.66), _edge((31 * height).sin() - 0.55, 0.2))
    colour = mix(colour, (0.05, 0.13, 0.20), _edge(noise.fractal(19 * points + 3, 3) - 0.63, 0.05))
    return speckled(noise, points, colour)


def foliage(noise: Noise, points: Points) -> Points:
    """Greens at three scales, with red berries."""
    colour = mix((0.02, 0.09, 0.03), (0.30, 0.48, 0.10), noise.fractal(10 * points, 5) * 2.2 - 0.6)
    colour = mix(colour, (0.70, 0.06, 0.05), _edge(noise.octave(15 * points + 7) - 0.86, 0.05))
    return speckled(noise, points, colour)


def doughnut(noise: Noise, points: Points) -> Points:
    """Baked dough under a pink icing with sprinkles."""
    dough = mix((0.42, 0.20, 0.07), (0.66, 0.40, 0.17), noise.fractal(18 * points, 4) * 2 - 0.5)
    tint = noise.fractal(26 * points + 11, 2)
    sprinkle = mix((0.95, 0.85, 0.30), (0.16, 0.42, 0.66), _edge(tint - 0.5, 0.02))
    icing = mix((0.74, 0.22, 0.33), (0.85, 0.40, 0.46), noise.fractal(12 * points, 3))
    icing = mix(icing, sprinkle, _edge(noise.octave(30 * points + 31) - 0.70, 0.05))
    line = points[..., 2] + 0.05 * (noise.fractal(7 * points, 2) - 0.5)
    return mix(dough, icing, _edge(line - 0.005, 0.008))


def peel(noise: Noise, points: Points) -> Points:
    """An orange with pores and blemishes."""
    colour = mix((0.75, 0.22, 0.02), (0.88, 0.42, 0.05), noise.fractal(8 * points, 4) * 2 - 0.5)
    colour = mix(colour, (0.42, 0.22, 0.03), _edge(noise.fractal(16 * points + 2, 3) - 0.62, 0.06))
    return speckled(noise, points, colour)
