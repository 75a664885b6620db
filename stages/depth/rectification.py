"""A pair of photos seen as by two parallel cameras whose rows coincide (rectification).

Both photos are resampled once, straight from their own pixels: the rectified directions go through the camera model, so
distortion and fisheyes cost nothing extra. The x axis of the rectified cameras is the baseline, whichever way it runs
through the photos; z is the mean of the two optical axes, made perpendicular to it. A point at depth z along that axis
lies at x in the left image and at x - focal * baseline / z in the right one.

Rectified pixels are counted on one plane for both images: integer coordinates are pixel centres, (0, 0) is where the z
axis goes. An image of a pair is a window of that plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from nerf.geometry.scene import Camera
from stages.sfm.colmap.cameras import mean_focal_and_centre, project, ray_directions

MAX_TILT_DEG = 50.0  # between a photo's optical axis and the rectified one; beyond, pixels are stretched threefold
MAX_HALF_ANGLE_DEG = 60.0  # of the rectified field of view: a wider fisheye keeps its middle
CHECKED_STEP = 8  # of rectified pixels every so many are projected there and back
OUTERMOST = 0.002  # of a photo's pixels that its window may cut off on each side
SAME_DIRECTION = 1e-3  # of a direction that comes back: a tenth of a degree tells it from another root of the model


class Viewpoint(NamedTuple):
    """From where a photo was taken: its camera (of the size that the photo has itself), its pose, and the unit
    ``ray_directions`` in the camera's frame of its pixels at the size of its depth map."""

    camera: Camera
    scene_from_camera: Float[np.ndarray, "3 4"]
    ray_directions: Float[np.ndarray, "height width 3"]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the depth map."""
        height, width, _ = self.ray_directions.shape
        return width, height

    @property
    def scale(self) -> Float[np.ndarray, "2"]:
        """Pixels of the depth map, across and down, in a pixel of the photo."""
        return np.array(self.size) / [self.camera.width, self.camera.height]

    @property
    def focal_px(self) -> float:
        """Mean focal length at the size of the depth map."""
        return mean_focal_and_centre(self.camera)[0] * self.size[0] / self.camera.width


class Pixels(NamedTuple):
    """Grey pixels of a photo at the size of its depth map, and which of them are to be used."""

    grey: UInt8[np.ndarray, "height width"]
    used: Bool[np.ndarray, "height width"]


class CannotRectify(Exception):
    """A pair of photos that no two parallel cameras can stand for; the message says why."""


@dataclass(frozen=True)
class Rectified:
    """The geometry of a rectified pair. ``scene_from_rectified`` holds its axes as columns. The left image is the
    window whose first pixel is (``left``, ``top``) of the plane, ``width`` × ``height``; of the right image the window
    begins ``min_disparity`` further left, so that disparities within the windows begin at 0."""

    scene_from_rectified: Float[np.ndarray, "3 3"]
    focal_px: float
    baseline: float
    left: int
    top: int
    width: int
    height: int
    min_disparity: int
    disparities: int

    @cached_property
    def plane(self) -> tuple[Float[np.ndarray, "width"], Float[np.ndarray, "height"]]:
        """x and y on the plane of the left window's pixels."""
        return np.arange(self.left, self.left + self.width), np.arange(self.top, self.top + self.height)

    def shifted_right(self) -> "Rectified":
        """The same geometry with the right image's window as the left one, wide enough for all disparities."""
        left = self.left - self.disparities - self.min_disparity
        return replace(self, left=left, width=self.width + self.disparities)

    def inverse_per_disparity(self, photo: Viewpoint) -> Float[np.ndarray, "height width"]:
        """By how much the inverse distance along a photo's rays grows with a pixel of disparity."""
        axis = photo.scene_from_camera[:, :3].T @ self.scene_from_rectified[:, 2]
        return photo.ray_directions @ (axis / (self.focal_px * self.baseline)).astype(np.float32)


def rectify(one: Viewpoint, other: Viewpoint, depths: tuple[float, float], max_disparities: int) -> Rectified:
    """The rectified pair of ``one`` photo, the left one, and an ``other``, for points at ``depths`` (nearest, farthest)
    in front of them. Raises CannotRectify."""
    axes, baseline = _axes(one.scene_from_camera, other.scene_from_camera)
    outlines = [_outline(photo, axes) for photo in (one, other)]
    tilts = [float(photo.scene_from_camera[:, 2] @ axes[:, 2]) for photo in (one, other)]
    # A plane that meets a ray at angle a is finer there by 1 / cos a along one axis, 1 / cos² a along the other.
    focal = float(np.mean([photo.focal_px * tilt for photo, tilt in zip((one, other), tilts, strict=True)]))
    low, high = focal * baseline / depths[1], focal * baseline / depths[0]
    (left, right), (top, bottom) = _windows(outlines, focal, low, high)
    min_disparity = int(np.floor(low))
    disparities = min(16 * int(np.ceil((high - min_disparity + 1) / 16)), max_disparities)
    if right - left < 16 or bottom - top < 16:
        raise CannotRectify("they show nothing in common")
    return Rectified(axes, focal, baseline, left, top, right - left, bottom - top, min_disparity, disparities)


