"""Large synthetic photo sets of places that repeat themselves, with exactly known cameras; and a score against them.

    python -m benchmarks.large_sets draw {rings,corridor,facades} FOLDER [--photos N] [--shuffle]
    python -m benchmarks.large_sets score TRUTH_JSON SPARSE_FOLDER INGEST_FOLDER

``draw`` writes photos of 480 × 360 into FOLDER and the true cameras beside it, into truth.json: so each set needs a
folder of its own around FOLDER. Photos that exist already are kept, and an interrupted run goes on where it stopped.
Names follow the walk; with ``--shuffle`` they are in random order and say nothing.

* ``rings``: 300 photos in three rings around a table with one tile laid again and again, plain areas and a few distinct
  things, in a room with the same wallpaper on two walls, plain ones with pictures, and two equal cupboards.
* ``corridor``: 300 photos of a walk along a corridor of equal doors, lamps and floor tiles, and back; pictures hang and
  boxes stand here and there. Looks swing from wall to wall, and are the mirror image on the way back.
* ``facades``: 120 photos around a building whose two long sides are the same but for a few signs and flower boxes. The
  two short sides are unlike each other.

``score`` reads what stage sfm made of a set: SPARSE_FOLDER is its COLMAP model, INGEST_FOLDER knows the photos' names.
Cameras count as placed within 0.5 % of the largest distance between true centres, and as turned right within 1 degree,
after the similarity that suits most of them.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerf import solid_texture
from nerf.alignment import align
from nerf.camera_paths import look_at
from nerf.scene import Camera, Similarity
from nerf.shapes import Box, Frustum, Shape, Sphere, Torus
from nerf.solid_texture import Colour, Noise, make_noise, mix, speckled
from nerf.synthetic import Solid, SyntheticScene, photograph
from stages.colmap.cameras import camera_rays
from stages.colmap.models import read_model
from stages.files import read_json, write_json
from stages.photos import read_photos

LENS = Camera("SIMPLE_RADIAL", 480, 360, (400.0, 240.0, 180.0, -0.04))
QUALITY = 95  # of the JPEG files
FOREVER = 1e6  # scene units: a period that no scene reaches the end of
SOFT = 0.012  # scene units over which painted edges pass from one colour to the other
UNIQUE = (
    solid_texture.marble,
    solid_texture.wrapping,
    solid_texture.doughnut,
    solid_texture.peel,
    solid_texture.banded,
    solid_texture.foliage,
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
    wall = mix((0.50, 0.42, 0.32), (0.66, 0.58, 0.46), noise.fractal(7 * local, 3))
    wall = speckled(noise, 0.35 * local, wall)
    room = mix((0.04, 0.05, 0.07), (0.30, 0.33, 0.38), 3 * noise.fractal(5 * local + 9, 2) - 1)
    curtain = inside(0.15 + 0.1 * z - x.abs() + 0.03 * (38 * x).sin())
    room = mix(room, (0.70, 0.62, 0.50), curtain * (0.7 + 0.3 * (90 * x).sin()))
    bars = torch.minimum(x.abs() - 0.02, (z - 0.12).abs() - 0.02)
    frame = torch.maximum(rectangle(x, z, 0.30, 0.34), -torch.minimum(bars, -rectangle(x, z, 0.25, 0.29)).neg())
    colour = mix(wall, room, inside(rectangle(x, z, 0.30, 0.34)))
    colour = mix(colour, (0.75, 0.72, 0.66), inside(frame) * inside(rectangle(x, z, 0.30, 0.34)))
    return mix(colour, (0.28, 0.26, 0.25), inside(rectangle(x, z + 0.39, 0.36, 0.04)))
