"""Which pictures no lens model here fits: panoramas, each column of which is one direction of the compass, and pairs of
fisheye circles."""

import re
from typing import Literal

import cv2
import numpy as np

# Photo Sphere XMP metadata, as an attribute or an element. Views that were cut out of a panorama may have kept it.
_TAG = re.compile(rb"GPano:ProjectionType\s*(=\s*[\"']|>)\s*(equirectangular|cylindrical)", re.IGNORECASE)
MIN_ASPECT = 1.9  # of a panorama by its tag: a whole one has 2, a view cut out of one less
# The ends of ordinary photos that were cut to 2 : 1 agree by at most 0.25, columns half a photo apart by at most 0.45,
# and neighbouring columns mostly by 0.5 to 0.97 (fox, fern, sceaux_castle, banana, fountain_p11, herzjesu_p8, which are
# some 1000 pixels wide: of larger pictures by more).
AGREEMENT, AHEAD = 0.5, 0.2
ROWS, SMOOTH_ROWS = 512, 10.0  # columns are compared in so many rows, without what changes more slowly than that
MIN_DETAIL = 2.0  # of 255: what is plain tells nothing
OTHERS = 31
SWEPT = 6  # of EXIF's CustomRendered: a panorama that an iPhone made of one sweep
# Two fisheye circles side by side touch each other and the borders, or nearly. Outside is black, but for stray light
# at their rims; inside are people and sky, dark in places. Radii are in halves of the height.
DARK, OUTSIDE, MIN_BLACK = 24, 1.2, 0.95
RING, MIN_LIT = (0.75, 0.9), 2 / 3  # at the top, left, right and bottom of each
SMALL = 128  # pixels: the height at which circles are looked for

Panorama = Literal["whole", "swept", "dual fisheye"]
"""All around, of one sweep, or both pictures of a camera with two fisheye lenses as they left these."""


def panorama_kind(pixels: np.ndarray, xmp: str | bytes | None = None, rendered: object = None) -> Panorama | None:
    """Which kind of panorama a picture, (h, w, 3 or 4) uint8, is, None for a photo: by its XMP metadata, by EXIF's
    CustomRendered (``rendered``), by its circles, or by its ends.

    A whole turn of the compass is exactly twice as wide as high, and its last column is followed by its first: they
    agree as neighbours do, and far better than columns that are half the width apart.
    """
    height, width = pixels.shape[:2]
    content = xmp.encode("utf-8", "replace") if isinstance(xmp, str) else xmp or b""
    if width >= MIN_ASPECT * height and _TAG.search(content):
        return "whole"
    if rendered == SWEPT and max(width, height) >= MIN_ASPECT * min(width, height):
        return "swept"
    if width != 2 * height:
        return None
    return "dual fisheye" if _has_two_circles(pixels) else "whole" if _goes_round(pixels) else None


def cutting_advice(source: str, view: str, kind: Panorama) -> str:
    """What to do about a panorama, not a swept one, that ffmpeg reads from ``source``; it would write one view to
    ``view``."""
    projection = "dfisheye:flat:ih_fov=190:iv_fov=190" if kind == "dual fisheye" else "e:flat"
    ffmpeg = f"ffmpeg -i {source} -vf v360={projection}:h_fov=90:v_fov=90:w=1500:h=1500:yaw=0 {view}"
    return f"cut it into perspective views, for example with {ffmpeg}, and the same for yaw 60, 120, 180, -60 and -120"


def _has_two_circles(pixels: np.ndarray) -> bool:
    small = cv2.resize(pixels, (2 * SMALL, SMALL), interpolation=cv2.INTER_AREA)
    lit = small[..., :3].max(axis=2) > DARK
    y, x = np.mgrid[-1 + 1 / SMALL : 1 : 2 / SMALL, -1 + 1 / SMALL : 1 : 2 / SMALL]
    radius = np.hypot(x, y)
    ring = (radius > RING[0]) & (radius < RING[1])
    sides = [ring & (along > abs(across)) for along, across in ((x, y), (-x, y), (y, x), (-y, x))]
    halves = lit[:, :SMALL], lit[:, SMALL:]
    outside = all((~half[radius > OUTSIDE]).mean() >= MIN_BLACK for half in halves)
    return outside and all(half[side].mean() >= MIN_LIT for half in halves for side in sides)


def _goes_round(pixels: np.ndarray) -> bool:
    width = pixels.shape[1]
    inside = np.arange(1, OTHERS + 1) * width // (OTHERS + 1)
    one = _detail(pixels[:, np.append(0, inside)])
    other = _detail(pixels[:, np.append(width - 1, (inside + width // 2) % width)])
    sizes = np.linalg.norm(one, axis=0), np.linalg.norm(other, axis=0)
    if min(sizes[0][0], sizes[1][0]) < MIN_DETAIL * ROWS**0.5:
        return False
    agreement = (one * other).sum(axis=0) / np.maximum(sizes[0] * sizes[1], 1.0)
    return bool(agreement[0] > max(AGREEMENT, AHEAD + agreement[1:].max()))


def _detail(columns: np.ndarray) -> np.ndarray:
    """(ROWS, n) float32: the fine changes along each of the columns (h, n, 3 or 4) uint8."""
    grey = columns[..., :3].mean(axis=2, dtype=np.float32)
    rows = cv2.resize(grey, (grey.shape[1], ROWS), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(rows, (1, 0), sigmaX=1.0, sigmaY=SMOOTH_ROWS)
    detail = rows - smooth
    return detail - detail.mean(axis=0)
