"""A plain backdrop: photos without alpha that show an object before black, white or another single colour.

The borders of the photos tell. Where they all have one colour, up to what a field could not tell from it, nothing is
known to be there: what a field shows where it is empty is that colour, as it is white where photos have alpha. It is no
alpha: a black part of an object before black stays a part of it.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from nerf.geometry.normalisation import Normalisation
from nerf.geometry.scene import BACKDROP_TOLERANCE, Split
from stages.contract import Progress
from stages.io.amounts import rgb
from stages.io.photos import Box, Photo, spread
from stages.io.pixels import box_of, load_pixels, loaders

LONG_SIDE = 200  # pixels of a photo made small, in which a thin part still has one
BORDER = 2  # of these pixels, at each edge
FEW = 8  # photos, evenly spread: they can rule a backdrop out without a look at the others
# Of the borders of all photos: an object may reach an edge in some. The photos of scenes have at most 0.43
# (docs/experiments/effects.md).
MIN_SHARE = 0.9


class Backdrop(NamedTuple):
    """``colour``: red, green and blue, sRGB in [0, 1]. ``share``: how much of the photos' borders has it. ``opaque``:
    by photo, what holds all that has not; None: all of the photo may, as in test photos, which decide nothing."""

    colour: tuple[float, float, float]
    share: float
    opaque: list[Box | None]


def find_backdrop(ingest: Path, photos: Sequence[Photo], split: Sequence[Split]) -> Backdrop | None:
    """The backdrop of the training photos; None where they have none, or where masks or transparent parts say what
    counts."""
    if any(photo.mask or photo.has_alpha for photo in photos):
        return None
    train = [photo for photo, part in zip(photos, split, strict=True) if part == "train"]
    few = [train[i] for i in spread(len(train), min(len(train), FEW))]
    with ThreadPoolExecutor(loaders(ingest / photo.file for photo in few)) as pool:
        borders = list(pool.map(lambda photo: _border(_small(ingest, photo)), few))
        colour = np.median([np.median(border, axis=0) for border in borders], axis=0)
        if np.mean([_has(colour, border).mean() for border in borders]) < MIN_SHARE:
            return None
        looks = list(pool.map(lambda photo: _look(_small(ingest, photo), colour), train))
    share = float(np.mean([share for share, _ in looks]))
    if share < MIN_SHARE:
        return None
    red, green, blue = (float(value) / 255 for value in colour)
    boxes = iter(box for _, box in looks)
    return Backdrop((red, green, blue), share, [next(boxes) if part == "train" else None for part in split])


def backdrop_or_none(backdrop: Backdrop, found: Normalisation, progress: Progress) -> Backdrop | None:
    """``backdrop`` where nothing of the scene lies outside of what it leaves, else None; says which."""
    borders = f"{backdrop.share:.0%} of the photos' borders are {rgb(backdrop.colour)}"
    if not found.bounded:
        beyond = f"{found.beyond_alpha:.1%} of the tracked points lie outside the rest"
        progress.note("normalise.backdrop-beyond-region", f"{borders}, but {beyond}: it is no backdrop")
        return None
    so = "a plain backdrop, before which the object is shown alone (--effect background=on models it instead)"
    progress.note("normalise.backdrop", f"{borders}: {so}")
    return backdrop


def _small(ingest: Path, photo: Photo) -> np.ndarray:
    """A photo (h, w, 3) uint8, LONG_SIDE pixels along its longer side or, if that is less, its own size; means of 3 × 3
    of them: noise in one does not count, a part of an object does."""
    shrink = max(1.0, max(photo.width, photo.height) / LONG_SIDE)
    width, height = round(photo.width / shrink), round(photo.height / shrink)
    return cv2.blur(load_pixels(ingest / photo.file, width, height, quick=True)[..., :3], (3, 3))


def _border(pixels: np.ndarray) -> np.ndarray:
    """The pixels (n, 3) along the edges of a photo."""
    inner = np.zeros(pixels.shape[:2], bool)
    inner[BORDER:-BORDER, BORDER:-BORDER] = True
    return pixels[~inner]


def _has(colour: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return np.all(np.abs(pixels - colour) <= BACKDROP_TOLERANCE, axis=-1)


def _look(pixels: np.ndarray, colour: np.ndarray) -> tuple[float, Box | None]:
    """How much of a photo's border has the colour, and what holds all that has another one."""
    return float(_has(colour, _border(pixels)).mean()), box_of(~_has(colour, pixels))
