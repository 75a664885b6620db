"""Whether colours fade with distance, as in fog, haze or water: the saturation of points along their tracks."""

import numpy as np
from jaxtyping import Float

from nerf.effects.statistics.additive_model import two_way
from nerf.effects.statistics.exposure import ExposureFit
from nerf.effects.statistics.statistic import Evidence, judged, unknown
from nerf.effects.statistics.tracks import TrackColours
from nerf.rendering.srgb import linear_light

# Light through a medium is J exp(-b d) + A (1 - exp(-b d)) (Koschmieder 1924) with A nearly grey: the difference of the
# largest and the least channel falls as exp(-b d). Over their mean it does too, for colours about as bright as A, and
# exposure and shading fall out. A fifth of the colour lost between near and far photos is what anyone sees.
THRESHOLD = 0.2
MIN_COLOUR = 0.08  # difference of channels as sRGB values, below which it is noise
# Small spots fade in far photos that show them blurred, their colours most of all (JPEG keeps half of the resolution):
# windows count by how even they are, half where their grey values deviate by this.
ROUGH = 0.02


def media_evidence(tracks: TrackColours, fit: ExposureFit) -> Evidence:
    """The exponent of fading over the range of distances at which points are seen (nine tenths of it): the slope of the
    logarithm of saturation over distance within photos and points alike. Where nothing is known, that is no reason
    to expect fog."""
    colour = tracks.colour[fit.used]
    strong = np.ptp(colour, axis=1) > MIN_COLOUR
    if not strong.any():
        return unknown("", THRESHOLD, "no colourful points", False)
    # a point counts where it is strong in all its photos, or fading would leave out its own faintest cases
    point = fit.layout.point
    strong = (np.bincount(point, strong) == np.bincount(point))[point]
    part = fit.used[strong]
    layout = two_way(tracks.view[part], tracks.point[part], tracks.views)
    if not layout.main.any():
        return unknown("", THRESHOLD, "no colourful points", False)
    light, distance, weight = linear_light(tracks.colour[part]), tracks.distance[part], _weights(tracks.only(part))
    slope, error = layout.slope(np.log(np.ptp(light, axis=1) / light.mean(axis=1)), distance, weight)
    if not np.isfinite(error):
        return unknown("", THRESHOLD, "every point is seen from one distance", False)
    reach = float(np.ptp(np.quantile(layout.around_points(distance, weight), [0.05, 0.95])))
    fading = max(-slope * reach, 0.0)
    words = f"colours fade by {1 - np.exp(-fading):.0%} from near to far photos, ± {error * reach:.0%}"
    found = judged(fading, error * reach, THRESHOLD, "", words)
    return found._replace(called_for=bool(found.called_for))


def _weights(tracks: TrackColours) -> Float[np.ndarray, "k"]:
    """Faint colours are noisy, and rough windows are not the same piece of a surface."""
    rough = 0.0 if tracks.texture is None else tracks.texture / ROUGH
    return np.ptp(tracks.colour, axis=1) ** 2 / (1 + rough**2)
