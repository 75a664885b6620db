"""Places that repeat themselves, to draw photos of, and walks through them: see benchmarks/large_sets.py."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf.geometry.camera_paths import look_at
from nerf.synthetic import textures
from nerf.synthetic.scenes import Solid, SyntheticScene
from nerf.synthetic.shapes import Box, Frustum, Shape, Sphere, Torus
from nerf.synthetic.textures import Colour, Noise, make_noise, mix, speckled

FOREVER = 1e6  # scene units: a period that no scene reaches the end of
SOFT = 0.012  # scene units over which painted edges pass from one colour to the other
UNIQUE = (
    textures.marble,
    textures.wrapping,
    textures.doughnut,
    textures.peel,
    textures.banded,
    textures.foliage,
)

Poses = Float[np.ndarray, "photos 3 4"]
Centres = Float[np.ndarray, "photos 3"]
Points = Float[Tensor, "*points 3"]
Values = Float[Tensor, "*points"]
Texture = Callable[[Points], Points]


def scaled(texture: Callable[[Noise, Points], Points], seed: int, scale: float) -> Texture:
    """One of ``solid_texture``'s, of its own random numbers, ``scale`` times as fine."""
    noise = make_noise(seed)
    return lambda points: texture(noise, scale * points)


def plain(colour: Colour, points: Points) -> Points:
    """Nothing to see."""
    return points.new_tensor(colour).expand_as(points)


def wrapped(points: Points, periods: Colour) -> Points:
    """Points moved by whole ``periods`` to within half a period of the origin: textures of these repeat exactly."""
    period = points.new_tensor(periods)
    return points - period * (points / period + 0.5).floor()


def inside(distance: Values) -> Values:
    """1 where a distance is negative, 0 where it is positive, with a soft edge."""
    return (0.5 - distance / SOFT).clamp(0, 1)


def rectangle(across: Values, up: Values, half_width: float, half_height: float) -> Values:
    """A distance to a rectangle around the origin, negative within."""
    return torch.maximum(across.abs() - half_width, up.abs() - half_height)


def tiles(noise: Noise, period: float, reach: float, points: Points) -> Points:
    """The same painted tile again and again on a horizontal surface, as far as ``reach`` from the middle; plain wood
    beyond."""
    local = wrapped(points, (period, period, FOREVER))
    x, y = local[..., 0] / period, local[..., 1] / period
    radius = torch.hypot(x, y)
    petals = radius - 0.25 - 0.13 * (5 * torch.atan2(y, x)).cos()
    colour = mix((0.72, 0.66, 0.55), (0.10, 0.20, 0.42), inside(period * petals))
    colour = mix(colour, (0.65, 0.30, 0.10), inside(period * (radius - 0.11)))
    colour = mix(colour, (0.20, 0.40, 0.28), inside(period * (0.60 - (x + 0.05).abs() - (y - 0.03).abs())))
    colour = colour * (0.55 + 0.9 * noise.fractal(3.2 / period * local, 2))[..., None]
    colour = mix((0.12, 0.11, 0.10), colour, inside(rectangle(local[..., 0], local[..., 1], *2 * [0.47 * period])))
    return mix((0.42, 0.30, 0.19), colour, inside(rectangle(points[..., 0], points[..., 1], reach, reach)))


def wallpaper(noise: Noise, period: float, points: Points) -> Points:
    """A printed pattern that repeats exactly along x and z."""
    local = wrapped(points, (period, FOREVER, period))
    colour = mix((0.62, 0.58, 0.46), (0.30, 0.40, 0.36), 4 * noise.fractal(3 / period * local, 2) - 1.6)
    x, z = local[..., 0] / period, local[..., 2] / period
    flower = torch.hypot(x, z) - 0.24 - 0.08 * (6 * torch.atan2(z, x)).cos()
    return mix(colour, (0.50, 0.14, 0.16), inside(period * flower))


def windows(noise: Noise, period: float, storey: float, points: Points) -> Points:
    """A wall along x with the same window in every field of ``period`` × ``storey``: frame, bars, curtains, sill."""
    local = wrapped(points, (period, FOREVER, storey))
    x, z = local[..., 0], local[..., 2]
    wall = mix((0.50, 0.42, 0.32), (0.66, 0.58, 0.46), 2 * noise.fractal(7 * local, 3) - 0.5)
    colour = mix(speckled(noise, 0.35 * local, wall), (0.28, 0.26, 0.25), inside(rectangle(x, z + 0.39, 0.36, 0.04)))
    colour = mix(colour, (0.75, 0.72, 0.66), inside(rectangle(x, z, 0.30, 0.34)))
    room = mix((0.04, 0.05, 0.07), (0.30, 0.33, 0.38), 3 * noise.fractal(5 * local + 9, 2) - 1)
    curtain = inside(0.15 + 0.1 * z - x.abs() + 0.03 * (38 * x).sin())
    room = mix(room, (0.70, 0.62, 0.50), curtain * (0.7 + 0.3 * (60 * x).sin()))
    bars = torch.minimum(x.abs(), (z - 0.12).abs()) - 0.02
    return mix(colour, room, inside(torch.maximum(rectangle(x, z, 0.25, 0.29), -bars)))