def _axes(one: Float[np.ndarray, "3 4"], other: Float[np.ndarray, "3 4"]) -> tuple[np.ndarray, float]:
    """The rectified axes, as columns in the scene's frame, and the length of the baseline."""
    along = other[:, 3] - one[:, 3]
    baseline = float(np.linalg.norm(along))
    if not np.isfinite(baseline) or baseline <= np.finfo(np.float32).eps * max(map(_size, (one, other))):
        raise CannotRectify("they were taken from one place")
    x = along / baseline
    forward = one[:, 2] + other[:, 2]
    forward = forward - (forward @ x) * x
    length = float(np.linalg.norm(forward))
    if length < 1e-6:
        raise CannotRectify("they look along the line between them")
    z = forward / length
    if min(one[:, 2] @ z, other[:, 2] @ z) < np.cos(np.radians(MAX_TILT_DEG)):
        raise CannotRectify("they look along the line between them, or too different ways")
    return np.stack([x, np.cross(z, x), z], axis=1), baseline


def _size(pose: np.ndarray) -> float:
    return float(np.abs(pose[:, 3]).max())


def _outline(photo: Viewpoint, axes: np.ndarray) -> Float[np.ndarray, "4"]:
    """left, top, right and bottom of a photo on the rectified plane at focal length 1, as far as that reaches. Of
    every few pixels all but the outermost: where a lens was fitted wildly, in a corner, that would double the window.
    """
    rays = photo.ray_directions[::CHECKED_STEP, ::CHECKED_STEP].reshape(-1, 3).astype(float)
    rays = rays @ photo.scene_from_camera[:, :3].T @ axes
    widest = np.tan(np.radians(MAX_HALF_ANGLE_DEG))
    at = np.clip(rays[:, :2] / np.maximum(rays[:, 2:], 1e-9), -widest, widest)
    return np.quantile(at, [OUTERMOST, 1 - OUTERMOST], axis=0).ravel()


def _windows(
    outlines: Sequence[np.ndarray], focal: float, low: float, high: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """(left, right) and (top, bottom) of what both photos may show, in pixels of the left image."""
    (left, top, right, bottom), (left2, top2, right2, bottom2) = (focal * outline for outline in outlines)
    across = int(np.ceil(max(left, left2 + low))), int(np.floor(min(right, right2 + high)))
    return across, (int(np.ceil(max(top, top2))), int(np.floor(min(bottom, bottom2))))


def resampled(pair: Rectified, photo: Viewpoint, pixels: Pixels, window: tuple[int, int]) -> Pixels:
    """A photo on the plane from column ``window[0]``, ``window[1]`` columns wide, on the pair's rows;
    grey continues the photo's edge where it ends, and is not used there."""
    x, y = np.arange(window[0], window[0] + window[1]), pair.plane[1]
    directions = np.empty((len(y), len(x), 3))
    directions[..., 0], directions[..., 1], directions[..., 2] = x, y[:, None], pair.focal_px
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    local = directions @ (pair.scene_from_rectified.T @ photo.scene_from_camera[:, :3])
    width, height = photo.size
    at = project(photo.camera, local.reshape(-1, 3)).reshape((*local.shape[:2], 2))
    at = at * photo.scale - 0.5
    inside = ((at > -0.5) & (at < [width - 0.5, height - 0.5])).all(axis=2)  # NaN, behind the camera, is not inside
    inside &= _comes_back(photo, local, at)
    x_map, y_map = np.moveaxis(np.where(np.isfinite(at), at, -1).astype(np.float32), 2, 0)
    grey = cv2.remap(pixels.grey, x_map, y_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    used = cv2.remap(pixels.used.view(np.uint8), x_map, y_map, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return Pixels(grey, inside & (used > 0))


def _comes_back(photo: Viewpoint, local: np.ndarray, at: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Where the pixel at which a camera model puts a direction has that direction: beyond their photos, distortions
    fold back into them. Looked at every few pixels."""
    coarse, pixels = local[::CHECKED_STEP, ::CHECKED_STEP], at[::CHECKED_STEP, ::CHECKED_STEP]
    pixels = (pixels + 0.5) / photo.scale
    pixels = np.where(np.isfinite(pixels), pixels, 0.0)
    back = ray_directions(photo.camera, pixels.reshape(-1, 2)).reshape(coarse.shape)
    same = np.linalg.norm(back - coarse, axis=2) < SAME_DIRECTION
    rows, columns = (np.arange(count) // CHECKED_STEP for count in local.shape[:2])
    return same[rows[:, None], columns]


def coordinates(pair: Rectified, photo: Viewpoint) -> Float[np.ndarray, "2 height width"]:
    """Where the pixels of a photo lie on the plane, float32; NaN beside or behind it."""
    turn = (photo.scene_from_camera[:, :3].T @ pair.scene_from_rectified).astype(np.float32)
    local = photo.ray_directions @ turn
    ahead = np.where(local[..., 2:] > 1e-3, local[..., 2:], np.float32(np.nan))
    return np.moveaxis(np.float32(pair.focal_px) * local[..., :2] / ahead, 2, 0)
