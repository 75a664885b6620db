"""Whether colours fade with distance, as in fog, haze or water: differences between channels along tracks."""

import numpy as np

from nerf.evidence.evidence import Evidence, judged, unknown
from nerf.evidence.exposure import ExposureFit
from nerf.evidence.tracks import TrackColours, linear_light
from nerf.evidence.two_way import two_way

# Light through a medium is J exp(-b d) + A (1 - exp(-b d)) (Koschmieder 1924). Between the channels A, nearly grey, falls
# out: the difference of the largest and the least one falls as exp(-b d), by whichever exposure. A fifth of the
# colour lost between the nearest and the farthest photo of the usual point is what anyone sees.
THRESHOLD = 0.2
LEAST_COLOUR = 0.08  # difference of channels as sRGB values, below which it is noise


def media_evidence(tracks: TrackColours, fit: ExposureFit) -> Evidence:
    """The exponent of fading over the range of distances at which points are seen (nine tenths of it): the slope of
    the logarithm of colourfulness over distance within photos and points alike. Of photos at one distance nothing is
    known, which is no reason to expect fog."""
    colour = tracks.colour[fit.used]
    strong = np.ptp(colour, axis=1) > LEAST_COLOUR
    # a point counts where it is strong in all its photos, or fading would leave out its own faintest cases
    count = np.bincount(fit.layout.point, minlength=1)
    strong = (np.bincount(fit.layout.point, strong, len(count)) == count)[fit.layout.point] if len(colour) else strong
    part = fit.used[strong]
    if not len(part):
        return unknown("", THRESHOLD, "no colourful points", False)
    layout = two_way(tracks.view[part], tracks.point[part], tracks.views)
    light = linear_light(tracks.colour[part])
    colourful = np.log(light.max(axis=1) - light.min(axis=1))
    weight = np.ptp(tracks.colour[part], axis=1) ** 2
    distance = tracks.distance[part]
    if not layout.main.any():
        return unknown("", THRESHOLD, "no colourful points", False)
    slope, error = layout.slope(colourful, distance, weight)
    reach = float(np.subtract(*np.quantile(layout.around_points(distance, weight), [0.95, 0.05])))
    if not np.isfinite(error):
        return unknown("", THRESHOLD, "every point is seen from one distance", False)
    fading = max(-slope * reach, 0.0)
    words = f"colours fade by {1 - np.exp(-fading):.0%} from near to far photos, ± {error * reach:.1g}"
    found = judged(fading, error * reach, THRESHOLD, "", words)
    return found._replace(called_for=bool(found.called_for))
