"""How differently large the photos' pixels are at the same points."""

import numpy as np

from nerf.effects.statistics.additive_model import two_way
from nerf.effects.statistics.statistic import Evidence, judged, unknown
from nerf.effects.statistics.tracks import MAX_IN_TRACK, TrackColours, within_groups

# A sample that stands for a pixel is right at one size. Detail between one octave and the next is what photos at twice
# the distance cannot show and photos at the other show whole: from there on they contradict each other at edges (the
# grey zone), and at two octaves at most of them (mip-NeRF, Barron et al. 2021, loses 10 dB and more at eight-fold).
THRESHOLD = 4.0
QUANTILE = 0.95


def scale_evidence(tracks: TrackColours) -> Evidence:
    """The 95th percentile over points of the largest by the smallest footprint, over the photos that see each; or the
    ratio of the 95th by the 5th percentile of photos, where that is more.

    Features are matched over an octave or two, so far and near photos of the same thing may share no point, but others
    between them do: ln(footprint) = size[photo] + size[point], fitted to all, compares photos by way of these.
    """
    order = np.lexsort((tracks.footprint, tracks.point))
    rank, length = within_groups(tracks.point[order])
    several = length > 1
    if not several.any():
        return unknown("×", THRESHOLD, "no tracks", False)
    size = tracks.footprint[order]
    ratio = size[several & (rank == length - 1)] / size[several & (rank == 0)]
    found = float(np.quantile(ratio, QUANTILE))
    # the quantiles that are a binomial deviation off: the standard error of a quantile without a distribution
    off = np.sqrt(QUANTILE * (1 - QUANTILE) / len(ratio))
    below, above = np.quantile(ratio, [QUANTILE - off, min(QUANTILE + off, 1.0)])
    whole = _between_photos(tracks)
    words = f"pixels at the same points differ {found:.2g}-fold in size, by way of other photos {whole:.2g}-fold"
    return judged(max(found, whole), float(above - below) / 2, THRESHOLD, "×", words)


def _between_photos(tracks: TrackColours) -> float:
    """The ratio of the sizes of pixels between nine tenths of the connected photos."""
    seen = tracks.only(np.lexsort((tracks.view, tracks.point)))
    rank, length = within_groups(seen.point)
    seen = seen.only((length > 1) & (rank < MAX_IN_TRACK))
    layout = two_way(seen.view, seen.point, seen.views)
    if not layout.main.any():
        return 1.0
    size = layout.parts(np.log(seen.footprint), np.ones(len(seen)))[layout.main]
    return float(np.exp(np.ptp(np.quantile(size, [1 - QUANTILE, QUANTILE]))))
