"""A training photo as a source of colour for a surface: where it shows which points, how finely, and in which colours.

Colours are sRGB in [0, 1] at the reference exposure: what the photo's exposure and vignetting did to them is undone in
linear light (nerf/effects), as in new views of the field. Pixels are (x, y) of the photo's own size.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from nerf.effects import ColourEffect
from nerf.geometry.rays import Rays
from nerf.geometry.scene import Camera, Scene, View
from stages.contract import StageError
from stages.effects.image_effects import new_view_effects, photo_effects
from stages.io.photos import read_photos
from stages.io.pixels import OPAQUE_FROM, load_mask, load_pixels, loaders
from stages.sfm.colmap.cameras import mean_focal_and_centre, project

REMAP_SIDE = 1 << 14  # points that OpenCV takes in a row


class Photo(NamedTuple):
    """A training photo: ``focal_px`` its mean focal length, ``sharpness`` 1 where it is as sharp as its neighbours,
    ``effects`` what it does to the scene's colours and ``shown`` what new views do to them. ``has_alpha``: its alpha,
    if any, says what is background."""

    view: View
    camera: Camera
    folder: Path
    focal_px: float
    sharpness: float
    effects: tuple[ColourEffect, ...]
    shown: tuple[ColourEffect, ...]
    has_alpha: bool


class Projection(NamedTuple):
    """Where a photo's camera sees points: ``pixels`` (n, 2), ``depth`` (n,) along its axis, whether they lie ``ahead``
    of it, (n,) bool, and whether ``inside`` its image. What is not ahead has finite pixels and depths without meaning.
    """

    pixels: np.ndarray
    depth: np.ndarray
    ahead: np.ndarray
    inside: np.ndarray


class Picture(NamedTuple):
    """A photo's pixels at a reduced size, (h, w, 3) uint8, and which of them count, (h, w) uint8: 0 or 1."""

    pixels: np.ndarray
    used: np.ndarray


def photos_of(scene: Scene, ingest: Path, field: dict[str, Any]) -> list[Photo]:
    """The training photos; ``field``: the content of field.json."""
    return [photo_of(view, scene, ingest, field) for view in scene.of_split("train")]


def photo_of(view: View, scene: Scene, ingest: Path, field: dict[str, Any]) -> Photo:
    """One photo; of one that took no part in training, the effects that are expected."""
    camera = scene.cameras[view.camera]
    focal_px = mean_focal_and_centre(camera)[0]
    effects, shown = photo_effects(field, scene, view), new_view_effects(field)
    sharpness = _sharpness(ingest).get(view.file, 1.0)
    return Photo(view, camera, ingest, focal_px, sharpness, effects, shown, scene.has_alpha)


@lru_cache(maxsize=1)
def _sharpness(ingest: Path) -> dict[str, float]:
    return {photo.file: photo.relative_sharpness or 1.0 for photo in read_photos(ingest)}


def projected(photo: Photo, points: np.ndarray) -> Projection:
    """Where a photo shows ``points`` (n, 3) of the scene frame."""
    pose = photo.view.scene_from_camera
    local = (points - pose[:, 3]) @ pose[:, :3]
    pixels = project(photo.camera, local)
    ahead = np.isfinite(pixels).all(axis=1) & (local[:, 2] > 0)
    pixels[~ahead] = 0
    inside = ahead & ((pixels >= 0) & (pixels < [photo.camera.width, photo.camera.height])).all(axis=1)
    return Projection(pixels, np.where(ahead, local[:, 2], 1.0), ahead, inside)


