"""Whether rows of a video's frames were taken one after another: residuals along the motion that grow with the row."""

import numpy as np
from jaxtyping import Float, Int

from nerf.effects.statistics.poses import PX, THRESHOLD_PX
from nerf.effects.statistics.statistic import OF_GAUSSIAN, Evidence, judged, unknown

MIN_MOTION_PX = 2.0  # per frame, at 1000 pixels, below which rows have no time to differ


def rolling_shutter_evidence(
    residual: Float[np.ndarray, "k 2"],
    row: Float[np.ndarray, "k"],
    motion: Float[np.ndarray, "views 2"],
    view: Int[np.ndarray, "k"],
) -> Evidence:
    """The error at the upper and lower edges of a frame of usual motion, PX: half the product of the motion and of the
    readout as a part of the time between frames. Called for where it harms as wrong poses do
    (nerf/effects/statistics/poses.py).

    ``residual``: observed minus projected, PX; ``row``: across the sensor's rows, as a share of the photo
    (:func:`across_rows`); ``motion``: how far the picture moves from a frame to the next, PX, NaN where it is not known
    or the photos are no video. The row at y shows the scene (y - 1/2) readouts later (or earlier, where the camera was
    turned about), so residual = ± readout (y - 1/2) motion; what poses could take up of it (shift, zoom) is gone after
    a bundle adjustment, and what is found is a lower bound.
    """
    speed = np.linalg.norm(motion, axis=1)
    moving = np.isfinite(speed) & (speed > MIN_MOTION_PX)
    kept = moving[view]
    if np.count_nonzero(kept) < 100 or np.count_nonzero(moving) < 3:
        return unknown(PX, THRESHOLD_PX, "no video, or one that hardly moves", False)
    along = np.sum(residual[kept] * motion[view[kept]], axis=1) / speed[view[kept]]
    limit = 4 * OF_GAUSSIAN * float(np.median(np.abs(along)))
    along = np.clip(along, -limit, limit)  # false matches
    expected = (row[kept] - 0.5) * speed[view[kept]]
    size = float(np.sum(expected**2))
    readout = float(np.sum(expected * along)) / size
    # frames are taken as independent, their points are not
    score = np.bincount(view[kept], expected * (along - readout * expected), len(speed))
    edge = float(np.median(speed[moving])) / 2
    noise = float(np.sqrt(np.sum(score**2))) / size * edge
    off = f"at 1000 pixels {abs(readout) * edge:.2g} ± {noise:.1g} px at the edges"
    words = f"rows take {abs(readout):.0%} of the time between frames, {off}"
    found = judged(abs(readout) * edge, noise, THRESHOLD_PX, PX, words)
    return found._replace(called_for=bool(found.called_for))


def across_rows(xy: Float[np.ndarray, "k 2"], size: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
    """Where pixels of photos of width and height ``size`` lie across the sensor's rows, from 0 to 1: along the shorter
    side, for sensors are wider than high, and a frame that is higher than wide was turned."""
    turned = size[:, 0] < size[:, 1]
    return np.where(turned, xy[:, 0] / size[:, 0], xy[:, 1] / size[:, 1])


def motion_to_next(
    xy: Float[np.ndarray, "k 2"],
    point: Int[np.ndarray, "k"],
    view: Int[np.ndarray, "k"],
    frame: Int[np.ndarray, "views"],
) -> Float[np.ndarray, "views 2"]:
    """How far the picture moves from a frame to the next one, in the pixels of ``xy``: the median over the points that
    both see; NaN where they share fewer than ten, and where the next view is not the next frame by its number."""
    views = len(frame)
    motion = np.full((views, 2), np.nan)
    of_view = [np.flatnonzero(view == number) for number in range(views)]
    for number in np.flatnonzero(np.diff(frame) == 1):
        here, there = of_view[number], of_view[number + 1]
        _, left, right = np.intersect1d(point[here], point[there], return_indices=True)
        if len(left) >= 10:
            motion[number] = np.median(xy[there[right]] - xy[here[left]], axis=0)
    return motion
