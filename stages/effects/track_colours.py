"""What the training photos show at the sparse points: their colours.

Every photo is decoded once, in full size. A point's colour is the mean over a square window that shows the same piece
of its surface in every photo, so near photos are given larger windows than far ones.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from nerf import MIN_SATURATED
from nerf.effects.statistics.outlier_images import NEAR_APART, expected_places
from nerf.effects.statistics.tracks import TrackColours
from nerf.geometry.scene import Scene, View
from stages.contract import Progress
from stages.hardware.device import processors
from stages.io.pixels import load_mask, load_view
from stages.sfm.colmap.cameras import mean_focal_and_centre, project

MAX_OBSERVATIONS = 200_000  # observations: gains of 500 photos are then known to a few thousandths
MAX_EXPECTED = 1000  # places per photo where a point should be seen and was not matched
MAX_LOOKED_AT = 12_000_000  # observations of photos nearby that tell these places, for all photos: two seconds
WINDOW = 1 / 200  # of the photo's longer side: what training at usual sizes makes one pixel or two of
MIN_WINDOW, MAX_WINDOW = 5, 3.0  # pixels; times the usual window
# So many of a window's pixels whose brightest channel is beyond these are too many to trust its mean. A channel that is
# dark beside another one is what lamps and the night look like; it hardly weighs (nerf/effects/statistics/tracks.py:
# log_noise).
CLIPPED_SHARE = 0.1
DARKEST, BRIGHTEST = 3, MIN_SATURATED  # of 255
DECODING_BYTES = 2 << 30  # of photos in memory at a time


class SampledColours(NamedTuple):
    """``tracks``: observed points; ``expected``: places where points should be seen and have no observation."""

    tracks: TrackColours
    expected: TrackColours


class _Places(NamedTuple):
    """Where to look in one photo: pixel coordinates (n, 2), widths of the windows (n,), odd."""

    xy: np.ndarray
    window: np.ndarray


def sample_photos(ingest: Path, scene: Scene, points: Mapping[str, np.ndarray], progress: Progress) -> SampledColours:
    """All that is read off the pixels of the training photos, each decoded once; test photos are not looked at.

    Tracks are at most MAX_OBSERVATIONS, whole ones evenly drawn; ``points`` is points.safetensors of normalise. Windows
    that a mask, transparency or the photo's edge cuts are left out."""
    views = scene.of_split("train")
    tracks, xy = training_tracks(scene, points, MAX_OBSERVATIONS)
    expected, expected_xy = _expected(scene, points, tracks)
    both, at = _joined(tracks, expected), np.concatenate([xy, expected_xy])
    window = _windows(scene, both)
    of_view = [np.flatnonzero(both.view == number) for number in range(len(views))]

    def look(number: int) -> np.ndarray:
        chosen = of_view[number]
        return _look(ingest, scene, views[number], _Places(at[chosen], window[chosen]))

    seen = np.full((len(both), 5), np.nan)
    pool = ThreadPoolExecutor(_workers(scene))
    try:
        for number, future in enumerate([pool.submit(look, number) for number in range(len(views))]):
            seen[of_view[number]] = future.result()
            progress.update(f"read colours of {number + 1} of {len(views)} photos", (number + 1) / len(views))
    finally:
        pool.shutdown(cancel_futures=True)
    both = replace(both, colour=seen[:, :3], saturated=seen[:, 3] > 0, texture=seen[:, 4])
    there, observed = np.isfinite(seen[:, 0]), np.arange(len(both)) < len(tracks)
    return SampledColours(both.only(there & observed), both.only(there & ~observed))


