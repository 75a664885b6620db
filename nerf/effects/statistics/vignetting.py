"""Whether photos are darker towards their corners: what gains leave, against the square of the radius."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf.effects.statistics.exposure import EV, ExposureFit
from nerf.effects.statistics.statistic import MIN_EFFECT, VALUE_PER_LOG_LIGHT, Statistic, classify, unknown
from nerf.effects.statistics.tracks import TrackColours, log_light

# Light at radius r (half diagonals) is exp(a r^2). Over the pixels of a photo r^2 deviates by some 0.24 from its mean,
# which gains take up: an error of 0.24 VALUE_PER_LOG_LIGHT a in sRGB values. MIN_EFFECT is a = 0.14, 0.2 EV there;
# called for from twice that, a quarter of the light. It is what a field cannot explain at all that harms;
# photos that always show the same points at the same radius look alike and are not harmed, nor is it measured in them.
THRESHOLD_EV = 2 * MIN_EFFECT / (0.24 * VALUE_PER_LOG_LIGHT) / EV


class RadialSlope(NamedTuple):
    """The slope of ln(light) over the square of the radius, mean of the channels, and its standard error ``noise``:
    infinite where nothing is known, for the reason ``unknown_because``."""

    slope: float
    noise: float
    unknown_because: str = ""


def radial_slope(tracks: TrackColours, fit: ExposureFit) -> RadialSlope:
    """Within photos and points alike, so neither gains nor points that are always in corners pass for it."""
    if not fit.known.any():
        return RadialSlope(0.0, float("inf"), fit.unknown_because)
    y, square = log_light(tracks.colour[fit.used]), tracks.radius[fit.used] ** 2
    found = np.array([fit.layout.slope(y[:, channel], square, fit.weight[:, channel]) for channel in range(3)])
    slope, noise = float(found[:, 0].mean()), float(np.sqrt(np.mean(found[:, 1] ** 2)))
    return RadialSlope(slope, noise, "" if np.isfinite(noise) else "every point lies at the same radius in all photos")


def vignetting_statistic(found: RadialSlope) -> Statistic:
    """By how much corners are darker than the middle, EV; below 0 they are brighter, which no lens makes them."""
    if found.unknown_because:
        return unknown("EV", THRESHOLD_EV, found.unknown_because, False)
    slope, noise = found.slope / EV, found.noise / EV
    words = f"corners are {abs(slope):.2g} ± {noise:.1g} EV {'darker' if slope < 0 else 'brighter'} than the centre"
    return classify(-slope, noise, THRESHOLD_EV, "EV", words)


def log_falloff(u: Float[np.ndarray, "*n"], falloff: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*n"]:
    """p(u) of nerf/effects/vignetting.py: 0 at the axis, the sum of the coefficients at the corner, where u is 1;
    √u is nearly the distance from the axis in the image."""
    first, second, third = falloff
    return first * (1 - (1 - u) ** 3) + second * (3 * u**2 - 2 * u**3) + third * u**3
