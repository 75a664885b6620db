"""How far to the left each pixel of a rectified pair's left image appears in the right one, and how surely.

Semi-global matching (Hirschmüller 2008) as OpenCV has it finds the disparity of nearly every pixel to a pixel or so.
Its fractions of a pixel gather at whole and half ones, so steps of Lucas and Kanade (1981) over a small window follow,
at each pixel from the disparity found there: slanted surfaces cost nothing. The same sums say how uncertain the result
is: noise of variance s² in the images gives a disparity the variance s² / sum(g²), g the gradient along the row. So a
bare wall, where semi-global matching only continues what it saw at its border, comes out as what it is: not known.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stages.depth.consistency import Candidate
from stages.depth.rectification import Pixels, Rectified, Viewpoint, coordinates, resampled

BLOCK = 5  # pixels along each side of what is compared at a disparity
SMALL_STEP, LARGE_STEP = 8 * BLOCK**2, 40 * BLOCK**2  # costs of disparities that change by one, by more
BYTES_PER_COST = 4
MAX_VOLUME_BYTES = 1 << 29  # a pair of larger images is matched over the five directions that need a few rows at a time
PREFILTER_CAP = 63
UNIQUENESS_PERCENT = 5  # by which the best cost must beat all but its neighbours: repeated patterns do not
SPECKLE_PIXELS, SPECKLE_RANGE = 30, 1  # smaller patches that differ by more from what is around them are left out
REFINEMENT_WINDOW = 7
REFINEMENTS = 2
MAX_REFINEMENT_PX = 1.0  # beyond it the window shows something else
# Residuals hold the noise of two images, variance 2 s²; central differences, averaged over both, s² / 4.
NOISE_IN_GRADIENTS = 8.0
# From a pixel to the middle of the texture that it was matched by. Where what is known ends within ENDS_WINDOW, and
# this is further, that may be the outline of something in front of a bare wall, and the pixel the wall's.
MAX_BESIDE_PX, ENDS_WINDOW = 1.5, 5
MAX_SIGMA_PX = 0.5
MIN_SIGMA_PX = 0.05  # what resampling, poses and the camera model leave however strong the texture
UNKNOWN = (float("nan"),)
MAX_SLOPE = 1.0  # pixels of disparity from one pixel to the next: beyond it there is an edge


def cost_volume_bytes(pair: Rectified) -> int:
    """Memory that the costs of all disparities take at once, which matching over eight directions needs."""
    return BYTES_PER_COST * pair.width * pair.height * pair.disparities


class Disparities:
    """Disparities of the left image's pixels on the plane of a rectified pair, and their standard deviations, in
    pixels, float32; NaN where they are not known."""

    def __init__(self, pair: Rectified, value: Float[np.ndarray, "h w"], sigma: Float[np.ndarray, "h w"]) -> None:
        self.pair, self.value, self.sigma = pair, value, sigma

    def seen_from_right(self) -> "Disparities":
        """The same by pixels of the right image, whose window begins ``disparities`` further left: of two that fall on
        a pixel the nearer one, which hides the other. Between neighbours on a surface it is interpolated."""
        pair = self.pair
        width = pair.width + pair.disparities
        value = np.full((pair.height, width), -np.inf, np.float32)
        first, second = self.value[:, :-1], self.value[:, 1:]
        column = np.arange(pair.width - 1, dtype=np.float32) + pair.disparities + pair.min_disparity
        start, end = column - first, column + 1 - second
        for step in (0, 1):  # on a surface that widens to the right two pixels may lie in between
            target = np.ceil(start) + step
            with np.errstate(invalid="ignore"):
                falls = (target < end) & (target >= 0) & (target < width)
            row, at = np.nonzero(falls)
            share = (target[row, at] - start[row, at]) / np.maximum(end[row, at] - start[row, at], 1e-3)
            between = first[row, at] + share * (second[row, at] - first[row, at])
            np.maximum.at(value, (row, target[row, at].astype(int)), between)
        value[~np.isfinite(value)] = np.nan
        sigma = np.full_like(value, np.nan)
        row, at = np.nonzero(np.isfinite(value))
        origin = np.rint(at + value[row, at] - pair.disparities - pair.min_disparity).astype(int)
        sigma[row, at] = self.sigma[row, np.clip(origin, 0, pair.width - 1)]
        value[~np.isfinite(sigma)] = np.nan
        return Disparities(pair.shifted_right(), value, sigma)

    def of_photo(self, photo: Viewpoint, used: Bool[np.ndarray, "h w"]) -> Candidate:
        """What the pair says of the pixels of its left photo."""
        x, y = coordinates(self.pair, photo)
        x, y = (np.where(np.isfinite(axis), axis, np.float32(-9)) for axis in (x - self.pair.left, y - self.pair.top))
        value = cv2.remap(self.value, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN)
        sigma = cv2.remap(self.sigma, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN)
        per_pixel = self.pair.inverse_per_disparity(photo)
        known = used & (value > 0) & np.isfinite(sigma)
        inverse, sigma = (np.where(known, one * per_pixel, np.float32(np.nan)) for one in (value, sigma))
        return Candidate(inverse, sigma, per_pixel)


def match(pair: Rectified, photos: tuple[Viewpoint, Viewpoint], pixels: tuple[Pixels, Pixels]) -> Disparities:
    """The disparities of the first photo, the left one, in the second."""
    room = pair.disparities  # to the left of the left image, so that all of its pixels have all disparities
    width = pair.width + room
    left = resampled(pair, photos[0], pixels[0], (pair.left - room, width))
    right = resampled(pair, photos[1], pixels[1], (pair.left - room - pair.min_disparity, width))
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=room,
        blockSize=BLOCK,
        P1=SMALL_STEP,
        P2=LARGE_STEP,
        disp12MaxDiff=1,
        preFilterCap=PREFILTER_CAP,
        uniquenessRatio=UNIQUENESS_PERCENT,
        speckleWindowSize=SPECKLE_PIXELS,
        speckleRange=SPECKLE_RANGE,
        mode=cv2.STEREO_SGBM_MODE_HH if cost_volume_bytes(pair) <= MAX_VOLUME_BYTES else cv2.STEREO_SGBM_MODE_SGBM,
    )
    found = matcher.compute(left.grey, right.grey).astype(np.float32) / 16
    found[(found < 0) | ~left.used] = np.nan
    value, sigma = _refined(found, left.grey, right)
    return Disparities(pair, value[:, room:] + np.float32(pair.min_disparity), sigma[:, room:])


def candidates(
    pair: Rectified, photos: tuple[Viewpoint, Viewpoint], pixels: tuple[Pixels, Pixels]
) -> tuple[Candidate, Candidate]:
    """What a pair says of each of its photos."""
    found = match(pair, photos, pixels)
    return found.of_photo(photos[0], pixels[0].used), found.seen_from_right().of_photo(photos[1], pixels[1].used)


class _Windows(NamedTuple):
    """Sums over the window around each pixel, once the right image is moved by the disparities: of squared gradients,
    of gradient times difference, of squared differences, of pixels; and where the squared gradients' middle is."""

    squares: Float[np.ndarray, "h w"]
    products: Float[np.ndarray, "h w"]
    differences: Float[np.ndarray, "h w"]
    pixels: Float[np.ndarray, "h w"]
    beside: Float[np.ndarray, "h w"]

    @classmethod
    def of(cls, disparity: np.ndarray, left: np.ndarray, right: np.ndarray) -> "_Windows":
        """``left`` and ``right`` are float32."""
        height, width = left.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        at = np.where(np.isfinite(disparity), x - disparity, -9).astype(np.float32)
        seen = (at > 0) & (at < width - 1)
        moved = cv2.remap(right, at, y, cv2.INTER_LINEAR)
        slopes = _slope(left) + cv2.remap(_slope(right), at, y, cv2.INTER_LINEAR)
        gradient, difference = np.where(seen, slopes / 2, 0), np.where(seen, left - moved, 0)
        squares = _summed(gradient * gradient)
        with np.errstate(invalid="ignore", divide="ignore"):
            beside = np.hypot(*(_summed(gradient * gradient * axis) / squares - axis for axis in (x, y)))
        products, differences = _summed(gradient * difference), _summed(difference * difference)
        return cls(squares, products, differences, _summed(seen.astype(np.float32)), beside)

    def step(self) -> Float[np.ndarray, "h w"]:
        """By how much disparities are too large, MAX_REFINEMENT_PX at most."""
        step = np.divide(self.products, self.squares, out=np.zeros_like(self.squares), where=self.squares > 0)
        return np.clip(step, -MAX_REFINEMENT_PX, MAX_REFINEMENT_PX)

    def sigma(self) -> Float[np.ndarray, "h w"]:
        """The standard deviation of a disparity; infinite or NaN without texture."""
        with np.errstate(invalid="ignore", divide="ignore"):
            left_over = np.maximum(self.differences - np.square(self.products) / self.squares, 0)
            noise = left_over / np.maximum(self.pixels - 2, 1)
            texture = np.maximum(self.squares - self.pixels * noise / NOISE_IN_GRADIENTS, 0)
            return np.hypot(np.sqrt(noise / texture), MIN_SIGMA_PX)


