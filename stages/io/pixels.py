"""The pixels of photos and masks, decoded by Pillow, at any size."""

import logging
import warnings
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pillow_heif
from jaxtyping import Bool, UInt8
from PIL import Image

from nerf.geometry.scene import View
from stages.hardware.device import processors
from stages.io.photos import Box

OPAQUE_FROM = 128  # of 255: from here on a pixel is more opaque than transparent
DECODING_BYTES = 1 << 30  # how much memory may go into photos that are being loaded at a time
BYTES_PER_PIXEL = {
    1: 10,
    3: 16,
    4: 40,
}  # of the file, that loading and shrinking takes, by channels; 10 and 39 measured


CONTRAST_SCALE = 42.0  # 3 deviations fill 8 bits


@cache
def pillow() -> ModuleType:
    """Pillow, able to read HEIC, with its own pixel limit replaced by ours."""
    pillow_heif.register_heif_opener()
    Image.MAX_IMAGE_PIXELS = None
    # What is wrong with a file we say ourselves.
    warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")
    logging.getLogger("PIL").setLevel(logging.CRITICAL)
    Image.init()
    return Image


def opaque_box(pixels: np.ndarray) -> Box | None:
    """What holds all that is more than half opaque of (h, w, 3 or 4) uint8; None where all or nothing of it is."""
    if pixels.shape[2] != 4:
        return None
    return box_of(pixels[..., 3] >= OPAQUE_FROM)


def box_of(inside: Bool[np.ndarray, "h w"]) -> Box | None:
    """What holds all pixels that are ``inside``; None where all or none of them are."""
    if not inside.any() or inside.all():
        return None
    height, width = inside.shape
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    left, right = float(columns[0]) / width, float(columns[-1] + 1) / width
    return left, float(rows[0]) / height, right, float(rows[-1] + 1) / height


def colour_range(pixels: UInt8[np.ndarray, "h w _"]) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """The least and the greatest of each pixel's three colours; NumPy takes ten times as long along a short axis."""
    red, green, blue = (pixels[..., channel] for channel in range(3))
    return np.minimum(np.minimum(red, green), blue), np.maximum(np.maximum(red, green), blue)


def load_view(ingest: Path, view: View, width: int, height: int) -> np.ndarray:
    """:func:`load_pixels` of a view of the scene, with its alpha."""
    return load_pixels(ingest / view.file, width, height, None if view.alpha is None else ingest / view.alpha)


def load_pixels(path: Path, width: int, height: int, alpha_path: Path | None = None, quick: bool = False) -> np.ndarray:
    """The image as (height, width, 3 or 4) uint8, each pixel the mean of the area it covers; a grey picture of its size
    can be its alpha.

    The means are taken of sRGB values weighted by alpha (premultiplied); a pixel that nothing covers is black.
    At the image's own size the values are those stored. Enlarging interpolates linearly. ``quick``: a JPEG of four
    times the size or more may not be decoded whole; its values are nearly those means.
    """
    with pillow().open(path) as image:
        if quick:
            image.draft(image.mode, _draft_size(image.width, image.height, 2 * width, 2 * height))
        pixels = np.asarray(image)
    if alpha_path is not None:
        with pillow().open(alpha_path) as image:
            pixels = cv2.merge([*cv2.split(pixels)[:3], np.asarray(image)])
    if (pixels.shape[1], pixels.shape[0]) == (width, height):
        return pixels
    if pixels.shape[2] == 3:
        return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    *colours, alpha = (channel.astype(np.float32) for channel in cv2.split(pixels))
    for each in colours:
        each *= alpha
    resized = cv2.resize(cv2.merge([*colours, alpha]), (width, height), interpolation=cv2.INTER_AREA)
    covered = resized[..., 3:] > 0
    colour = np.divide(resized[..., :3], resized[..., 3:], out=np.zeros_like(resized[..., :3]), where=covered)
    return np.rint(np.concatenate([colour, resized[..., 3:]], axis=2)).astype(np.uint8)


def _draft_size(width: int, height: int, min_width: int, min_height: int) -> tuple[int, int]:
    """The size at which a JPEG can be decoded: a half, a quarter or an eighth of it, where nothing is left over, else
    the whole."""
    for scale in (8, 4, 2):
        if width % scale == height % scale == 0 and width >= scale * min_width and height >= scale * min_height:
            return width // scale, height // scale
    return width, height


def even_contrast(
    pixels: UInt8[np.ndarray, "h w"], nearby: Callable[[np.ndarray], np.ndarray], noise: float
) -> UInt8[np.ndarray, "h w"]:
    """Grey values over their mean and deviation, ``nearby`` of each pixel being the mean around it: exposure and
    vignetting, which differ between photos, go. What varies by less than ``noise`` stays faint."""
    grey = pixels.astype(np.float32)
    mean = nearby(grey)
    variance = np.maximum(nearby(grey * grey) - mean * mean, 0)
    even = (grey - mean) / np.sqrt(variance + noise**2)
    return np.clip(np.rint(128 + CONTRAST_SCALE * even), 0, 255).astype(np.uint8)


def loaders(files: Iterable[Path], channels: int = 0) -> int:
    """How many of these photos or masks to load at a time, each in a thread: one per core, fewer where they are too
    large for that. What counts is the size in the file, however small they are made afterwards. ``channels``: that they
    have at least, together with an alpha of another file."""
    return max(
        1, min(processors(), DECODING_BYTES // max((_loading_bytes(file, channels) for file in files), default=1))
    )


def _loading_bytes(file: Path, channels: int) -> int:
    """Memory that loading takes, by the file's header."""
    with pillow().open(file) as image:
        return BYTES_PER_PIXEL[max(channels, len(image.getbands()))] * image.width * image.height


def load_mask(path: Path, width: int, height: int) -> np.ndarray:
    """A mask that ingest wrote as (height, width) bool at a photo's reduced size, True where every pixel that goes into
    one is to be used."""
    with pillow().open(path) as image:
        ignored = (np.asarray(image) == 0).astype(np.float32)
    if ignored.shape != (height, width):
        ignored = cv2.resize(ignored, (width, height), interpolation=cv2.INTER_AREA)
    return ignored == 0