def training_tracks(scene: Scene, points: Mapping[str, np.ndarray], most: int) -> tuple[TrackColours, np.ndarray]:
    """The geometry of the observations of training photos, their colours still black, and their pixels (k, 2); of
    points that two of them see at least. Whole points are left out, evenly, until ``most`` observations are left."""
    number = np.full(len(scene.views), -1)
    trained = scene.indices_of("train")
    number[trained] = np.arange(len(trained))
    view = number[points["view"]]
    count = np.bincount(points["point"][view >= 0], minlength=len(points["xyz"]))
    several = np.flatnonzero(count > 1)
    share = min(1.0, most / max(int(count[several].sum()), 1))
    step = np.floor(np.arange(1, len(several) + 1) * share)
    drawn = np.zeros(len(count), bool)
    drawn[several[np.diff(step, prepend=0) > 0]] = True
    kept = np.flatnonzero((view >= 0) & drawn[points["point"]])
    xy = points["xy"][kept].astype(float)
    return _seen_from(scene, points["xyz"].astype(float), view[kept], points["point"][kept].astype(int), xy), xy


def _seen_from(scene: Scene, xyz: np.ndarray, view: np.ndarray, point: np.ndarray, xy: np.ndarray) -> TrackColours:
    """The geometry of observations; colours are black and nothing is saturated."""
    views = scene.of_split("train")
    if not len(view):
        return replace(TrackColours.empty(len(views)), texture=np.zeros(0))
    intrinsics = [mean_focal_and_centre(camera) for camera in scene.cameras]
    focal = np.array([intrinsics[one.camera][0] for one in views])[view]
    middle = np.array([intrinsics[one.camera][1] for one in views])[view]
    diagonal = np.array([np.hypot(*_size(scene, one)) for one in views])[view]
    towards = np.stack([one.scene_from_camera[:, 3] for one in views])[view] - xyz[point]
    distance = np.maximum(np.linalg.norm(towards, axis=1), np.finfo(float).tiny)
    return TrackColours(
        views=len(views),
        view=view,
        point=point,
        colour=np.zeros((len(view), 3)),
        saturated=np.zeros(len(view), bool),
        radius=2 * np.linalg.norm(xy - middle, axis=1) / diagonal,
        towards=towards / distance[:, None],
        distance=distance,
        footprint=distance / focal,
        texture=np.zeros(len(view)),
    )


def _size(scene: Scene, view: View) -> tuple[int, int]:
    camera = scene.cameras[view.camera]
    return camera.width, camera.height


