"""A still life with exact geometry: what any camera sees of it, and points on its true surface.

The world has +z up, the table top at z = 0 and a table of radius 1. Light comes from a sun (Lambert, one shadow ray)
and from the sky (weaker where other surfaces are near), so colour does not depend on the viewing direction unless a
``highlight`` is asked for. The sky lies at infinity.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf.geometry.camera_paths import look_at
from nerf.geometry.rays import Rays, rays_of_view
from nerf.rendering.srgb import linear_to_srgb
from nerf.synthetic import textures
from nerf.synthetic.shapes import Box, Frustum, Points, Shape, Sphere, Torus, Values, dot
from nerf.synthetic.textures import Noise, make_noise, mix

TABLE_RADIUS = 1.0
SUN = (0.53, -0.40, 0.75)
SUN_LIGHT = (1.55, 1.38, 1.12)
SKY_LIGHT = (0.40, 0.47, 0.58)
GROUND_LIGHT = (0.22, 0.18, 0.15)
NEARBY = (0.05, 0.2)  # scene units; how far around a point other surfaces take away light of the sky
SHADOW_OFFSET = 1e-4  # scene units; shadow rays start this far off the surface
GLOSS = 60.0  # exponent of the highlight
CHUNK = 1 << 18  # rays traced at a time


class Solid(NamedTuple):
    """A shape placed in the world. ``texture`` maps points in the shape's frame to linear reflectance."""

    shape: Shape
    world_from_shape: Float[Tensor, "3 4"]
    texture: Callable[[Tensor], Tensor]

    def local(self, points: Points) -> Points:
        """World points in the shape's frame."""
        pose = self.world_from_shape.to(points)
        return (points - pose[:, 3]) @ pose[:, :3]

    def intersect(self, origins: Points, directions: Points) -> Values:
        """Distance along unit rays to the first entry, infinity where there is none."""
        pose = self.world_from_shape.to(origins)
        to_centre = pose[:, 3] - origins
        along = dot(to_centre, directions)
        aside = to_centre - along[..., None] * directions
        # Most rays miss most shapes: only those that meet the bounding sphere are worth the exact test.
        near = torch.where((dot(aside, aside) < self.shape.reach**2) & (along > -self.shape.reach))
        t = torch.full_like(along, torch.inf)
        t[near] = self.shape.intersect(self.local(origins[near]), directions[near] @ pose[:, :3])
        return t

    def distance(self, points: Points) -> Values:
        """Signed distance of world points."""
        return self.shape.distance(self.local(points))


class Trace(NamedTuple):
    """What rays see; colours are sRGB-encoded. Without a hit: the sky's colour, infinite depth, zero normal."""

    colour: Float[Tensor, "*rays 3"]
    depth: Float[Tensor, "*rays"]
    normal: Float[Tensor, "*rays 3"]
    hit: Bool[Tensor, "*rays"]


