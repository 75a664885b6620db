"""Whether points change their colour with the direction they are seen from: differences between two photos of a point,
gains removed, at wide angles against narrow ones.

Half the squared difference of two observations is the variance of their noise, and grows with the angle between them
where colours depend on direction (the variogram of geostatistics; Matheron 1963). So does, on textured spots, what a
window shows of a surface seen from aside. Where the texture of windows is known, each range of angles gets its own line
of differences over squared texture, and what is compared is where these lines start: a spot without texture.
"""

import numpy as np
from jaxtyping import Float, Int

from nerf.effects.statistics.additive_model import AdditiveModel
from nerf.effects.statistics.exposure import ExposureFit
from nerf.effects.statistics.statistic import MIN_EFFECT, Statistic, classify, unknown
from nerf.effects.statistics.tracks import TrackColours, log_light
from nerf.rendering.srgb_arrays import OFFSET, POWER

THRESHOLD = 2 * MIN_EFFECT  # deviation of colours, sRGB values: a field of diffuse colours has it as its error
MIN_PAIRS = 60  # in each of the two ranges of angles
MIN_SPREAD_DEG = 1.5  # between the two ranges
LARGEST = 20.0  # medians of squared differences (three deviations), what false matches and passers-by count at most
BATCHES = 20


def view_dependence_statistic(tracks: TrackColours, fit: ExposureFit) -> Statistic:
    """The deviation of colours along tracks (sRGB values, root mean square of the channels) that wide angles have over
    narrow ones; the widest third of the pairs against the narrowest. Noise by batches of points (jackknife).

    A lower bound: features on highlights move with the highlight and have no tracks."""
    unit = "sRGB"
    if not fit.known.any():
        return unknown(unit, THRESHOLD, fit.unknown_because, None)
    first, second = _pairs(fit.layout)
    view_of = fit.layout.view
    both = fit.known[view_of[first]] & fit.known[view_of[second]]
    first, second = first[both], second[both]
    towards = tracks.towards[fit.used]
    cosine = np.clip(np.sum(towards[first] * towards[second], axis=1), -1, 1)
    angle = np.degrees(np.arccos(cosine))
    low, high = np.quantile(angle, [1 / 3, 2 / 3]) if len(angle) else (0.0, 0.0)
    if len(angle) and high - low < MIN_SPREAD_DEG:
        why = f"the angles between viewing directions hardly vary: {low:.1f}° to {high:.1f}°"
        return unknown(unit, THRESHOLD, why, None)
    wide = angle >= high
    chosen = wide | (angle <= low)
    if min(wide.sum(), (chosen & ~wide).sum()) < MIN_PAIRS:
        return unknown(unit, THRESHOLD, "too few points are seen from several directions", None)
    squared = _half_squares(tracks, fit, first, second)
    for group in (wide, chosen & ~wide):
        squared[group] = np.minimum(squared[group], LARGEST * np.median(squared[group]))
    squared = squared[chosen]
    texture = np.zeros(len(tracks)) if tracks.texture is None else tracks.texture
    texture = ((texture[fit.used][first] ** 2 + texture[fit.used][second] ** 2) / 2)[chosen]
    points = fit.layout.point[first][chosen]
    growth, noise = _growth(squared, texture, wide[chosen], points % BATCHES)
    return _classify(growth, noise, float(np.median(angle[wide])))


def _classify(growth: float, noise: float, angle_deg: float) -> Statistic:
    """Variances as deviations; two noises more in the one are two more in the other."""
    deviation = float(np.sqrt(max(growth, 0.0)))
    uncertain = (float(np.sqrt(deviation**2 + 2 * noise)) - deviation) / 2
    words = f"colours change by {deviation:.2g} ± {uncertain:.1g} (sRGB from 0 to 1) over {angle_deg:.0f}°"
    return classify(deviation, uncertain, THRESHOLD, "sRGB", words)


def _pairs(layout: AdditiveModel) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Of each point's pairs those of neighbours in the order of photos, and those half its track apart: of each point
    as many as it has observations, or so, near and far ones."""
    length = np.bincount(layout.point)[layout.point[layout.first]]
    lag = layout.second - layout.first
    kept = (lag == 1) | (lag == length // 2)
    return layout.first[kept], layout.second[kept]


def _half_squares(
    tracks: TrackColours, fit: ExposureFit, first: Int[np.ndarray, "pairs"], second: Int[np.ndarray, "pairs"]
) -> Float[np.ndarray, "pairs"]:
    """Half the squared difference of two observations in sRGB values, mean of the channels, gains removed.

    Differences of logarithms are taken back to sRGB values at the middle of the two: d s = (s + 0.055) / 2.4 d ln.
    """
    colour = tracks.colour[fit.used]
    gone = fit.log_gain[fit.layout.view] + fit.vignetting * (tracks.radius[fit.used] ** 2)[:, None]
    light = log_light(colour) - gone
    middle = (colour[first] + colour[second]) / 2
    difference = (light[first] - light[second]) * (middle + OFFSET) / POWER
    return np.mean(difference**2, axis=1) / 2


def _growth(
    squared: Float[np.ndarray, "n"], texture: Float[np.ndarray, "n"], wide: np.ndarray, batch: Int[np.ndarray, "n"]
) -> tuple[float, float]:
    """By how much the variance at no texture is larger in wide pairs than in narrow ones, and its standard error (each
    batch left out in turn)."""
    sums = np.zeros((BATCHES, 2, 5))
    for number, values in enumerate((np.ones_like(texture), texture, texture**2, squared, texture * squared)):
        sums[:, :, number] = np.bincount(2 * batch + wide, values, 2 * BATCHES).reshape(BATCHES, 2)
    total = sums.sum(axis=0)
    estimate = _step(total)
    without = np.array([_step(total - one) for one in sums])
    return estimate, float(np.sqrt((BATCHES - 1) * np.mean((without - without.mean()) ** 2)))


def _step(sums: Float[np.ndarray, "2 5"]) -> float:
    """The difference of where two lines start, from sums of 1, x, x², y and x y; of the means where x is constant."""
    start = []
    for count, x, xx, y, xy in sums:
        count = max(count, 1.0)
        variance = xx / count - (x / count) ** 2
        steepness = (xy / count - x * y / count**2) / variance if variance > 1e-3 * xx / count else 0.0
        # more texture never makes less difference: a line that falls is noise
        start.append(y / count - max(steepness, 0.0) * x / count)
    return start[1] - start[0]