def _expected(scene: Scene, points: Mapping[str, np.ndarray], tracks: TrackColours) -> tuple[TrackColours, np.ndarray]:
    """Where training photos should show points that they have no observation of."""
    xyz, views = points["xyz"].astype(float), scene.of_split("train")
    centres = np.array([view.scene_from_camera[:, 3] for view in views]).reshape(-1, 3)
    rank = np.unique(tracks.point, return_inverse=True)[1]  # ids may have been drawn in steps themselves
    seen, places = [], []
    for number, view in enumerate(views):
        near, pose = _seen_nearby(tracks, rank, centres, number), view.scene_from_camera
        arguments = tracks.towards[near], tracks.distance[near], tracks.point[near], pose[:, 3], xyz
        point = np.setdiff1d(expected_places(*arguments), tracks.point[tracks.view == number])
        point = point[:: 1 + len(point) // MAX_EXPECTED]
        camera = scene.cameras[view.camera]
        xy = project(camera, (xyz[point] - pose[:, 3]) @ pose[:, :3]).reshape(-1, 2) if len(point) else np.zeros((0, 2))
        inside = ((xy > 0) & (xy < _size(scene, view))).all(axis=1)  # NaN, behind the camera, is not inside
        seen.append(np.stack([np.full(inside.sum(), number), point[inside]], axis=1))
        places.append(xy[inside])
    pairs, xy = np.concatenate([np.zeros((0, 2), int), *seen]), np.concatenate([np.zeros((0, 2)), *places])
    return _seen_from(scene, xyz, pairs[:, 0], pairs[:, 1], xy), xy


def _seen_nearby(tracks: TrackColours, rank: np.ndarray, centres: np.ndarray, number: int) -> np.ndarray:
    """Which observations tell what training photo ``number`` should show: those of the photos near it, beside the
    distance of what they observe. Where all photos' together would be more than MAX_LOOKED_AT, only those of every so
    many-th point, other points for each photo. ``rank`` numbers the observed points without gaps."""
    apart = np.linalg.norm(centres - centres[number], axis=1)
    apart[number] = np.inf
    near = np.flatnonzero(tracks.distance > apart[tracks.view] / NEAR_APART)
    step = -(-len(near) * len(centres) // MAX_LOOKED_AT)
    return near[rank[near] % step == number % step] if step > 1 else near


def _joined(one: TrackColours, other: TrackColours) -> TrackColours:
    names = [field.name for field in fields(one) if field.name != "views"]
    return replace(one, **{name: np.concatenate([getattr(one, name), getattr(other, name)]) for name in names})


def _windows(scene: Scene, tracks: TrackColours) -> np.ndarray:
    """The width of each observation's window, odd: WINDOW of the photo where the point's pixels are largest, and more
    where they are smaller, so that all show the same piece."""
    if not len(tracks):
        return np.zeros(0, int)
    size = np.array([max(_size(scene, view)) for view in scene.of_split("train")])
    usual = np.maximum(size * WINDOW, MIN_WINDOW)[tracks.view]
    extent = np.zeros(int(tracks.point.max()) + 1)
    np.maximum.at(extent, tracks.point, usual * tracks.footprint)
    width = np.clip(extent[tracks.point] / tracks.footprint, usual, MAX_WINDOW * usual)
    return 2 * np.floor(width / 2).astype(int) + 1


def _look(ingest: Path, scene: Scene, view: View, places: _Places) -> np.ndarray:
    """Per place red, green, blue, whether it is clipped, and the texture, NaN where it cannot be used."""
    width, height = _size(scene, view)
    pixels = load_view(ingest, view, width, height)
    used = pixels[..., 3] == 255 if scene.has_alpha and pixels.shape[2] == 4 else np.ones(pixels.shape[:2], bool)
    if view.mask:
        used = used & load_mask(ingest / view.mask, width, height)
    seen = np.full((len(places.xy), 5), np.nan)
    corner = np.floor(places.xy).astype(int) - places.window[:, None] // 2
    whole = ((corner >= 0) & (corner + places.window[:, None] <= [width, height])).all(axis=1)
    if whole.any():
        seen[whole] = _window_means(pixels, used, corner[whole], places.window[whole])
    return seen


def _window_means(pixels: np.ndarray, used: np.ndarray, corner: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(n, 5) as :func:`_look` gives them, of square windows that lie in the photo whole.

    Sums over windows are differences of the sums from the photo's corner (Crow 1984), one plane after another, so
    neither time nor memory grows with the windows. All are of whole numbers below 2^53, and exact.
    """
    left, top = corner.T
    right, bottom = left + side, top + side
    area = side.astype(float) ** 2

    def summed(plane: np.ndarray) -> np.ndarray:
        upto = cv2.integral(plane, sdepth=cv2.CV_64F)
        return upto[bottom, right] - upto[bottom, left] - upto[top, right] + upto[top, left]

    result = np.empty((len(corner), 5))
    grey = np.zeros(pixels.shape[:2], np.float32)  # three times, a whole number
    lightest = np.zeros(pixels.shape[:2], np.uint8)
    for channel in range(3):
        plane = cv2.extractChannel(pixels, channel)
        result[:, channel] = summed(plane) / (255 * area)
        grey += plane
        lightest = np.maximum(lightest, plane)
    grey_sum = summed(grey)
    grey_squares = summed(np.multiply(grey, grey, out=grey))
    beyond = ((lightest <= DARKEST) | (lightest >= BRIGHTEST)).view(np.uint8)
    result[:, 3] = summed(beyond) > CLIPPED_SHARE * area
    result[:, 4] = np.sqrt(area * grey_squares - grey_sum**2) / (area * 3 * 255)
    result[summed(used.view(np.uint8)) < area] = np.nan
    return result


def _workers(scene: Scene) -> int:
    """How many photos to decode at a time: one per core, fewer where they are too large for that."""
    largest = max(camera.width * camera.height for camera in scene.cameras)
    return max(1, min(processors(), DECODING_BYTES // (40 * largest)))
