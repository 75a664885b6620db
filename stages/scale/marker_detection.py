"""Printed square markers in a photo, their corners located in fractions of a pixel.

cv2.aruco finds and reads them; its corners are off by up to a pixel, and a printed edge of a photo is not where sRGB
values are half-way: a blurred edge is symmetrical in linear light only. So each side is located anew, where profiles
across it pass half of the light on both sides, and corners are where the lines through these points meet. That is done
on ray directions, in which the sides are straight whatever the lens.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from nerf.geometry.scene import Camera
from nerf.rendering.srgb_arrays import linear_light
from stages.scale.marker_names import DICTIONARIES, printed_name
from stages.sfm.colmap.cameras import ray_directions

PROFILES = 24  # across each side
ALONG = (0.12, 0.88)  # of a side: nearer to its ends a profile sees the corner
MIN_REACH_PX, MAX_REACH_PX = 2.0, 6.0  # of a profile to both sides
REACH_CELLS = 0.75  # the black border and the white around it are one cell wide
MIN_CONTRAST = 0.05  # of linear light between both sides of an edge
MIN_CROSSINGS = 8  # of the profiles of a side
STEPS = 33  # samples along a profile


class Found(NamedTuple):
    """A marker in a photo: ``pixels`` (4, 2) of its corners, clockwise from its own upper left one."""

    number: int
    pixels: Float[np.ndarray, "4 2"]


def find_markers(photo: UInt8[np.ndarray, "h w c"], dictionary: str, mirrored: bool = False) -> list[Found]:
    """Every marker of a dictionary in a photo, to about a pixel; of ``mirrored``, the mirror images of markers."""
    grey = cv2.cvtColor(np.ascontiguousarray(photo[..., :3]), cv2.COLOR_RGB2GRAY)
    grey = cv2.flip(grey, 1) if mirrored else grey
    corners, numbers, _ = cv2.aruco.ArucoDetector(_predefined(dictionary)).detectMarkers(grey)
    if numbers is None:
        return []
    # OpenCV has the centre of the first pixel at 0.
    return [Found(int(n), c.reshape(4, 2) + 0.5) for n, c in zip(np.ravel(numbers), corners, strict=True)]


def printed_markers(photo: UInt8[np.ndarray, "h w c"]) -> set[str]:
    """Every marker of any dictionary in a photo, by the name it has in the smallest."""
    largest = [name for name in DICTIONARIES if name.endswith("_1000") or not name[0].isdigit()]
    detector = cv2.aruco.ArucoDetector([_predefined(name) for name in largest], cv2.aruco.DetectorParameters())
    grey = cv2.cvtColor(np.ascontiguousarray(photo[..., :3]), cv2.COLOR_RGB2GRAY)
    _, numbers, _, which = detector.detectMarkersMultiDict(grey)
    if numbers is None:
        return set()
    pairs = zip(np.ravel(which), np.ravel(numbers), strict=True)
    return {printed_name(largest[int(dictionary)], int(number)) for dictionary, number in pairs}


def luminance(photo: UInt8[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w"]:
    """The luminance of an sRGB photo, in linear light (ITU-R BT.709)."""
    return linear_light(photo[..., :3].astype(np.float32) / 255) @ np.array([0.2126, 0.7152, 0.0722], np.float32)


def locate_corners(
    light: Float[np.ndarray, "h w"], found: Found, cells: int, camera: Camera
) -> Float[np.ndarray, "4 2"] | None:
    """The corners of a marker of ``cells`` cells a side as x/z, y/z of their ray directions; None where a side cannot
    be told, as at the photo's edge."""
    lines = []
    for side in range(4):
        start, end, *opposite = np.roll(found.pixels, -side, axis=0)
        crossings = _edge_crossings(light, start, end, np.mean(opposite, axis=0), cells)
        if len(crossings) < MIN_CROSSINGS:
            return None
        rays = ray_directions(camera, crossings)
        if not (rays[:, 2] > 0).all():  # NaN as well
            return None
        lines.append(_line(rays[:, :2] / rays[:, 2:]))
    met = [np.cross(before, after) for before, after in zip([lines[-1], *lines[:-1]], lines, strict=True)]
    if any(point[2] == 0 for point in met):
        return None
    return np.array([point[:2] / point[2] for point in met])


def _edge_crossings(
    light: Float[np.ndarray, "h w"],
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    opposite: Float[np.ndarray, "2"],
    cells: int,
) -> Float[np.ndarray, "n 2"]:
    """Pixels on a side from ``start`` to ``end`` where light is half-way between its two sides; ``opposite`` is the
    middle of the opposite side."""
    outward = np.array([end[1] - start[1], start[0] - end[0]]) / np.linalg.norm(end - start)
    depth = float((start - opposite) @ outward)
    outward, depth = (outward, depth) if depth > 0 else (-outward, -depth)
    reach = float(np.clip(REACH_CELLS * depth / cells, MIN_REACH_PX, MAX_REACH_PX))
    offsets = np.linspace(-reach, reach, STEPS)
    on_side = start + np.linspace(*ALONG, PROFILES)[:, None] * (end - start)
    at = (on_side[:, None] + offsets[:, None] * outward).astype(np.float32)
    if at.min() < 0.5 or (at > np.array(light.shape[::-1]) - 0.5).any():
        return np.zeros((0, 2))
    columns, rows = np.moveaxis(at - np.float32(0.5), -1, 0)
    profiles = cv2.remap(light.astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    ends = STEPS // 6
    dark, bright = np.median(profiles[:, :ends], axis=1), np.median(profiles[:, -ends:], axis=1)
    above = profiles - (dark + bright)[:, None] / 2
    # The last step from below to above half: what lies within the marker may be white.
    rises = (above[:, :-1] < 0) & (above[:, 1:] >= 0)
    last = STEPS - 2 - np.argmax(rises[:, ::-1], axis=1)
    usable = rises.any(axis=1) & (bright - dark > MIN_CONTRAST)
    clear = np.flatnonzero(usable)
    low, high = above[clear, last[clear]], above[clear, last[clear] + 1]
    crossing = offsets[last[clear]] + (offsets[1] - offsets[0]) * low / (low - high)
    return on_side[clear] + crossing[:, None] * outward


def _line(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3"]:
    """The homogeneous line through points, by total least squares without the fifth that lies farthest off it."""
    *normal, offset = _fitted_line(points)
    off = np.abs(points @ normal + offset)
    return _fitted_line(points[off <= np.quantile(off, 0.8)])


def _fitted_line(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3"]:
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle)[2][1]
    return np.array([*normal, -normal @ middle])


def cells_of(dictionary: str) -> int:
    """Cells along a side of a dictionary's markers, black border included."""
    return _predefined(dictionary).markerSize + 2


def _predefined(dictionary: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
