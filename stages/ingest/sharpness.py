"""How sharp photos are, and which are far less sharp than those around them; which show nothing at all."""

from collections.abc import Hashable, Sequence
from statistics import median

import cv2
import numpy as np

WIDTH = 1000  # pixels: what is finer than this share of the picture hardly counts later on
NEIGHBOURS = 3  # on each side
MIN_NEIGHBOURS = 3  # for their median to mean something
# A smear of n pixels thins the response to edges across it to about 1/n: here some four pixels of WIDTH.
BLURRED = 0.25


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000) of the grey image, at most WIDTH pixels wide, over its
    squared mean, of (h, w) or (h, w, 3 or 4) uint8: another exposure multiplies both by the same. 0 of a black one."""
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels[..., :3], cv2.COLOR_RGB2GRAY)
    if pixels.shape[2:] == (4,):  # what is transparent has no sharpness
        grey = np.rint(grey * (pixels[..., 3] / 255.0)).astype(np.uint8)
    grey = at_most(grey, WIDTH)
    mean = float(grey.mean())
    return float(f"{cv2.Laplacian(grey, cv2.CV_64F).var() / mean**2:.4g}") if mean else 0.0


def at_most(grey: np.ndarray, most: int) -> np.ndarray:
    """A grey picture, (h, w) uint8, made no wider than ``most`` pixels."""
    height, width = grey.shape
    if width <= most:
        return grey
    return cv2.resize(grey, (most, max(1, round(height * most / width))), interpolation=cv2.INTER_AREA)


def relative_sharpness(values: Sequence[float], groups: Sequence[Hashable]) -> list[float | None]:
    """Each sharpness over the median of its neighbours': the NEIGHBOURS before and after it of the same group.

    Neighbours show much the same, so the quotient tells blur from a subject with little texture. None where there are
    fewer than MIN_NEIGHBOURS or they have no texture at all.
    """
    relative: list[float | None] = [None] * len(values)
    for group in set(groups):
        members = [index for index, of in enumerate(groups) if of == group]
        for place, index in enumerate(members):
            around = members[max(0, place - NEIGHBOURS) : place] + members[place + 1 : place + 1 + NEIGHBOURS]
            usual = median(values[other] for other in around) if len(around) >= MIN_NEIGHBOURS else 0.0
            relative[index] = float(f"{values[index] / usual:.4g}") if usual > 0 else None
    return relative


def one_colour(pixels: np.ndarray) -> str | None:
    """The one colour of all pixels (h, w, 3 or 4) uint8, in words; None for a picture of anything."""
    if pixels.shape[2] == 4 and not pixels[..., 3].any():
        return "transparent"
    if (pixels != pixels[0, 0]).any():
        return None
    return "#" + "".join(f"{value:02x}" for value in pixels[0, 0].tolist())
