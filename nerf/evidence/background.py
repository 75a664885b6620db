"""Whether photos show anything beyond the region of interest, and how much of them is beside all points."""

import numpy as np
from jaxtyping import Float, Int

from nerf.evidence.evidence import Evidence, unknown

REGION_HALF = 0.9  # the region of interest is [-0.9, 0.9]^3 of the scene frame
# Where a field has nothing it shows one colour; the photos deviate from it there by some 0.25 in sRGB values.
# A share q of such pixels adds 0.06 q to the squared error: half a percent of them would be 1.1 dB at 30 dB.
# Points are not pixels: they stand where texture is, so half a percent of them is known no better than to a factor 2.
THRESHOLD = 0.01
CELLS = 16  # along each side of a photo


def background_evidence(
    position: Float[np.ndarray, "points 3"], point: Int[np.ndarray, "k"], has_alpha: bool, untracked: float
) -> Evidence:
    """The share of observations whose point lies beyond the region (the background is unbounded), its noise that of a
    count of independent points; ``untracked`` only joins the words. Photos with alpha say themselves what is there."""
    if has_alpha:
        return Evidence(0.0, "share", THRESHOLD, 0.0, False, "the photos' alpha says what is background")
    seen = np.bincount(point, minlength=len(position)).astype(float)
    if not seen.any():
        return unknown("share", THRESHOLD, "no tracks", True)
    beyond = np.abs(position).max(axis=1) > REGION_HALF
    share = float(np.average(beyond, weights=seen))
    effective = float(seen.sum() ** 2 / np.sum(seen**2))
    noise = float(np.sqrt(max(share * (1 - share), 1 / effective) / effective))
    words = (
        f"{share:.1%} of what is tracked lies beyond the region; {untracked:.0%} of the photos' area has no track near"
    )
    if share < THRESHOLD:
        words += ", and only alpha could tell that nothing lies beyond"
    return Evidence(share, "share", THRESHOLD, noise, True, words)


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
