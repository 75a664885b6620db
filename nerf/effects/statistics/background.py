"""Whether photos show anything beyond the region of interest, and how much of them is beside all points."""

import numpy as np
from jaxtyping import Float, Int

from nerf import REGION_HALF_SIZE
from nerf.effects.statistics.statistic import Statistic, unknown

NEVER = float("inf")  # the threshold of what no share decides, and its noise: only alpha or a backdrop does
CELLS = 16  # along each side of a photo


def background_statistic(
    position: Float[np.ndarray, "points 3"], point: Int[np.ndarray, "k"], nothing: str | None, untracked: float
) -> Statistic:
    """``nothing``: how photos with alpha, or before a plain backdrop, say themselves that nothing is there; without it
    the background is always called for, since sky and plain walls have no points: that none lies beyond the region
    proves nothing.

    The share of observations whose point does, and ``untracked``, are shown and decide nothing, so threshold and noise
    are infinite."""
    if nothing is not None:
        return Statistic(0.0, "share", NEVER, NEVER, False, nothing)
    seen = np.bincount(point, minlength=len(position)).astype(float)
    if not seen.any():
        return unknown("share", NEVER, "no tracks", True)
    beyond = np.abs(position).max(axis=1) > REGION_HALF_SIZE
    share = float(np.average(beyond, weights=seen))
    words = (
        f"no alpha or plain backdrop rules it out: {share:.1%} of the observations are of points beyond the region of "
        f"interest, and {untracked:.0%} of the photos' area has no point nearby"
    )
    return Statistic(share, "share", NEVER, NEVER, True, words)


def untracked_share(place: Float[np.ndarray, "k 2"], view: Int[np.ndarray, "k"], views: int) -> float:
    """The share of the photos' area with no observation near: of CELLS × CELLS cells, those without one in them or in
    their eight neighbours. ``place``: x / width and y / height. 1 without observations."""
    cell = np.clip((place * CELLS).astype(int), 0, CELLS - 1)
    near = np.zeros((views, CELLS + 2, CELLS + 2), bool)
    for down in range(3):
        for across in range(3):
            near[view, cell[:, 1] + down, cell[:, 0] + across] = True
    inside = near[:, 1:-1, 1:-1]
    return float(1 - inside.mean()) if inside.size else 1.0