def doors(noise: Noise, period: float, points: Points) -> Points:
    """A wall along x with the same door in every ``period``: two panels, a handle to one side, a plate. Plain between
    them, darker below a rail."""
    local = wrapped(points, (period, FOREVER, FOREVER))
    x, z = local[..., 0], local[..., 2] + 0.2
    colour = mix((0.95, 0.92, 0.82), (0.50, 0.62, 0.58), inside(points[..., 2] + 0.25))
    colour = speckled(noise, 0.5 * local, colour)
    colour = mix(colour, (0.20, 0.15, 0.10), inside((points[..., 2] + 0.25).abs() - 0.02))
    colour = mix(colour, (0.70, 0.66, 0.58), inside(rectangle(x, z, 0.46, 1.06)))
    grain = noise.fractal(local * local.new_tensor([14.0, 1.0, 5.0]), 4)
    wood = mix((0.22, 0.10, 0.05), (0.90, 0.55, 0.28), 3 * grain - 1)
    colour = mix(colour, wood, inside(rectangle(x, z, 0.40, 1.0)))
    panels = torch.minimum(rectangle(x, z - 0.42, 0.27, 0.38), rectangle(x, z + 0.52, 0.27, 0.32))
    colour = mix(colour, (0.10, 0.06, 0.03), inside(panels.abs() - 0.015))
    colour = mix(colour, (0.80, 0.74, 0.40), inside(rectangle(x - 0.33, z + 0.05, 0.03, 0.10)))
    plate = speckled(noise, 1.5 * local, local.new_tensor((0.82, 0.82, 0.78)).expand_as(local))
    return mix(colour, plate, inside(rectangle(x + 0.02, z - 0.62, 0.12, 0.06)))


def lamps(period: float, points: Points) -> Points:
    """A ceiling with the same lamp in every ``period`` along x."""
    local = wrapped(points, (period, FOREVER, FOREVER))
    x, y = local[..., 0], local[..., 1]
    colour = mix((0.70, 0.70, 0.68), (0.30, 0.30, 0.30), inside(rectangle(x, y, 0.34, 0.16)))
    return mix(colour, (1.0, 1.0, 0.95), inside(rectangle(x, y, 0.30, 0.12)))


def placed(shape: Shape, texture: Texture, centre: tuple[float, float, float], turn_deg: float = 0.0) -> Solid:
    """A solid turned around z."""
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    x, y, z = centre
    pose = [[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z]]
    return Solid(shape, torch.tensor(pose, dtype=torch.float32), texture)


def pictures(
    random: np.random.Generator, middle: tuple[float, float], turn_deg: float, along: list[float]
) -> list[Solid]:
    """Boards on a wall through ``middle`` that was turned like them, ``along`` it: none like another."""
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    boards = []
    for place in along:
        half = (random.uniform(0.16, 0.32), random.uniform(0.03, 0.05), random.uniform(0.16, 0.32))
        texture = scaled(UNIQUE[random.integers(len(UNIQUE))], int(random.integers(1 << 30)), random.uniform(0.8, 1.2))
        centre = (middle[0] + cos * place, middle[1] + sin * place, random.uniform(0.1, 0.5))
        boards.append(placed(Box(half), texture, centre, turn_deg))
    return boards


def hand_held(centres: Centres, aims: Centres, random: np.random.Generator, sway: float) -> Poses:
    """Cameras near ``centres`` that look near ``aims``, both off by up to ``sway``, and tilted by up to 4 degrees."""
    centres = centres + random.uniform(-sway, sway, centres.shape)
    level = look_at(centres, aims + random.uniform(-sway, sway, aims.shape))
    roll = np.deg2rad(random.uniform(-4, 4, len(centres)))
    cos, sin, zero, one = np.cos(roll), np.sin(roll), np.zeros(len(roll)), np.ones(len(roll))
    tilt = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return np.concatenate([level[:, :, :3] @ tilt, centres[:, :, None]], axis=2)


