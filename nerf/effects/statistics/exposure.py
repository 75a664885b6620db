"""How much brighter each photo shows the same points: gains per channel, by a robust fit in log linear light.

ln(light of observation k) = log_gain[photo] + brightness[point] + vignetting · radius² + noise, per channel, by
iteratively reweighted least squares (Holland & Welsch 1977): Huber's weights from the least-squares start, then Geman
and McClure's, which forget highlights and passers-by.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf.effects.statistics.additive_model import AdditiveModel, additive_model
from nerf.effects.statistics.statistic import (
    HUBER,
    MIN_EFFECT,
    MIN_SIGNAL_TO_NOISE,
    OF_GAUSSIAN,
    VALUE_PER_LOG_LIGHT,
    Statistic,
    classify,
    unknown,
)
from nerf.effects.statistics.tracks import TrackColours, log_light, log_noise, usable

EV = float(np.log(2.0))
# A gain that is off by d in ln(light) makes an error of VALUE_PER_LOG_LIGHT d in sRGB values: MIN_EFFECT is d = 0.034,
# 0.05 EV. Called for from twice that, when gains deviate by 0.1 EV.
THRESHOLD_EV = 2 * MIN_EFFECT / VALUE_PER_LOG_LIGHT / EV
# Between lamplight and snow in the sun lie 12 EV. Beyond that, gains add up what is no exposure: along a row of photos
# darker borders, or a lamp that moves with the camera.
MAX_SPREAD_EV = 12.0
GEMAN_MCCLURE = 5.0  # in robust deviations: as HUBER loses some 5 % to plain means of normal noise
HUBER_ROUNDS, MAX_ROUNDS = 8, 30
CONVERGED = 1e-5  # of a log gain: a tenth of what gains are rounded to where they leave
MIN_NOISE = 0.25 / 255  # of an sRGB value: no photo of 8 bits is more exact, and a perfect fit has no deviation


class ExposureFit(NamedTuple):
    """``log_gain`` (views, 3): natural logarithm of linear light, its median over the connected photos 0 per channel;
    ``error``: its standard error, infinite (and the gain 0) where a photo shares hardly any points with the others.

    ``used`` are the m observations fitted, ``rest`` (m, 3) what is left of their logarithms, ``weight`` (m, 3) their
    robust weights over the variance of their noise. ``noise`` is the robust deviation of what is left as an sRGB value.
    ``contrast`` (views,): by how much ln(light) of a photo rises too much with that of the points, 0.1 for a power of
    1.1; times ``brightness_spread`` it is the difference in gain between bright and dark points.
    """

    layout: AdditiveModel
    used: Int[np.ndarray, "m"]
    rest: Float[np.ndarray, "m 3"]
    weight: Float[np.ndarray, "m 3"]
    log_gain: Float[np.ndarray, "views 3"]
    error: Float[np.ndarray, "views 3"]
    vignetting: Float[np.ndarray, "3"]
    noise: float
    contrast: Float[np.ndarray, "views"]
    contrast_error: Float[np.ndarray, "views"]
    brightness_spread: float

    @property
    def unknown_because(self) -> str:
        """Why nothing is known of any photo, where that is so."""
        return "no two photos show the same unsaturated points" if len(self.used) else "no tracks"

    @property
    def known(self) -> Bool[np.ndarray, "views"]:
        """The photos whose gain is known beside the others'."""
        return np.asarray(np.isfinite(self.error).all(axis=1))


