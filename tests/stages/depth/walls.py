"""Photos of textured walls whose distance is known exactly at every pixel, as finished folders of ingest and normalise.

A wall is a rectangle in space with a picture on it: strong, weak or no texture, or one that repeats. Photos are drawn
by looking the picture up where a ray meets the nearest wall, so they cost next to nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.io.files import write_json, write_png, write_tensors
from stages.io.photos import Photo, write_photos
from stages.sfm.colmap.cameras import camera_rays, project

PINHOLE = Camera("PINHOLE", 240, 180, (230.0, 230.0, 120.0, 90.0))
FISHEYE = Camera("OPENCV_FISHEYE", 240, 180, (120.0, 120.0, 120.0, 90.0, 0.02, -0.005, 0.0, 0.0))
SAMPLES = 3  # per side of a pixel
TEXELS = 160  # of a picture, per scene unit
POINTS = 400  # on each wall


class Wall(NamedTuple):
    """The points centre + u · across + v · down, u and v in [-1, 1], and the picture on them, grey in [0, 1]. Of a
    mirror (1) or a window pane (less) ``reflects`` says how much light it throws back; the rest comes from behind."""

    centre: np.ndarray
    across: np.ndarray
    down: np.ndarray
    picture: np.ndarray
    reflects: float = 0.0


rays_of = cache(camera_rays)


def wall(
    centre: Sequence[float], half: tuple[float, float], turn_deg: float = 0.0, texture: str = "strong", seed: int = 0
) -> Wall:
    """A wall that faces -y, turned about the vertical; z is up."""
    turn = np.radians(turn_deg)
    across = half[0] * np.array([np.cos(turn), np.sin(turn), 0])
    size = [round(2 * TEXELS * length) for length in half]
    return Wall(np.array(centre, float), across, np.array([0, 0, -half[1]]), picture(texture, size, seed))


def picture(texture: str, size: Sequence[int], seed: int) -> np.ndarray:
    """(rows, columns) grey: noise over several scales, ``weak`` with a twentieth of its contrast, ``none`` at all, or
    ``repeated``: one tile again and again."""
    random, (columns, rows) = np.random.default_rng(seed), size
    if texture == "repeated":
        tile = picture("strong", (32, 32), seed)
        return np.tile(tile, (-(-rows // 32), -(-columns // 32)))[:rows, :columns]
    noise = np.zeros((rows, columns))
    for scale in (2, 4, 8, 16):
        coarse = random.normal(size=(rows // scale + 2, columns // scale + 2))
        noise += scale * cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
    contrast = {"strong": 0.2, "weak": 0.01, "none": 0.0}[texture]
    return np.clip(0.5 + contrast * noise / noise.std(), 0, 1).astype(np.float32)


def _meet(
    one: Wall, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """How far along rays a wall's plane is, whether they meet the wall there, and where on it."""
    normal = np.cross(one.across, one.down)
    t = ((one.centre - origins) @ normal) / (directions @ normal)
    at = origins + t[..., None] * directions - one.centre
    u, v = (at @ axis / (axis @ axis) for axis in (one.across, one.down))
    return t, (t > 0) & (np.abs(u) <= 1) & (np.abs(v) <= 1), (u, v)


