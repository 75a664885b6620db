"""Synthetic reconstructions for tests: cameras in typical layouts and points that they see."""

from dataclasses import replace

import numpy as np

from nerf.geometry.camera_paths import look_at
from nerf.geometry.reconstruction import Reconstruction

FIELD_OF_VIEW_TAN = 0.5


def seen_by(poses: np.ndarray, points: np.ndarray) -> Reconstruction:
    """A reconstruction in which every camera observes all points that fall into its square field of view."""
    grid = np.linspace(-FIELD_OF_VIEW_TAN, FIELD_OF_VIEW_TAN, 9)
    ray_directions = np.stack([*np.meshgrid(grid, grid), np.ones((9, 9))], axis=-1).reshape(-1, 3)
    ray_directions /= np.linalg.norm(ray_directions, axis=1, keepdims=True)
    local = np.einsum("nji,nmj->nmi", poses[:, :, :3], points[None] - poses[:, None, :, 3])
    depth = np.where(local[..., 2] > 0, local[..., 2], np.inf)
    inside = (np.abs(local[..., :2]).max(axis=-1) <= FIELD_OF_VIEW_TAN * depth) & np.isfinite(depth)
    view, point = np.nonzero(inside)
    return Reconstruction(poses, np.repeat(ray_directions[None], len(poses), axis=0), points, view, point)


def opaque_everywhere(scene: Reconstruction) -> Reconstruction:
    """The scene with photos that have alpha, of which none is transparent anywhere."""
    return replace(scene, opaque=np.stack([scene.field(view) for view in range(len(scene.centres))]))


def ball(count: int = 400, radius: float = 1.0, seed: int = 0) -> np.ndarray:
    """Points in a ball about the origin."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * random.uniform(size=(count, 1)) ** (1 / 3) * directions


def ring(count: int = 16, radius: float = 4.0, height: float = 1.5, arc_deg: float = 360.0) -> np.ndarray:
    """Cameras on a level circle, or on an arc of it about -y, that look at the origin; +z is up."""
    angle = np.radians(-90 + arc_deg * (np.arange(count) / (count if arc_deg == 360 else count - 1) - 0.5))
    centres = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    return look_at(centres, np.zeros(3))


def wall(rows: int = 4, columns: int = 6, spacing: float = 0.3, distance: float = 4.0) -> np.ndarray:
    """A grid of cameras at y = -distance that all face +y."""
    x, z = np.meshgrid(spacing * (np.arange(columns) - (columns - 1) / 2), spacing * (np.arange(rows) - (rows - 1) / 2))
    centres = np.stack([x.ravel(), np.full(x.size, -distance), z.ravel()], axis=1)
    return np.concatenate([look_at(c[None], c + np.array([0.0, 1.0, 0.0])) for c in centres])


def survey(lines: int = 6, photos: int = 8, spacing: float = 30.0, height: float = 80.0) -> np.ndarray:
    """A flight over the ground along x, to and fro: each line of photos is turned against the one before it, and all
    look straight down."""
    x, y = np.meshgrid(np.arange(photos) - (photos - 1) / 2, np.arange(lines) - (lines - 1) / 2)
    centres = np.stack([spacing * x.ravel(), spacing * y.ravel(), np.full(x.size, height)], axis=1)
    fro = np.repeat(np.arange(lines) % 2, photos) > 0
    ahead = np.where(fro[:, None], [-1.0, 0, 0], [1.0, 0, 0])
    downwards = [look_at(c[None], c - [0, 0, 1.0], up=up) for c, up in zip(centres, ahead, strict=True)]
    return np.concatenate(downwards)


def ground(extent: float = 200.0, relief: float = 5.0, count: int = 3000, seed: int = 0) -> np.ndarray:
    """Points on rough ground at z = 0."""
    return np.random.default_rng(seed).uniform([-extent, -extent, 0], [extent, extent, relief], size=(count, 3))


def wall_points(count: int = 600, depth: float = 0.3, seed: int = 0) -> np.ndarray:
    """Points on a rough wall at y = 0."""
    random = np.random.default_rng(seed)
    return random.uniform([-3, -depth, -3], [3, depth, 3], size=(count, 3))


def room(count: int = 24) -> np.ndarray:
    """Cameras near the middle of a room that look outward all around, alternately up and down."""
    angle = 2 * np.pi * np.arange(count) / count
    centres = np.stack([0.8 * np.cos(angle), 0.5 * np.sin(angle), np.full(count, 1.6)], axis=1)
    outward = np.stack([np.cos(angle), np.sin(angle), np.where(np.arange(count) % 2, 0.2, -0.2)], axis=1)
    return np.concatenate([look_at(c[None], c + d) for c, d in zip(centres, outward, strict=True)])


def room_points(count: int = 1500, seed: int = 0) -> np.ndarray:
    """Points on the six faces of a room of 6 x 5 x 3."""
    random = np.random.default_rng(seed)
    points = random.uniform([-3, -2.5, 0], [3, 2.5, 3], size=(count, 3))
    face = random.integers(0, 6, size=count)
    bounds = np.array([[-3, -2.5, 0], [3, 2.5, 3]])
    points[np.arange(count), face % 3] = bounds[face // 3, face % 3]
    return points