def read_picture(photo: Photo, downscale: float) -> Picture:
    """The photo at 1/``downscale`` of its size. Masked pixels do not count, nor those that alpha says are background,
    with the mixed pixels beside them.

    Raises StageError where its file is gone or cannot be read.
    """
    width, height = (max(1, round(side / downscale)) for side in (photo.camera.width, photo.camera.height))
    try:
        pixels = load_pixels(photo.folder / photo.view.file, width, height, quick=True)
    except OSError as error:
        raise _unreadable(photo, error) from error
    mask = None if photo.view.mask is None else _mask(photo, photo.view.mask, width, height)
    used = np.ones((height, width), np.uint8) if mask is None else mask.astype(np.uint8)
    opaque = None
    if photo.view.alpha is not None:
        opaque = _mask(photo, photo.view.alpha, width, height)
    elif photo.has_alpha and pixels.shape[2] == 4:
        opaque = pixels[..., 3] >= OPAQUE_FROM
    if opaque is not None:
        inside = cv2.erode(opaque.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        used = np.minimum(used, np.asarray(inside, np.uint8))
    return Picture(np.ascontiguousarray(pixels[..., :3]), used)


def readers(photos: Sequence[Photo]) -> int:
    """How many of these photos to read at a time; one where a file is gone, as reading it then says."""
    try:
        return loaders(photo.folder / photo.view.file for photo in photos)
    except OSError:
        return 1


def unmasked(photo: Photo, place: Projection) -> np.ndarray:
    """Whether the photo's mask counts the pixel of each projected point, (n,) bool. Raises StageError like
    :func:`read_picture`."""
    if photo.view.mask is None:
        return np.ones(len(place.pixels), bool)
    width, height = photo.camera.width, photo.camera.height
    column, row = place.pixels.astype(np.int64).clip(0, [width - 1, height - 1]).T
    return _mask(photo, photo.view.mask, width, height)[row, column]


def _mask(photo: Photo, file: str, width: int, height: int) -> np.ndarray:
    try:
        return load_mask(photo.folder / file, width, height)
    except OSError as error:
        raise _unreadable(photo, error) from error


def _unreadable(photo: Photo, error: OSError) -> StageError:
    return StageError(
        "mesh.photo-unreadable",
        f"cannot read the photo {photo.view.name}",
        str(error),
        "Decode it again: pipeline ingest WORKSPACE --force. Or use none: --mesh.no-refine --mesh.texture-size 0.",
    )


def colours_at(photo: Photo, picture: Picture, pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What the photo shows at ``pixels`` (n, 2), where it shows ``points`` (n, 3): (n, 3) float32, sRGB at the
    reference exposure, linear between pixels."""
    colour = torch.from_numpy(_sampled(photo, picture.pixels, pixels) / np.float32(255))
    if not photo.effects and not photo.shown:
        return colour.numpy()
    directions = torch.from_numpy(points - photo.view.scene_from_camera[:, 3]).float()
    none = torch.zeros(len(points))
    rays = Rays(torch.zeros_like(directions), torch.nn.functional.normalize(directions, dim=1), none, none)
    view = torch.zeros(len(points), dtype=torch.int64)
    for effect in reversed(photo.effects):
        colour = effect.inverse(colour, rays, view)
    for effect in photo.shown:
        colour = effect.forward(colour, rays, view)
    return colour.clamp(0, 1).numpy()


def used_at(photo: Photo, picture: Picture, pixels: np.ndarray) -> np.ndarray:
    """Whether all four pixels around ``pixels`` (n, 2) count, (n,) bool."""
    return _sampled(photo, picture.used * np.uint8(255), pixels).reshape(-1) == 255


def _sampled(photo: Photo, image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """An image of the photo, at any size, at pixels of the photo's own size."""
    height, width = image.shape[:2]
    return sampled_picture(image, pixels * [width / photo.camera.width, height / photo.camera.height])


def sampled_picture(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """An image of uint8 at its ``pixels`` (n, 2), linear between their centres: (n, channels) uint8."""
    at = (pixels - 0.5).astype(np.float32)
    rows = max(1, -(-len(at) // REMAP_SIDE))
    at = np.concatenate([at, np.zeros((rows * REMAP_SIDE - len(at), 2), np.float32)])
    x, y = (np.ascontiguousarray(part).reshape(rows, REMAP_SIDE) for part in at.T)
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(rows * REMAP_SIDE, -1)[: len(pixels)]