def table_room(count: int) -> SyntheticScene:
    """The place of ``rings``; the table top is at z = 0."""
    random, noise = np.random.default_rng(1), make_noise(1)
    side, floor, height = 3.6, -0.9, 1.3  # half a wall's length, z of the floor, half a wall's height
    paper, paint = partial(wallpaper, noise, 0.45), partial(plain, (0.60, 0.56, 0.48))
    solids = [
        placed(Box((1.1, 1.1, 0.05)), partial(tiles, noise, 0.2, 0.8), (0, 0, -0.05)),
        placed(Box((side, side, 0.05)), partial(tiles, noise, 0.6, FOREVER), (0, 0, floor - 0.05)),
        placed(Box((0.22, 0.18, 0.15)), scaled(textures.wrapping, 2, 1.0), (-0.45, 0.40, 0.146), 26),
        placed(Sphere(0.22), scaled(textures.marble, 3, 1.0), (0.45, 0.45, 0.215)),
        placed(Frustum(0.15, 0.22, 0.2), scaled(textures.banded, 4, 1.0), (-0.50, -0.45, 0.196), 17),
        placed(Torus(0.19, 0.085), scaled(textures.doughnut, 5, 1.0), (0.30, -0.50, 0.08), 40),
        placed(Frustum(0.20, 0.26, 0.02), partial(plain, (0.80, 0.80, 0.78)), (0.02, 0.02, 0.018)),
    ]
    cupboard = Box((0.5, 0.35, 0.7)), scaled(textures.banded, 6, 0.6)
    solids += [placed(*cupboard, (2.9, 2.9, floor + 0.69), 45), placed(*cupboard, (-2.9, -2.9, floor + 0.69), 225)]
    for wall, texture in enumerate((paper, paint, paper, paint)):
        turn_deg = 90.0 * wall
        x, y = (side * f(math.radians(turn_deg - 90)) for f in (math.cos, math.sin))
        solids.append(placed(Box((side, 0.05, height)), texture, (x, y, floor + height), turn_deg))
        if texture is paint:
            solids += pictures(random, (0.985 * x, 0.985 * y), turn_deg, [-2.2, -0.9, 0.4, 1.9])
    return SyntheticScene(tuple(solids), noise)


def ring_walk(count: int, random: np.random.Generator) -> Poses:
    """One ring after the other, the lowest first."""
    ring, place = np.divmod(np.arange(count), math.ceil(count / 3))
    azimuth = 2 * np.pi * (place / math.ceil(count / 3) + ring / 9)
    elevation = np.deg2rad(np.array([13.0, 30.0, 48.0])[ring])
    flat = np.cos(elevation)
    ways = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    middle = np.array([0, 0, 0.1])
    return hand_held(middle + 2.4 * ways, np.tile(middle, (count, 1)), random, 0.08)


STEP = 0.2  # scene units from photo to photo in the corridor
AISLE = 1.5  # half the corridor's width
DOOR_PERIOD = 1.5


def corridor(count: int) -> SyntheticScene:
    """The place of ``corridor``, along x; it is 2.4 high, its middle at z = 0."""
    random, noise = np.random.default_rng(2), make_noise(2)
    end = STEP * count / 2
    half, middle = end / 2 + 1.6, end / 2
    side = Box((half, 0.05, 1.2)), partial(doors, noise, DOOR_PERIOD)
    solids = [
        placed(*side, (middle, AISLE + 0.05, 0)),
        placed(*side, (middle, -AISLE - 0.05, 0), 180),
        placed(Box((half, AISLE, 0.05)), partial(tiles, noise, 0.5, FOREVER), (middle, 0, -1.25)),
        placed(Box((half, AISLE, 0.05)), partial(lamps, 2 * DOOR_PERIOD), (middle, 0, 1.25)),
    ]
    for x, turn_deg in ((middle - half, 90.0), (middle + half, -90.0)):
        solids.append(placed(Box((AISLE, 0.05, 1.2)), partial(plain, (0.60, 0.56, 0.48)), (x, 0, 0), turn_deg))
        solids += pictures(random, (x, 0), turn_deg, [-0.6, 0.5])
    for y in (-AISLE, AISLE):
        places = np.arange(0.75, end, 3.0)  # between doors, or the pictures would hang on these
        taken = places[random.random(len(places)) < 0.6] - middle
        solids += pictures(random, (middle, y), 0, taken.tolist())
    for x in np.arange(2.0, end, 5.0):
        texture = scaled(UNIQUE[random.integers(len(UNIQUE))], int(random.integers(1 << 30)), 0.7)
        half_sides = tuple(random.uniform(0.12, 0.22, 3).tolist())
        side_of_it = random.choice((-1, 1)) * (AISLE - 0.3)
        solids.append(placed(Box(half_sides), texture, (float(x), side_of_it, half_sides[2] - 1.204), 20))
    return SyntheticScene(tuple(solids), noise)