class SyntheticScene(NamedTuple):
    """Solids under a sun and a sky. ``highlight`` is the strength of a mirror-like reflection of the sun."""

    solids: tuple[Solid, ...]
    noise: Noise
    highlight: float = 0.0

    def intersect(self, origins: Points, directions: Points) -> Float[Tensor, "solids *points"]:
        """Distance along unit rays to the first entry into every solid, infinity where there is none."""
        return torch.stack([solid.intersect(origins, directions) for solid in self.solids])

    def distance(self, points: Points) -> Values:
        """Signed distance to the union of the solids: exact outside, a bound inside."""
        return torch.stack([solid.distance(points) for solid in self.solids]).amin(0)

    def trace(self, rays: Rays) -> Trace:
        """What each ray meets first, along its whole length: ``near`` and ``far`` are not looked at."""
        depth, owner = self.intersect(rays.origins, rays.directions).min(0)
        hit = depth.isfinite()
        colour, normal = torch.zeros_like(rays.origins), torch.zeros_like(rays.origins)
        directions = rays.directions[hit]
        points = rays.origins[hit] + depth[hit][:, None] * directions
        reflectance, normal[hit] = self._surface(points, owner[hit])
        colour[hit] = self._shade(points, normal[hit], reflectance, directions)
        colour[~hit] = self._sky(rays.directions[~hit])
        return Trace(linear_to_srgb(colour.clamp(0, 1)), depth, normal, hit)

    def _surface(self, points: Float[Tensor, "n 3"], owner: Tensor) -> tuple[Tensor, Tensor]:
        """Reflectance and outward normal of surface points of the solids named by ``owner``."""
        reflectance, normal = torch.zeros_like(points), torch.zeros_like(points)
        for index, solid in enumerate(self.solids):
            mine = torch.where(owner == index)
            local = solid.local(points[mine])
            reflectance[mine] = solid.texture(local)
            normal[mine] = solid.shape.normal(local) @ solid.world_from_shape[:, :3].T.to(points)
        return reflectance.clamp(0, 1), normal

    def _shade(self, points: Points, normals: Points, reflectance: Points, directions: Points) -> Points:
        sun = torch.nn.functional.normalize(points.new_tensor(SUN), dim=0).expand_as(points)
        facing = dot(normals, sun)
        lit = facing > 0
        start = points[lit] + SHADOW_OFFSET * normals[lit]
        lit[lit.clone()] = self.intersect(start, sun[lit]).isinf().all(0)
        direct = torch.where(lit, facing, 0.0)
        ambient = mix(GROUND_LIGHT, SKY_LIGHT, 0.5 + 0.5 * normals[..., 2]) * self._openness(points, normals)
        colour = reflectance * (direct[..., None] * points.new_tensor(SUN_LIGHT) + ambient)
        if self.highlight:
            half = torch.nn.functional.normalize(sun - directions, dim=-1)
            mirrored = dot(normals, half).clamp(min=0) ** GLOSS
            colour = colour + self.highlight * torch.where(lit, mirrored, 0.0)[..., None]
        return colour

    def _openness(self, points: Points, normals: Points) -> Float[Tensor, "*points 1"]:
        """How much of the sky a point sees, from how far off the surface its surroundings stay (Evans 2006)."""
        free = [(self.distance(points + step * normals) / step).clamp(0, 1) for step in NEARBY]
        return (0.25 + 0.75 * torch.stack(free).mean(0))[..., None]

    def _sky(self, directions: Points) -> Points:
        """Light from infinity: haze at the horizon, deeper blue above and below it, soft clouds everywhere."""
        height = directions[..., 2].abs()
        cloud = self.noise.fractal(directions * directions.new_tensor([1.5, 1.5, 2.5]) + 29, 4)
        sky = mix((0.86, 0.78, 0.68), (0.16, 0.36, 0.62), (1.3 * height).sqrt())
        return mix(sky, (0.93, 0.92, 0.90), (4 * cloud - 1.75).clamp(max=0.85))

    def surface_points(self, count: int, seed: int) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"]]:
        """Points and outward normals, area-uniform on the outside of the union, a function of the arguments."""
        generator = torch.Generator().manual_seed(seed)
        areas = torch.tensor([solid.shape.area for solid in self.solids])
        points, normals = torch.empty(0, 3), torch.empty(0, 3)
        while len(points) < count:
            owner = torch.multinomial(areas, count, replacement=True, generator=generator)
            uniform = torch.rand(count, 3, generator=generator)
            new_points, new_normals = self._sample(owner, uniform)
            points, normals = torch.cat([points, new_points]), torch.cat([normals, new_normals])
        return points[:count], normals[:count]

    def _sample(self, owner: Tensor, uniform: Float[Tensor, "n 3"]) -> tuple[Tensor, Tensor]:
        """Surface points of the solids named by ``owner``, without those inside another solid."""
        points, normals = torch.zeros_like(uniform), torch.zeros_like(uniform)
        outside = torch.ones_like(owner, dtype=torch.bool)
        for index, solid in enumerate(self.solids):
            mine = owner == index
            local, pose = solid.shape.sample(uniform[mine]), solid.world_from_shape
            points[mine] = local @ pose[:, :3].T + pose[:, 3]
            normals[mine] = solid.shape.normal(local) @ pose[:, :3].T
        for index, solid in enumerate(self.solids):
            outside &= (owner == index) | (solid.distance(points) > 0)
        return points[outside], normals[outside]