def _refined(
    found: Float[np.ndarray, "h w"], left: UInt8[np.ndarray, "h w"], right: Pixels
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Disparities after steps of Lucas and Kanade, and their standard deviations; NaN where they are not sure."""
    one, other = left.astype(np.float32), right.grey.astype(np.float32)
    windows = _Windows.of(found, one, other)
    disparity = found - windows.step()
    for _ in range(REFINEMENTS - 1):
        windows = _Windows.of(disparity, one, other)
        disparity = disparity - windows.step()
    sigma = windows.sigma()
    at = np.rint(np.arange(left.shape[1]) - disparity)
    with np.errstate(invalid="ignore"):
        sure = (sigma < MAX_SIGMA_PX) & (np.abs(disparity - found) < MAX_REFINEMENT_PX)
        sure &= (at >= 0) & (at < left.shape[1])
    sure &= right.used[np.arange(len(left))[:, None], np.where(sure, at, 0).astype(int)]
    sure &= ~_at_edges(np.where(sure, disparity, np.float32(np.nan)))
    ends = cv2.dilate((~sure).view(np.uint8), np.ones((ENDS_WINDOW, ENDS_WINDOW))) > 0
    sure &= ~ends | (windows.beside < MAX_BESIDE_PX)
    unknown = np.float32(np.nan)
    return np.where(sure, disparity, unknown), np.where(sure, sigma, unknown).astype(np.float32)


def _slope(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Central differences along the rows."""
    return cv2.filter2D(image, -1, np.array([[-0.5, 0, 0.5]], np.float32))


def _summed(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Sums over the window around each pixel."""
    return cv2.boxFilter(values, -1, (REFINEMENT_WINDOW, REFINEMENT_WINDOW), normalize=False)


def _at_edges(disparity: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels beside one whose disparity differs by more than surfaces do."""
    edge = np.zeros(disparity.shape, bool)
    with np.errstate(invalid="ignore"):
        across = np.abs(np.diff(disparity, axis=1)) > MAX_SLOPE
        down = np.abs(np.diff(disparity, axis=0)) > MAX_SLOPE
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