def fit_exposure(tracks: TrackColours) -> ExposureFit:
    """Gains of all photos. Radial darkening is fitted beside them where it is beyond doubt (``vignetting``, ln at the
    corner), for gains of photos that show the same points at their corners would take a part of it."""
    used = usable(tracks)
    layout = additive_model(tracks.view[used], tracks.point[used], tracks.views)
    y, sigma = log_light(tracks.colour[used]), log_noise(tracks.colour[used])
    square = tracks.radius[used] ** 2
    gain, error = np.zeros((tracks.views, 3)), np.full((tracks.views, 3), np.inf)
    rest, weight = np.zeros_like(y), np.ones_like(y)
    vignetting, noise = np.zeros(3), np.zeros(3)
    for channel in range(3 if layout.connected.any() else 0):
        part = y[:, channel]
        weight[:, channel], noise[channel], inflation = _robust_weights(layout, part, sigma[:, channel])
        slope, slope_error = layout.slope(part, square, weight[:, channel])
        if abs(slope) > MIN_SIGNAL_TO_NOISE * slope_error:
            vignetting[channel] = slope
            part = part - slope * square
            weight[:, channel], noise[channel], inflation = _robust_weights(layout, part, sigma[:, channel])
        gain[:, channel] = layout.view_effects(part, weight[:, channel])
        rest[:, channel] = layout.within_points(part - gain[layout.view, channel], weight[:, channel])
        error[:, channel] = layout.standard_errors(rest[:, channel], weight[:, channel]) * inflation
    known = np.asarray(np.isfinite(error).all(axis=1))
    if known.any():
        gain = np.where(known[:, None], gain - np.median(gain[known], axis=0), 0.0)
    contrast, contrast_error, spread = _contrast(layout, y - gain[layout.view] - vignetting * square[:, None], weight)
    return ExposureFit(
        layout, used, rest, weight, gain, error, vignetting, float(noise.mean()), contrast, contrast_error, spread
    )


def _robust_weights(
    layout: AdditiveModel, y: Float[np.ndarray, "m"], sigma: Float[np.ndarray, "m"]
) -> tuple[Float[np.ndarray, "m"], float, float]:
    """Converged weights, the robust deviation in units of ``sigma``, and by how much standard errors grow over those of
    fixed weights.

    What is left of an observation is smaller by sqrt(1 - its part in the point's weight) than its noise. Weights w(u)
    that fall with what is left, u, follow a shift by less than it: E[w + u w'] in place of E[w] (Huber 1964). Geman and
    McClure's are w = 1/q² with q = 1 + (u/c)², so that w + u w' = (4 - 3q)/q³.
    """
    base = sigma**-2
    weight, scale, size, before = base, 0.0, np.zeros_like(y), np.zeros(layout.views)
    for turn in range(MAX_ROUNDS):
        gain = layout.view_effects(y, weight)
        rest = layout.within_points(y - gain[layout.view], weight)
        size = np.abs(rest) / (sigma * np.sqrt(np.maximum(1 - layout.point_share(weight), 0.02)))
        scale = max(OF_GAUSSIAN * float(np.median(size)), MIN_NOISE)
        size = size / scale
        if turn < HUBER_ROUNDS:
            weight = base * np.minimum(1, HUBER / np.maximum(size, HUBER))
        else:
            weight = base / (1 + (size / GEMAN_MCCLURE) ** 2) ** 2
        if turn > HUBER_ROUNDS and np.abs(gain - before).max() < CONVERGED:
            break
        before = gain
    q = 1 + (size / GEMAN_MCCLURE) ** 2
    followed = float(np.sum(base * (4 - 3 * q) / q**3)) / float(np.sum(base / q**2))
    return weight, scale, 1 / max(followed, 0.1)


def _contrast(
    layout: AdditiveModel, y: Float[np.ndarray, "m 3"], weight: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "views"], Float[np.ndarray, "views"], float]:
    """How each photo's brightness, gains removed, rises with that of its points in the other photos: the slope - 1, its
    median 0; its standard error; and the deviation of brightness over a photo's points.

    The other photos' mean is as noisy as the photo is itself, which would flatten a slope against it: so difference is
    laid against middle (Bland & Altman 1986).
    """
    none = np.zeros(layout.views)
    if not layout.connected.any():
        return none, np.full(layout.views, np.inf), 0.0
    grey, importance = y.mean(axis=1), weight.min(axis=1)
    share = np.minimum(layout.point_share(importance), 0.98)
    difference = (grey - layout.point_mean(grey, importance)) / (1 - share)
    importance = importance * (1 - share)
    total = np.maximum(layout.sum_per_view(importance), np.finfo(float).tiny)
    middle = grey - difference / 2
    middle = middle - (layout.sum_per_view(importance * middle) / total)[layout.view]
    difference = difference - (layout.sum_per_view(importance * difference) / total)[layout.view]
    size = layout.sum_per_view(importance * middle**2)
    known = layout.connected & (size > 1e-4 * total) & (np.bincount(layout.view, minlength=layout.views) > 3)
    if not known.any():
        return none, np.full(layout.views, np.inf), 0.0
    size = np.where(known, size, 1.0)
    slope = np.where(known, layout.sum_per_view(importance * middle * difference) / size, 0.0)
    score = importance * middle * (difference - slope[layout.view] * middle)
    error = np.where(known, np.sqrt(layout.sum_per_view(score**2)) / size, np.inf)
    slope = np.where(known, slope - np.median(slope[known]), 0.0)
    return slope, error, float(np.sqrt(np.median((size / total)[known])))