def photograph(
    scene: SyntheticScene,
    camera_directions: Float[Tensor, "tall wide 3"],
    world_from_camera: Float[Tensor, "3 4"],
    samples: int,
) -> Float[Tensor, "height width 3"]:
    """What a camera sees; ``camera_directions`` hold samples x samples unit ray directions per pixel."""
    rays = rays_of_view(camera_directions.reshape(-1, 3), world_from_camera, near=0.0, far=math.inf)
    chunks = zip(*(part.split(CHUNK) for part in rays), strict=True)
    colour = torch.cat([scene.trace(Rays(*chunk)).colour for chunk in chunks])
    tall, wide, _ = camera_directions.shape
    return colour.reshape(tall // samples, samples, wide // samples, samples, 3).mean((1, 3))


def still_life(seed: int = 0, highlight: float = 0.0) -> SyntheticScene:
    """A round mosaic table with fruit, a doughnut, a present, a pot and a small tree."""
    noise = make_noise(seed)

    def solid(shape: Shape, texture: Callable, x: float, y: float, z: float, turn: float = 0.0) -> Solid:
        cos, sin = math.cos(turn), math.sin(turn)
        pose = torch.tensor([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z]])
        return Solid(shape, pose, partial(texture, noise))

    sink = 0.004  # what stands on the table reaches a little into it, so that no two surfaces coincide
    solids = (
        solid(Frustum(TABLE_RADIUS, TABLE_RADIUS, 0.05), textures.mosaic, 0.0, 0.0, -0.05),
        solid(Box((0.24, 0.20, 0.15)), textures.wrapping, -0.30, 0.28, 0.15 - sink, 0.45),
        solid(Sphere(0.24), textures.marble, 0.34, 0.36, 0.24 - sink),
        solid(Frustum(0.17, 0.25, 0.21), textures.banded, -0.50, -0.30, 0.21 - sink, 0.3),
        solid(Frustum(0.23, 0.0, 0.30), textures.foliage, -0.50, -0.30, 0.70, 1.0),
        solid(Torus(0.19, 0.085), textures.doughnut, 0.14, -0.42, 0.085 - sink, 0.7),
        solid(Sphere(0.13), textures.peel, 0.56, -0.12, 0.13 - sink),
        solid(Sphere(0.115), textures.peel, -0.30, 0.28, 0.3 - 2 * sink + 0.115, 2.0),
    )
    return SyntheticScene(solids, noise, highlight)


def ring_of_cameras(count: int, seed: int = 0) -> Float[np.ndarray, "count 3 4"]:
    """Poses world_from_camera of a walk around the table at three heights, hand-held: no two alike."""
    random = np.random.default_rng(seed)
    index = np.arange(count)
    azimuth = 2 * np.pi * (index + random.uniform(-0.2, 0.2, count)) / count
    elevation = np.deg2rad(np.array([28.0, 40.0, 52.0])[index % 3] + random.uniform(-4, 4, count))
    distance = random.uniform(2.9, 3.3, count)
    ring = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    centres = distance[:, None] * np.stack(ring, axis=-1)
    # Every photographer aims a little beside the middle and tilts the camera a little.
    aims = np.array([0, 0, 0.2]) + random.uniform(-0.08, 0.08, (count, 3))
    roll = np.deg2rad(random.uniform(-4, 4, count))
    cos, sin, zero, one = np.cos(roll), np.sin(roll), np.zeros(count), np.ones(count)
    tilt = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=-1).reshape(count, 3, 3)
    level = look_at(centres - aims, np.zeros(3))
    return np.concatenate([level[:, :, :3] @ tilt, centres[:, :, None]], axis=2)
