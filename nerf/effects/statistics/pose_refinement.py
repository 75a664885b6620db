"""How far photos are from where their pose puts them: residuals of reprojection that a whole photo has in common."""

import numpy as np
from jaxtyping import Float, Int

from nerf.effects.statistics.statistic import GREY_ZONE, HUBER, OF_GAUSSIAN, Statistic, decide, unknown

PX = "px at 1000"  # pixels of a photo whose longer side has 1000: what a full photo's are depends on the camera
# An error of d pixels changes values by d times their step from pixel to pixel, which in usual photos at 1000 pixels is
# 0.03 rms: MIN_EFFECT is 0.3 px, and called for is twice that.
THRESHOLD_PX = 0.6
# Refinement is for all photos and takes a third more time. A photo that does not fit costs its own place some 4 dB,
# however far off it is: over all that is the 1.1 dB of the threshold once so many of the photos are off.
OFF = 0.25
FREE = 4  # shift, turn and zoom: what a wrong pose does to far and near points alike
ROUNDS = 10


def common_residuals(
    residual: Float[np.ndarray, "k 2"], place: Float[np.ndarray, "k 2"], view: Int[np.ndarray, "k"], views: int
) -> tuple[Float[np.ndarray, "views"], Float[np.ndarray, "views"]]:
    """(mean square of the common part in px², its expectation from noise alone) per photo; NaN with too few points.

    The common part is the similarity (shift, turn, zoom about the photo's mean) that fits the residuals best, by
    Huber's weights; ``residual`` observed minus projected and ``place`` are in pixels. Noise of variance s² per
    coordinate leaves on average FREE s² / points in it.
    """
    power, expected = np.full(views, np.nan), np.full(views, np.nan)
    order = np.argsort(view, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(view[order])) + 1):
        if len(group) > 2 * FREE:
            fitted, variance = _similarity(residual[group], place[group])
            power[view[group[0]]] = np.mean(np.sum(fitted**2, axis=1))
            expected[view[group[0]]] = FREE * variance / len(group)
    return power, expected


def _similarity(
    residual: Float[np.ndarray, "n 2"], place: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], float]:
    """The fitted part of each residual, and the effective variance of one coordinate's noise.

    With all four unknowns orthogonal (places centred, weights nearly even) rows are x: (1, 0, x, -y), y: (0, 1, y, x).
    """
    x, y = (place - place.mean(axis=0)).T / max(float(np.ptp(place)), 1.0)
    one, none = np.ones_like(x), np.zeros_like(x)
    design = np.concatenate([np.stack([one, none, x, -y], 1), np.stack([none, one, y, x], 1)])
    target = residual.T.ravel()
    weight, rest = np.ones(len(target)), target
    solution = np.zeros(FREE)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
        rest = target - design @ solution
        scale = OF_GAUSSIAN * float(np.median(np.abs(rest)))
        size = np.abs(rest) / scale if scale > 0 else np.zeros_like(rest)
        weight = np.minimum(1, HUBER / np.maximum(size, HUBER))
    # the variance of a Huber estimate: E[psi²] / E[psi']²
    inner = float(np.mean(weight == 1))
    variance = float(np.mean((weight * rest) ** 2)) / max(inner, 0.1) ** 2
    return (design @ solution).reshape(2, -1).T, variance


def pose_statistic(
    power: Float[np.ndarray, "views"], expected: Float[np.ndarray, "views"], uncertainty_px: Float[np.ndarray, "views"]
) -> Statistic:
    """By how much a quarter of the photos (OFF) or more are off: the common residual, noise taken off; or how uncertain
    their poses are said to be, where that is more. All in PX; NaN where a photo's is not known.

    Poses that were given, and points triangulated in them, show what is wrong with them, less what the points have
    taken up. After a bundle adjustment of these very points nothing in common is left, and the uncertainty says more;
    but not that refinement helps. Most of it are bends that move cameras and points together (a long strip of photos
    has the softest), and the field follows those as the points do. So it calls for nothing, and leaves open.
    """
    known = np.isfinite(power) & np.isfinite(expected)
    stated = uncertainty_px[np.isfinite(uncertainty_px)]
    uncertain = float(np.quantile(stated, 1 - OFF)) if len(stated) else 0.0
    if not known.any() and not len(stated):
        return unknown(PX, THRESHOLD_PX, "no tracks", None)
    common, noise = 0.0, 0.0
    if known.any():
        common = float(np.sqrt(max(np.quantile(power[known] - expected[known], 1 - OFF), 0.0)))
        noise = float(np.sqrt(np.median(expected[known])))
    called_for = decide(common, noise, THRESHOLD_PX)
    if called_for is False and uncertain >= THRESHOLD_PX / GREY_ZONE:
        called_for = None
    stated_words = f"{uncertain:.2g} px" if len(stated) else "unknown"
    off = f"common reprojection error {common:.2g} ± {noise:.1g} px, pose uncertainty {stated_words}"
    words = f"upper quartile of the photos, at 1000 pixels: {off}"
    return Statistic(max(common, uncertain), PX, THRESHOLD_PX, noise, called_for, words)
