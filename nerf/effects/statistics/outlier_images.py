"""Outlier images, in which something stood that the others lack: they show points in another colour than these do.

Features are matched by how they look, so what stands before a point rarely has its observation: an observed outlier is
a highlight or a false match. A passer-by shows where points are *expected*: photos taken from nearly the same direction
see them, this one should, and has another colour there. Both are looked at, with the same rule.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf.effects.statistics.exposure import ExposureFit
from nerf.effects.statistics.statistic import MIN_SIGNAL_TO_NOISE, OF_GAUSSIAN
from nerf.effects.statistics.tracks import TrackColours
from nerf.rendering.srgb_arrays import linear_light, srgb_values

OUTLIER = 0.1  # sRGB value, rms of the channels: ten times what a good photo is off by
MIN_POINTS = 20  # in a photo, for a share of them to mean something
MIN_EXCESS = 0.05  # of a photo's points: less is an edge that is missed by a pixel
NEAR_DEG, NEAR_RATIO = 10.0, 1.3  # photos so close to each other hide the same points, but for few
# Cosine law: two such photos are no farther from each other than by this part of either's distance to the point.
NEAR_APART = float(np.sqrt(1 + NEAR_RATIO**2 - 2 * NEAR_RATIO * np.cos(np.radians(NEAR_DEG))))


class OutlierImages(NamedTuple):
    """Of each photo (views,): the share of its points that it shows in another colour ``beyond`` what is usual for a
    photo; that share's ``variance``; whether it is ``much`` more than in the others (robust z). ``seen``: whether
    enough points are looked at in it; the rest is 0 where not."""

    beyond: Float[np.ndarray, "views"]
    variance: Float[np.ndarray, "views"]
    much: Bool[np.ndarray, "views"]
    seen: Bool[np.ndarray, "views"]


def outlier_images(tracks: TrackColours, fit: ExposureFit, expected: TrackColours | None) -> OutlierImages:
    """Which photos show points in another colour than the others do. ``expected``: where photos should show points that
    they have no observation of, its ``point`` numbered like that of ``tracks``. Of fewer than three none is one."""
    looked = tracks if expected is None else _together(tracks, expected)
    known = fit.known[looked.view] & np.isin(looked.point, tracks.point[fit.used])
    looked = looked.only(known)
    outlier = _differs(looked, _usual_light(tracks, fit), fit)
    points = np.bincount(looked.view, minlength=looked.views)
    seen, none = points >= MIN_POINTS, np.zeros(looked.views)
    if np.count_nonzero(seen) < 3:
        return OutlierImages(none, none, none > 0, none > 0)
    points = np.where(seen, points, 1)
    share = np.bincount(looked.view, outlier, looked.views) / points
    usual = float(np.median(share[seen]))
    deviation = OF_GAUSSIAN * float(np.median(np.abs(share - usual)[seen]))
    count_noise = np.sqrt(np.maximum(usual * (1 - usual), 1 / points) / points)
    beyond, variance = np.where(seen, share - usual, 0.0), np.where(seen, deviation**2 + count_noise**2, 0.0)
    return OutlierImages(
        beyond, variance, (beyond > MIN_SIGNAL_TO_NOISE * np.sqrt(variance)) & (beyond > MIN_EXCESS), seen
    )


def _together(one: TrackColours, other: TrackColours) -> TrackColours:
    """The observations of both, without texture."""
    names = ("view", "point", "colour", "saturated", "radius", "towards", "distance", "footprint")
    return TrackColours(one.views, *[np.concatenate([getattr(one, n), getattr(other, n)]) for n in names])


def _usual_light(tracks: TrackColours, fit: ExposureFit) -> Float[np.ndarray, "points 3"]:
    """The robust mean of each point's light, in the exposure of no photo; NaN for points without a fit."""
    size = int(tracks.point.max(initial=-1)) + 1
    mean = np.full((size, 3), np.nan)
    for channel in range(3):
        light = linear_light(tracks.colour[fit.used, channel]) * np.exp(-fit.log_gain[fit.layout.view, channel])
        mean[tracks.point[fit.used], channel] = fit.layout.point_mean(light, fit.weight[:, channel])
    return mean


def _differs(looked: TrackColours, usual: Float[np.ndarray, "points 3"], fit: ExposureFit) -> Bool[np.ndarray, "k"]:
    """Which observations are another colour than their point's, in the exposure of their photo. What is cut off at 0 or
    1 is compared where it was cut."""
    light = usual[looked.point] * np.exp(fit.log_gain[looked.view])
    difference = looked.colour - np.clip(srgb_values(light), 0, 1)
    return np.sqrt(np.mean(difference**2, axis=1)) > OUTLIER


def expected_places(
    towards: Float[np.ndarray, "k 3"],
    distance: Float[np.ndarray, "k"],
    point: Int[np.ndarray, "k"],
    centre: Float[np.ndarray, "3"],
    position: Float[np.ndarray, "points 3"],
) -> Int[np.ndarray, "m"]:
    """The points that a camera at ``centre`` should see, because two photos from nearly there do: within NEAR_DEG of
    its direction, at a distance that differs by at most NEAR_RATIO. Observations are those of the other photos; what a
    photo farther away than NEAR_APART of its ``distance`` sees may be left out before."""
    offset = centre - position[point]
    length = np.maximum(np.linalg.norm(offset, axis=1), np.finfo(float).tiny)
    close = np.sum(towards * offset, axis=1) > np.cos(np.radians(NEAR_DEG)) * length
    ratio = distance / length
    close &= (ratio < NEAR_RATIO) & (ratio > 1 / NEAR_RATIO)
    return np.flatnonzero(np.bincount(point[close], minlength=len(position)) >= 2)
