"""Between which distances along its rays each photo can show anything (scene frame, region = [-0.9, 0.9]^3)."""

import numpy as np
from jaxtyping import Float

from nerf import REGION_HALF_SIZE
from nerf.geometry.reconstruction import Reconstruction, observations_by_view, thinned

MIN_POINTS_IN_VIEW = 10  # fewer say nothing about a photo's depth range; all photos together then do
QUANTILES = (0.002, 0.5, 0.999)  # near, median and far distance of what a photo sees
NEAR_MARGIN = 0.7  # bare surfaces carry no points: the nearest thing may be nearer than the nearest point
SURE_VIEWS = 3  # photos that see a point which is no false match
MAX_POINTS = 100_000  # looked for in every photo, or the time grows with the square of the photos
MIN_NEAR = 0.05 * REGION_HALF_SIZE  # for cameras in the region whose depths nobody knows
BEYOND = 2.0  # a camera far from the region sees at least as far behind it as it is in front of it
MAX_FAR, MIN_FAR = 1000.0, 20.0  # contraction maps these to 0.001 and 0.05 from the end of the world


def near_and_far(scene: Reconstruction, bounded: bool) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distances along the unit ray, 0 < near < far, per photo.

    Bounded: from where rays enter the region (or from the nearest points, from within it) to its farthest corner.
    Unbounded: from 0.7 times the nearest points in its field of view to four times the farthest, at least 20 and at
    most 1000 units, which costs little because samples are spaced ever wider with distance; from far away at least to
    twice the region's farthest corner.
    """
    entry, exit_ = _distances_to_region(scene.centres)
    near, far = _points_range(scene)
    # cameras that are inside the region and see no points still need a positive near
    near = np.where(np.isfinite(near), near, np.maximum(entry, MIN_NEAR))
    if bounded:
        return np.where(entry > MIN_NEAR, entry, np.minimum(near, 0.5 * exit_)), exit_
    far = np.maximum(np.clip(4 * far, MIN_FAR, MAX_FAR), BEYOND * exit_)
    return np.minimum(near, 0.5 * far), far


def _distances_to_region(centres: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distances of the nearest point of the region (0 inside it) and of its farthest corner."""
    nearest = np.linalg.norm(np.maximum(np.abs(centres) - REGION_HALF_SIZE, 0.0), axis=1)
    return nearest, np.linalg.norm(np.abs(centres) + REGION_HALF_SIZE, axis=1)


def _points_range(scene: Reconstruction) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """(near with margin, farthest point) per photo; (nan, 0) where no points are known at all.

    Quantiles of 0.2 % and 99.9 % of what a photo sees; alone, a near below a twentieth of the median distance is a
    false match, not a surface. What other photos place in its field of view counts, too: matching may fail on the
    nearest or the farthest thing in a photo, and beyond its near and far it would be cut out of the picture.
    """
    count = len(scene.from_camera)
    if not len(scene.point):
        return np.full(count, np.nan), np.zeros(count)
    distances = scene.distances()
    sure = thinned(scene.points[np.bincount(scene.point, minlength=len(scene.points)) >= SURE_VIEWS], MAX_POINTS)
    of_all = np.quantile(distances, QUANTILES)
    near, far = np.empty(count), np.empty(count)
    for view, own in enumerate(observations_by_view(scene.view, count)):
        seen = distances[own]
        low, middle, high = np.quantile(seen, QUANTILES) if len(seen) >= MIN_POINTS_IN_VIEW else of_all
        low = max(low, 0.05 / NEAR_MARGIN * middle)
        low, high = _widened(scene, view, sure, low, high)
        near[view], far[view] = NEAR_MARGIN * low, high
    return near, far


def _widened(
    scene: Reconstruction, view: int, points: Float[np.ndarray, "n 3"], low: float, high: float
) -> tuple[float, float]:
    """The range of distances, widened on either side as far as MIN_POINTS_IN_VIEW points in its field of view go."""
    distance = np.linalg.norm(points - scene.centres[view], axis=1)
    beyond = (distance < low) | (distance > high)
    _, shown = scene.project(view, points[beyond])
    distance = np.sort(distance[beyond][shown])
    nearer, farther = distance[distance < low], distance[distance > high]
    if len(nearer) >= MIN_POINTS_IN_VIEW:  # below MIN_NEAR in a large scene alone, by what the photo sees itself
        low = min(low, max(float(nearer[MIN_POINTS_IN_VIEW - 1]), MIN_NEAR))
    if len(farther) >= MIN_POINTS_IN_VIEW:
        high = float(farther[-MIN_POINTS_IN_VIEW])
    return low, high


def near_and_far_between_views(
    poses: Float[np.ndarray, "frames 3 4"],
    view_centres: Float[np.ndarray, "n 3"],
    view_near: Float[np.ndarray, "n"],
    view_far: Float[np.ndarray, "n"],
    bounded: bool,
) -> tuple[Float[np.ndarray, "frames"], Float[np.ndarray, "frames"]]:
    """(near, far) for cameras that took no photo, by their ``poses`` world_from_camera: the widest range of their three
    nearest neighbours among the views.

    Without bounds, what a view has before it is nearer to a camera that stands further ahead, and its far is farther
    from one elsewhere. In a bounded scene near counts from where rays enter the region, and far is the region's
    farthest corner. No near is below MIN_NEAR, or below the nearest of its neighbours' where the scene is so large
    that theirs are.
    """
    centres = poses[:, :, 3]
    offset = centres[:, None] - view_centres
    distance = np.linalg.norm(offset, axis=2)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :3]
    least = np.minimum(view_near[nearest].min(axis=1), MIN_NEAR)
    if not bounded:
        ahead = np.einsum("fva,fa->fv", offset, poses[:, :, 2]).clip(min=0)
        near, far = view_near - ahead, view_far + distance
        of_nearest = np.arange(len(centres))[:, None], nearest
        return np.maximum(near[of_nearest].min(axis=1), least), far[of_nearest].max(axis=1)
    entry, far = _distances_to_region(centres)
    beyond_entry = (view_near - _distances_to_region(view_centres)[0])[nearest].min(axis=1)
    return np.maximum(entry + beyond_entry, least), far