@dataclass(frozen=True)
class WallScene:
    """Walls, and cameras that look at them. ``gains`` multiply the photos' values; all photos have the ``mask``."""

    walls: Sequence[Wall]
    poses: np.ndarray
    camera: Camera = PINHOLE
    gains: Sequence[float] = ()
    noise: float = 1.0  # grey values
    mask: np.ndarray | None = None
    seed: int = 0

    def trace(self, view: int, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(grey in [0, 1], distance) along rays (h, w, 3) of a camera; grey 0.5 and infinity where there is no wall.
        In a mirror the distance is that of what is seen in it, along the whole way of the light; through a window pane
        that of what is behind it."""
        origin, directions = self.poses[view][:, 3], rays.astype(float) @ self.poses[view][:, :3].T
        grey, distance = self._solid(np.broadcast_to(origin, directions.shape), directions)
        for glass in (one for one in self.walls if one.reflects):
            t, hit, _ = _meet(glass, origin, directions)
            hit &= t < distance
            normal = np.cross(glass.across, glass.down)
            normal = normal / np.linalg.norm(normal)
            mirrored = directions - 2 * (directions @ normal)[..., None] * normal
            seen, beyond = self._solid(origin + t[..., None] * directions + 1e-6 * mirrored, mirrored)
            grey = np.where(hit, grey + glass.reflects * (seen - grey), grey)
            distance = np.where(hit & (glass.reflects == 1), t + beyond, distance)
        return grey, distance

    def _solid(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`trace`, without glass."""
        grey, distance = np.full(directions.shape[:2], 0.5), np.full(directions.shape[:2], np.inf)
        for one in (one for one in self.walls if not one.reflects):
            t, hit, (u, v) = _meet(one, origins, directions)
            hit &= t < distance
            rows, columns = one.picture.shape
            x, y = ((w.astype(np.float32) + 1) / 2 * n - 0.5 for w, n in ((u, columns), (v, rows)))
            colour = cv2.remap(one.picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            grey, distance = np.where(hit, colour, grey), np.where(hit, t, distance)
        return grey, distance

    def photo(self, view: int) -> np.ndarray:
        """(height, width, 3) uint8."""
        width, height = self.camera.width, self.camera.height
        fine = self.trace(view, rays_of(self.camera, SAMPLES * width, SAMPLES * height))[0]
        grey = fine.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
        random = np.random.default_rng((self.seed, view))
        grey = 255 * grey * (self.gains[view] if self.gains else 1) + self.noise * random.normal(size=grey.shape)
        return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def distances(self, view: int, width: int, height: int) -> np.ndarray:
        """The true depth map (height, width) of a photo; infinity where there is no wall."""
        return self.trace(view, rays_of(self.camera, width, height))[1]

    def tracks(self) -> dict[str, np.ndarray]:
        """points.safetensors: points of all walls but mirrors and panes, seen wherever they are in a photo and nothing
        hides them."""
        random = np.random.default_rng(self.seed)
        walls = [one for one in self.walls if not one.reflects]
        spots = random.uniform(-1, 1, (len(walls), POINTS, 2))
        xyz = np.concatenate(
            [w.centre + spots[i, :, :1] * w.across + spots[i, :, 1:] * w.down for i, w in enumerate(walls)]
        )
        seen = []
        for view, pose in enumerate(self.poses):
            local = (xyz - pose[:, 3]) @ pose[:, :3]
            distance = np.linalg.norm(local, axis=1)
            first = self.trace(view, (local / distance[:, None])[None])[1][0]
            xy = project(self.camera, local)
            inside = ((xy > 0) & (xy < [self.camera.width, self.camera.height])).all(axis=1)
            point = np.flatnonzero(inside & (first > 0.999 * distance))
            seen.append((np.full(len(point), view), point, xy[point]))
        view, point, xy = (np.concatenate(column) for column in zip(*seen, strict=True))
        return {
            "xyz": xyz.astype(np.float32),
            "rgb": np.full((len(xyz), 3), 128, np.uint8),
            "error_px": np.zeros(len(xyz), np.float32),
            "view": view.astype(np.int32),
            "point": point.astype(np.int32),
            "xy": xy.astype(np.float32),
        }

    def write(self, folder: Path, with_tracks: bool = True, test_every: int = 100) -> dict[str, Path]:
        """Write the folders of ingest and normalise; every ``test_every``-th photo from the last is a test photo."""
        inputs = {name: folder / name for name in ("ingest", "normalise")}
        (inputs["ingest"] / "images").mkdir(parents=True)
        inputs["normalise"].mkdir()
        about, views, count = [], [], len(self.poses)
        for index in range(count):
            file, mask = f"images/{index:03d}.png", None
            Image.fromarray(self.photo(index)).save(inputs["ingest"] / file, compress_level=1)
            if self.mask is not None:
                mask = f"masks/{index:03d}.png"
                write_png(inputs["ingest"] / mask, self.mask)
            about.append(
                Photo(f"{index:03d}.png", file, self.camera.width, self.camera.height, 0, None, None, False, 1.0)
            )
            split = "test" if index % test_every == test_every - 1 else "train"
            views.append(View(f"{index:03d}.png", file, 0, self.poses[index], 0.5, 20.0, split, mask))
        write_photos(inputs["ingest"], about, [], {})
        still = Similarity(1.0, np.eye(3), np.zeros(3))
        scene = Scene((self.camera,), tuple(views), still, False, False, "forward-facing", True)
        write_json(inputs["normalise"] / "scene.json", scene.to_json())
        points = self.tracks()
        if not with_tracks:
            points |= {name: points[name][:0] for name in ("xyz", "rgb", "error_px", "view", "point", "xy")}
        write_tensors(inputs["normalise"] / "points.safetensors", points)
        return inputs


def cameras_before(
    spacing: float = 0.22, distance: float = 2.5, rows: int = 2, columns: int = 3, roll_deg: float = 0.0
) -> np.ndarray:
    """A grid of hand-held cameras at y = -distance that look at the origin."""
    x, z = np.meshgrid(spacing * (np.arange(columns) - (columns - 1) / 2), spacing * (np.arange(rows) - (rows - 1) / 2))
    random = np.random.default_rng(1)
    shake = 0.1 * spacing * random.normal(size=(x.size, 3))
    centres = np.stack([x.ravel(), np.full(x.size, -distance), z.ravel()], axis=1) + shake
    poses = look_at(centres, np.zeros(3))
    roll = np.radians(roll_deg) * np.arange(x.size)
    cos, sin, zero, one = np.cos(roll), np.sin(roll), np.zeros(x.size), np.ones(x.size)
    turn = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return np.concatenate([poses[:, :, :3] @ turn, poses[:, :, 3:]], axis=2)