def corridor_walk(swing_deg: float, swing_length: float, count: int, random: np.random.Generator) -> Poses:
    """There on one side and back on the other. Looks swing by ``swing_deg`` to either side of the way ahead, once in
    ``swing_length`` scene units, and meet the same places of the same walls both times, once from either side."""
    there = (count + 1) // 2
    place = np.concatenate([np.arange(there), np.arange(count - there)[::-1]])
    ahead = np.where(np.arange(count) < there, 1.0, -1.0)
    x = STEP * place
    angle = math.radians(swing_deg) * np.cos(2 * np.pi * (x - STEP * there) / swing_length)
    centres = np.stack([x, -0.25 * ahead, 0.15 + 0.1 * ahead], axis=1)
    look = np.stack([ahead * np.cos(angle), np.sin(angle), np.full(count, -0.08)], axis=1)
    return hand_held(centres, centres + 2 * look, random, 0.06)


LONG, SHORT, TALL = 3.5, 2.0, 1.5  # half sides of the building
AWAY = 3.0  # from its walls


def building(count: int) -> SyntheticScene:
    """The place of ``facades``: the long sides along x, its middle at the origin."""
    random, noise = np.random.default_rng(3), make_noise(3)
    front = Box((LONG, 0.05, TALL)), partial(windows, noise, 1.0, 1.0)
    ends = Box((SHORT - 0.06, 0.05, TALL))
    solids = [
        placed(*front, (0, -SHORT, 0)),
        placed(*front, (0, SHORT, 0), 180),
        placed(ends, scaled(textures.marble, 4, 0.45), (LONG - 0.06, 0, 0), 90),
        placed(ends, scaled(textures.wrapping, 5, 0.45), (0.06 - LONG, 0, 0), 270),
        placed(Box((LONG + 0.15, SHORT + 0.2, 0.06)), partial(plain, (0.32, 0.14, 0.10)), (0, 0, TALL + 0.05)),
        placed(Box((14, 14, 0.05)), partial(tiles, noise, 0.9, 5.4), (0, 0, -TALL - 0.05)),
    ]
    for turn_deg, y, signs, flowers in ((0.0, -SHORT, [-2.5, 0.5], -1.0), (180.0, SHORT, [-1.5, 2.5], 1.0)):
        solids += pictures(random, (0, math.copysign(0.05, y) + y), turn_deg, signs)
        sill = Box((0.3, 0.09, 0.07))
        texture = scaled(textures.foliage, int(random.integers(1 << 30)), 0.8)
        outside = math.copysign(0.1, y)
        solids.append(placed(sill, texture, (math.copysign(flowers, flowers * y), y + outside, -0.38), turn_deg))
    return SyntheticScene(tuple(solids), noise)


def building_walk(count: int, random: np.random.Generator) -> Poses:
    """Once around the building, AWAY from its walls, and around its corners in arcs."""
    corners = np.array([[LONG, SHORT], [-LONG, SHORT], [-LONG, -SHORT], [LONG, -SHORT]])
    turns = np.pi / 2 * (np.arange(4)[:, None] + np.linspace(0, 1, 50))
    path = corners[:, None] + AWAY * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    path = np.concatenate([path.reshape(-1, 2), path[0, :1]])
    length = np.concatenate([[0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    places = np.arange(count) / count * length[-1]
    flat = np.stack([np.interp(places, length, axis) for axis in path.T], axis=1)
    inset = np.array([LONG, SHORT]) - 1.0
    aims = np.clip(flat, -inset, inset)
    centres = np.concatenate([flat, np.full((count, 1), -0.5)], axis=1)
    return hand_held(centres, np.concatenate([aims, np.full((count, 1), -0.1)], axis=1), random, 0.1)


class PhotoSet(NamedTuple):
    """A place and a walk through it, both functions of the number of photos."""

    scene: Callable[[int], SyntheticScene]
    poses: Callable[[int, np.random.Generator], Poses]
    photos: int
    shading: float  # scene units: how far off the view something may stand and still take light from what is in it


SETS = {
    "rings": PhotoSet(table_room, ring_walk, 300, 3.0),
    "corridor": PhotoSet(corridor, partial(corridor_walk, 40, 7.3), 300, 0.3),
    "corridor_in_step": PhotoSet(corridor, partial(corridor_walk, 75, 4 * DOOR_PERIOD), 300, 0.3),
    "facades": PhotoSet(building, building_walk, 120, 3.0),
}
