"""Synthetic photo sets that structure-from-motion finds hard, each with the truth about its cameras.

Small on purpose: photos of 320 × 240, a dozen each, one lens and one walk unless the case is about just that.
"""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import SyntheticScene, photograph, ring_of_cameras, still_life
from nerf.synthetic.shapes import Frustum
from stages.sfm.colmap.cameras import camera_rays

WIDTH, HEIGHT = 320, 240
LENS = Camera("OPENCV", WIDTH, HEIGHT, (334.0, 333.0, 160.8, 119.5, -0.085, 0.032, 0.0011, -0.0008))
BARREL = Camera("OPENCV", WIDTH, HEIGHT, (250.0, 250.0, 161.0, 119.0, -0.30, 0.09, 0.0, 0.0))
# Equidistant, r = f θ: 150 degrees from corner to corner.
FISHEYE = Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, (152.8, 152.8, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0))
OFF_CENTRE = Camera("PINHOLE", WIDTH, HEIGHT, (330.0, 330.0, 186.0, 99.0))
WIDE = Camera("PINHOLE", WIDTH, HEIGHT, (250.0, 250.0, 160.0, 120.0))
TELE = Camera("PINHOLE", WIDTH, HEIGHT, (430.0, 430.0, 160.0, 120.0))
PLANE = -1  # the scene that is one flat mosaic

Picture = Float[np.ndarray, "height width 3"]  # sRGB in [0, 1]
Poses = Float[np.ndarray, "n 3 4"]


class Shot(NamedTuple):
    """One photo: its name, its lens, its pose world_from_camera, and the scene it shows (a seed, or PLANE)."""

    name: str
    camera: Camera
    pose: Float[np.ndarray, "3 4"]
    scene: int = 0


def as_taken(picture: Picture, index: int) -> Picture:
    """The picture as it is."""
    return picture


def exposed(picture: Picture, index: int) -> Picture:
    """From −2 to +2 EV over a dozen photos, in linear light, clipped as a sensor clips."""
    stops = -2 + 4 * index / 11
    linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4) * 2.0**stops
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def every_fifth_blurred(picture: Picture, index: int) -> Picture:
    """Every fifth photo smeared along 15 pixels, as a shaken camera does it."""
    kernel = np.full((1, 15), 1 / 15)
    return cv2.filter2D(picture, -1, kernel) if index % 5 == 2 else picture


def shoot(folder: Path, shots: Sequence[Shot], develop: Callable[[Picture, int], Picture] = as_taken) -> None:
    """Draw every shot into ``folder`` as PNG; ``develop`` gets each picture and its number."""
    for index, shot in enumerate(shots):
        picture = develop(_picture(shot.camera, shot.pose.tobytes(), shot.scene), index)
        path = folder / shot.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(path)


@cache  # many sets share photos
def _picture(camera: Camera, pose: bytes, scene: int) -> Picture:
    with torch.inference_mode():
        world_from_camera = torch.tensor(np.frombuffer(pose).reshape(3, 4), dtype=torch.float32)
        return photograph(_scene(scene), _bearings(camera), world_from_camera, 2).double().numpy()


@cache
def _bearings(camera: Camera) -> "torch.Tensor":
    return torch.from_numpy(camera_rays(camera, 2 * camera.width, 2 * camera.height))


@cache
def _scene(number: int) -> "SyntheticScene":
    if number != PLANE:
        return still_life(number)
    table = still_life(3)
    return table._replace(solids=(table.solids[0]._replace(shape=Frustum(30.0, 30.0, 0.05)),))


def walk(count: int, of: int = 36, start: int = 0) -> Poses:
    """``count`` of ``of`` poses on a walk around the still life, from number ``start`` on."""
    return ring_of_cameras(of)[start : start + count]


def closer(poses: Poses, share: float) -> Poses:
    """The same views from so much of the distance to the middle of the table."""
    poses = poses.copy()
    poses[:, :, 3] *= share
    return poses


def along(poses: Poses, camera: Camera = LENS, scene: int = 0, prefix: str = "photo") -> list[Shot]:
    """One shot per pose."""
    return [Shot(f"{prefix}_{index:03d}.png", camera, pose, scene) for index, pose in enumerate(poses)]


def on_the_spot(count: int = 12) -> Poses:
    """One place, and the camera turned to look here and there on the table."""
    centre = np.array([2.6, 0.0, 1.6])
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    aims = np.stack([np.zeros(count), 0.5 * np.cos(angles), 0.2 + 0.4 * np.sin(angles)], axis=1)
    poses = look_at(centre - aims, np.zeros(3))
    poses[:, :, 3] = centre
    return poses


def straight_ahead(count: int = 12) -> Poses:
    """Steps towards what the first photo of the walk has in its middle."""
    poses = np.repeat(walk(1), count, axis=0)
    poses[:, :, 3] += 0.12 * np.arange(count)[:, None] * poses[:, :, 2]
    return poses


def two_lenses() -> list[Shot]:
    """Every other photo with a longer lens, each lens in a folder of its own."""
    shots = [(TELE, "tele") if index % 2 else (WIDE, "wide") for index in range(14)]
    return [
        Shot(f"{folder}/photo_{index:03d}.png", lens, pose)
        for index, ((lens, folder), pose) in enumerate(zip(shots, walk(14), strict=True))
    ]
