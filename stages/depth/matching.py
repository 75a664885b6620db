"""How far to the left each pixel of a rectified pair's left image appears in the right one, and how surely.

Semi-global matching (Hirschmüller 2008) as OpenCV has it finds the disparity of nearly every pixel to a pixel or so.
Its fractions of a pixel gather at whole and half ones, so steps of Lucas and Kanade (1981) over a small window follow,
at each pixel from the disparity found there: slanted surfaces cost nothing. The same sums say how uncertain the result
is: noise of variance s² in the images gives a disparity the variance s² / sum(g²), g the gradient along the row. So a
bare wall, where semi-global matching only continues what it saw at its border, comes out as what it is: not known.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stages.depth.consistency import Candidate
from stages.depth.rectification import Pixels, Rectified, Viewpoint, coordinates, resampled

BLOCK = 5  # pixels along each side of what is compared at a disparity
SMALL_STEP, LARGE_STEP = 8 * BLOCK**2, 40 * BLOCK**2  # costs of disparities that change by one, by more
PREFILTER_CAP = 63
UNIQUENESS_PERCENT = 5  # by which the best cost must beat all but its neighbours: repeated patterns do not
SPECKLE_PIXELS, SPECKLE_RANGE = 30, 1  # smaller patches that differ by more from what is around them are left out
CONTRAST_WINDOW, CONTRAST_NOISE = 7, 4.0  # pixels; grey values: less contrast is not stretched
CONTRAST_SCALE = 42.0  # 3 deviations fill 8 bits
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
MAX_SLOPE = 1.0  # pixels of disparity from one pixel to the next: beyond it there is an edge


def even_contrast(pixels: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Grey values over their mean and deviation nearby: exposure and vignetting, which differ between photos, go."""
    window = (CONTRAST_WINDOW, CONTRAST_WINDOW)
    grey = pixels.astype(np.float32)
    mean = cv2.blur(grey, window, borderType=cv2.BORDER_REFLECT)
    variance = np.maximum(cv2.blur(grey * grey, window, borderType=cv2.BORDER_REFLECT) - mean * mean, 0)
    even = (grey - mean) / np.sqrt(variance + CONTRAST_NOISE**2)
    return np.clip(np.rint(128 + CONTRAST_SCALE * even), 0, 255).astype(np.uint8)


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
        shifted = pair.shifted_right()
        return Disparities(shifted, value, sigma)

    def of_photo(self, photo: Viewpoint, used: Bool[np.ndarray, "h w"]) -> Candidate:
        """What the pair says of the pixels of its left photo."""
        at = coordinates(self.pair, photo) - np.float32([self.pair.left, self.pair.top])
        at = np.where(np.isfinite(at), at, np.float32(-9))
        outside = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
        value = cv2.remap(self.value, at, None, cv2.INTER_LINEAR, **outside)
        sigma = cv2.remap(self.sigma, at, None, cv2.INTER_NEAREST, **outside)
        per_pixel = self.pair.inverse_per_disparity(photo)
        known = used & (value > 0) & np.isfinite(sigma)
        return Candidate(*(np.where(known, one * per_pixel, np.float32(np.nan)) for one in (value, sigma)), per_pixel)


def match(pair: Rectified, photos: tuple[Viewpoint, Viewpoint], pixels: tuple[Pixels, Pixels]) -> Disparities:
    """The disparities of the first photo, the left one, in the second."""
    room = pair.disparities  # to the left of the left image, so that all of its pixels have all disparities
    width = pair.width + room
    left, left_used = resampled(pair, photos[0], pixels[0], (pair.left - room, width))
    right, right_used = resampled(pair, photos[1], pixels[1], (pair.left - room - pair.min_disparity, width))
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
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    found = matcher.compute(left, right).astype(np.float32) / 16
    found[(found < 0) | ~left_used] = np.nan
    value, sigma = _refined(found, left, right, right_used)
    return Disparities(pair, value[:, room:] + np.float32(pair.min_disparity), sigma[:, room:])


def _refined(
    disparity: Float[np.ndarray, "h w"],
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    right_used: Bool[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Disparities after steps of Lucas and Kanade, and their standard deviations; NaN where they are not sure."""
    height, width = left.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    one, other = left.astype(np.float32), right.astype(np.float32)
    slope = np.float32([[-0.5, 0, 0.5]])
    one_slope, other_slope = cv2.filter2D(one, -1, slope), cv2.filter2D(other, -1, slope)
    start = disparity
    squares = sums = residuals = count = np.zeros_like(one)
    for _ in range(REFINEMENTS):
        known = np.isfinite(disparity)
        at = np.where(known, x - disparity, -9)
        seen = known & (at > 0) & (at < width - 1)
        gradient = np.where(seen, (one_slope + cv2.remap(other_slope, at, y, cv2.INTER_LINEAR)) / 2, 0)
        residual = np.where(seen, one - cv2.remap(other, at, y, cv2.INTER_LINEAR), 0)
        window = {"ddepth": -1, "ksize": (REFINEMENT_WINDOW, REFINEMENT_WINDOW), "normalize": False}
        squares = cv2.boxFilter(gradient * gradient, **window)
        sums = cv2.boxFilter(gradient * residual, **window)
        residuals = cv2.boxFilter(residual * residual, **window)
        count = cv2.boxFilter(seen.astype(np.float32), **window)
        step = np.divide(sums, squares, out=np.zeros_like(sums), where=squares > 0)
        disparity = disparity - np.clip(step, -MAX_REFINEMENT_PX, MAX_REFINEMENT_PX)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = np.maximum(residuals - sums * sums / squares, 0) / np.maximum(count - 2, 1)
        texture = np.maximum(squares - count * noise / NOISE_IN_GRADIENTS, 0)
        sigma = np.hypot(np.sqrt(noise / texture), MIN_SIGMA_PX)
        beside = np.hypot(*(cv2.boxFilter(gradient * gradient * axis, **window) / squares - axis for axis in (x, y)))
        at = np.rint(x - disparity)
        sure = (sigma < MAX_SIGMA_PX) & (np.abs(disparity - start) < MAX_REFINEMENT_PX) & (at >= 0) & (at < width)
    at = np.where(sure, at, 0).astype(int)
    sure &= right_used[np.arange(height)[:, None], at]
    sure &= ~_at_edges(np.where(sure, disparity, np.float32(np.nan)))
    ends = cv2.dilate((~sure).view(np.uint8), np.ones((ENDS_WINDOW, ENDS_WINDOW))) > 0
    sure &= ~ends | (beside < MAX_BESIDE_PX)
    return np.where(sure, disparity, np.float32(np.nan)), np.where(sure, sigma, np.float32(np.nan))


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
