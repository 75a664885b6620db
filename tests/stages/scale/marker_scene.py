"""Photos of printed markers on a table, with exactly known cameras."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.rendering.srgb_arrays import srgb_values
from stages.sfm.colmap.cameras import camera_rays

CAMERA = Camera("SIMPLE_RADIAL", 480, 360, (430.0, 238.0, 182.0, -0.05))
TEXELS = 24  # a cell of a marker
SUPERSAMPLING = 4


class Printed(NamedTuple):
    """A marker on the table z = 0, its black square of ``side`` about ``centre``, stretched along its x axis; ``cut``
    is the fraction of the black square missing at its right edge."""

    dictionary: str
    number: int
    side: float
    centre: tuple[float, float] = (0.0, 0.0)
    turned: float = 0.3
    mirrored: bool = False
    stretch: float = 1.0
    cut: float = 0.0

    def light_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Linear light at points of the table; NaN beyond its white margin."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        cells = dictionary.markerSize + 2
        picture = cv2.aruco.generateImageMarker(dictionary, self.number, cells, borderBits=1) / 255
        picture = picture[:, ::-1] if self.mirrored else picture
        across, down = x - self.centre[0], y - self.centre[1]
        c, s = np.cos(self.turned), np.sin(self.turned)
        u = (c * across + s * down) / (self.side * self.stretch) + 0.5
        v = (s * across - c * down) / self.side + 0.5  # rows run down, y up
        column, row = (np.clip((a * cells).astype(int), 0, cells - 1) for a in (u, v))
        black = (u >= 0) & (u < 1 - self.cut) & (v >= 0) & (v < 1)
        paper = np.where(black, 0.03 + 0.8 * picture[row, column], 0.83)
        margin = 1.5 / cells
        on_paper = (u > -margin) & (u < 1 + margin) & (v > -margin) & (v < 1 + margin)
        return np.where(on_paper, paper, np.nan)


def poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """World from camera (count, 3, 4) of photos from above the table, aslant."""
    angles = np.linspace(0, 5, count) + rng.normal(0, 0.1, count)
    places = np.stack([0.75 * np.cos(angles), 0.75 * np.sin(angles), 0.7 + 0.2 * rng.random(count)], axis=1)
    return look_at(places, rng.normal(0, 0.03, (count, 3)))


@cache
def supersampled_rays() -> np.ndarray:
    """Ray directions of the camera, SUPERSAMPLING² a pixel."""
    return camera_rays(CAMERA, CAMERA.width * SUPERSAMPLING, CAMERA.height * SUPERSAMPLING).astype(float)


def photograph_markers(markers: Sequence[Printed], pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An sRGB photo (h, w, 3) uint8 of markers on a table of blotches: averaged over pixels in linear light, with a
    blur as of a lens and some noise."""
    rays = supersampled_rays() @ pose[:, :3].T
    distance = -pose[2, 3] / rays[..., 2]
    x, y = pose[0, 3] + distance * rays[..., 0], pose[1, 3] + distance * rays[..., 1]
    light = 0.25 + 0.1 * np.sin(9 * x + 4 * y) * np.sin(7 * y - 2 * x)
    for marker in markers:
        shown = marker.light_at(x, y)
        light = np.where(np.isnan(shown), light, shown)
    light = cv2.GaussianBlur(light, (0, 0), 0.7 * SUPERSAMPLING)
    light = cv2.resize(light, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    srgb = srgb_values(np.clip(light, 0, 1)) + rng.normal(0, 0.006, light.shape)
    return np.repeat((srgb.clip(0, 1) * 255).round().astype(np.uint8)[..., None], 3, axis=2)


def scene_of(poses_: np.ndarray, scene_from_sfm: Similarity, files: Sequence[str]) -> Scene:
    """A scene with these world poses, in a scene frame that is the world."""
    views = tuple(
        View(file, f"images/{file}", 0, pose, 0.1, 3.0, "train") for file, pose in zip(files, poses_, strict=True)
    )
    return Scene((CAMERA,), views, scene_from_sfm, False, False, "object-centric", True)