def exposure_statistic(
    fit: ExposureFit,
    told: Float[np.ndarray, "views"] | None = None,
    odd: Bool[np.ndarray, "views"] | None = None,
) -> Statistic:
    """Whether photos differ in exposure (or white balance): the deviation of gains over photos and channels, EV.

    The noise, that of one usual gain, is beside it; what all gains have is taken off in quadrature, so that noise alone
    is no difference. Photos whose noise is an effect itself do not count, for a few would hide the others' gains, or
    pass for a difference; nor do ``odd`` ones, in which something stands before many of their points
    (nerf/effects/statistics/outlier_images.py) and draws their gains. Gains farther apart than MAX_SPREAD_EV are no
    exposures. ``told`` is what the camera wrote of each photo's exposure (EV up to a constant, NaN where nothing): a
    cross-check, which decides nothing because programs that develop photos change exposures and leave what was written.
    """
    if not fit.known.any():
        return unknown("EV", THRESHOLD_EV, fit.unknown_because, None)
    plain = fit.known if odd is None else or_all(fit.known & ~odd, fit.known)
    counted = or_all(plain & (fit.error.max(axis=1) < THRESHOLD_EV * EV), plain)
    gain, error = fit.log_gain[counted] / EV, fit.error[counted] / EV
    noise = float(np.median(error))
    spread = float(np.sqrt(max(np.mean((gain - gain.mean(axis=0)) ** 2) - np.mean(error**2), 0.0)))
    span = float(np.ptp(gain.mean(axis=1)))
    ratio = f"{span / noise:.0f} × their noise" if noise > 0 else "without noise"
    alone = int(np.count_nonzero(~fit.known))
    left_out = f"; {_photos(alone)} excluded: too few points shared with the others" if alone else ""
    strange, unsure = int(np.count_nonzero(fit.known & ~plain)), int(np.count_nonzero(plain & ~counted))
    left_out += f"; {_photos(strange)} excluded as outliers" if strange else ""
    left_out += f"; {_photos(unsure)} excluded: gain uncertain by over {THRESHOLD_EV:.1g} EV" if unsure else ""
    checked = "" if told is None else _beside_told(gain.mean(axis=1), told[counted])
    found = classify(spread, noise, THRESHOLD_EV, "EV", f"gains span {span:.2g} EV, {ratio}{left_out}{checked}")
    if np.ptp(np.percentile(gain.mean(axis=1), [5, 95])) > MAX_SPREAD_EV:
        found = found._replace(called_for=False, words=f"{found.words}; no exposures differ by so much")
    return found


def or_all(some: Bool[np.ndarray, "views"], every: Bool[np.ndarray, "views"]) -> Bool[np.ndarray, "views"]:
    """Some of the photos; all where fewer than two are left."""
    return some if np.count_nonzero(some) > 1 else every


def _photos(count: int) -> str:
    """3 photos, 1 photo."""
    return f"{count} photo{'s' * (count != 1)}"


def _beside_told(gain: Float[np.ndarray, "known"], told: Float[np.ndarray, "known"]) -> str:
    """How far the gains are from what the cameras wrote, in words; nothing where they wrote of less than two."""
    both = np.isfinite(told)
    if np.count_nonzero(both) < 2:
        return ""
    apart = (gain - told)[both]
    apart = np.sqrt(np.mean((apart - apart.mean()) ** 2))
    return f"; EXIF exposures span {np.ptp(told[both]):.2g} EV, and the gains differ from them by {apart:.2g} EV (rms)"
