"""Masks: which parts of a photo are to be ignored. Black ignores, in the user's files as in ours."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.ingest.auxiliary_files import marks_ignored
from stages.ingest.decoding import Decoded, DecodeError, decode, upright_size
from stages.ingest.orientation import turned_size, upright
from stages.io.files import write_png
from stages.io.photos import Photo
from stages.io.pixels import colour_range, pillow

USE_FROM = 128  # of 255: from here on a pixel counts as used
NEARLY_BLACK, NEARLY_WHITE = 16, 239  # of 255: what compression leaves of black and white
MIN_GREY, MAX_LABELS = 0.25, 32  # of a picture's pixels; values
STILL_BACKGROUND_HINT = (
    "If the object turned in front of a still background, mask the background (masks/NAME.png, black is ignored) "
    "or use a plain backdrop."
)


@dataclass(frozen=True)
class Mask:
    """A mask as large as its photo: ``pixels`` (h, w) uint8, 255 use, 0 ignore; what was done to make it fit.

    ``ambiguous``: its shape does not tell whether it is of the upright photo or of what its file stores. ``grey``: it
    is neither black nor white for the most part, as a picture would be.
    """

    pixels: np.ndarray
    turned: bool
    resized: bool
    ambiguous: bool
    grey: bool


def are_of_stored_pixels(pairs: Iterable[tuple[Path, Path]]) -> bool | None:
    """Whether masks are of photos as their files store them, by the headers of all pairs of a photo and its mask: True
    where some fit no upright photo, False where some fit no other; None where none or both are so."""
    told: set[bool] = set()
    for photo, mask in pairs:
        try:
            (size, orientation), (found, _) = upright_size(photo), upright_size(mask)
        except DecodeError:  # said where it is decoded
            continue
        fits, fits_stored = _same_shape(found, size), _same_shape(found, turned_size(size, orientation))
        if fits != fits_stored:
            told.add(fits_stored)
    return told.pop() if len(told) == 1 else None


def read_mask(file: Path, width: int, height: int, orientation: int, stored: bool = False) -> Mask:
    """The mask of an upright photo of this size, whose file had this EXIF orientation.

    A mask of the shape of the file as it was stored is turned like the photo; where it has the upright photo's as well
    only if the set's masks are known to be of ``stored`` pixels, and it has no EXIF orientation of its own. One of the
    same shape and another size is resized to the nearest pixels. Raises DecodeError, words to follow the name of the
    photo, where it cannot be used.
    """
    try:
        decoded = decode(file)
    except DecodeError as error:
        raise DecodeError("ingest.mask-unusable", f"its mask {file.name} cannot be used: {error}") from error
    light, grey = _light(decoded, file)
    if marks_ignored(file.name):  # all that is not black, as instant-ngp has it, but for what losses leave of black
        light = np.where(light >= (USE_FROM if decoded.lossy else 1), np.uint8(0), np.uint8(255))
    pixels = np.where(light >= USE_FROM, np.uint8(255), np.uint8(0))
    size, found = (width, height), (pixels.shape[1], pixels.shape[0])
    fits, fits_stored = _same_shape(found, size), _same_shape(found, turned_size(size, orientation))
    if not (fits or fits_stored):
        shapes = f"{found[0]}×{found[1]} and the photo is {width}×{height}"
        raise DecodeError("ingest.mask-shape", f"its mask {file.name} does not fit: it is {shapes}")
    ambiguous = fits and fits_stored and orientation != 1 and decoded.camera_key.orientation == 1
    turned = stored if ambiguous else not fits
    if turned:
        pixels = _turned(pixels, orientation)
    resized = (pixels.shape[1], pixels.shape[0]) != size
    if resized:
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST)
    if not pixels.any():
        alpha = ", where it is not transparent" if decoded.pixels.shape[2] == 4 else ""
        raise DecodeError(
            "ingest.mask-empty",
            f"its mask {file.name} ignores the whole photo (its brightest value is {light.max()} of 255{alpha})",
        )
    return Mask(pixels, turned, resized, ambiguous, grey)


def _light(decoded: Decoded, file: Path) -> tuple[np.ndarray, bool]:
    """How bright a mask's pixels are, (h, w) uint8, and whether it looks like a picture.

    In a picture that is cut out the transparent parts are the mask. In labels, small numbers without losses, all but 0
    is used, as COLMAP and nerfstudio have it.
    """
    _, light = colour_range(decoded.pixels)
    if decoded.pixels.shape[2] == 4:
        alpha = decoded.pixels[..., 3]
        if _is_picture(light[alpha >= USE_FROM]):
            return alpha, False
        return np.rint(light * (alpha / 255.0)).astype(np.uint8), False
    if not light.any() and decoded.stored == "deep grey":  # 1 of 65535
        with pillow().open(file) as image:
            labels = Image.fromarray((np.asarray(image) > 0).astype(np.uint8))
        light = np.asarray(upright(labels, decoded.camera_key.orientation))
    if light.max() < USE_FROM and not decoded.lossy:
        light = np.where(light > 0, np.uint8(255), np.uint8(0))
    return light, _is_picture(light)


def _is_picture(light: np.ndarray) -> bool:
    """Whether many pixels are grey, in many shades: soft edges are few, labels are few values."""
    grey = light[(light > NEARLY_BLACK) & (light < NEARLY_WHITE)]
    return len(grey) > MIN_GREY * light.size and len(np.unique(grey)) > MAX_LABELS


def _same_shape(found: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether a size is another one in a smaller or larger copy, rounded to whole pixels: both sides of the smaller one
    may be off by half a pixel, each of which counts as often as the larger one is wide or high."""
    return abs(found[0] * wanted[1] - found[1] * wanted[0]) <= max(*found, *wanted)


def _turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    return np.ascontiguousarray(upright(Image.fromarray(pixels), orientation))


def write_feature_masks(ingest: Path, photos: Sequence[Photo], folder: Path) -> bool:
    """Write for COLMAP, as ``folder/<image name>.png``, where features may lie: neither ignored nor transparent.

    Returns whether any photo has such a mask; without, nothing is written.
    """
    masked = [photo for photo in photos if photo.mask or photo.has_alpha]
    for photo in masked:
        allowed = np.full((photo.height, photo.width), 255, np.uint8)
        if photo.mask:
            with pillow().open(ingest / photo.mask) as mask:
                allowed = np.asarray(mask)
        if photo.has_alpha:
            with pillow().open(ingest / photo.file) as image:
                allowed = np.where(np.asarray(image.getchannel("A")) > 0, allowed, np.uint8(0))
        write_png(folder / f"{photo.image_name}.png", allowed)
    return bool(masked)
