"""How differently large the photos' pixels are at the same points."""

import numpy as np

from nerf.evidence.evidence import Evidence, judged, unknown
from nerf.evidence.tracks import TrackColours, within_groups

# A sample that stands for a pixel is right at one size. Detail between one octave and the next is what photos at twice
# the distance cannot show and photos at the other show whole: from there on they contradict each other at edges (the
# grey zone), and at two octaves at most of them (mip-NeRF, Barron et al. 2021, loses 10 dB and more at eight-fold).
THRESHOLD = 4.0
QUANTILE = 0.95


def scale_evidence(tracks: TrackColours) -> Evidence:
    """The 95th percentile over points of the largest by the smallest footprint, over the photos that see each.

    Features are matched over some two octaves at most, so the ratio between photos that share no point is not known:
    what is found is a lower bound.
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
    words = f"pixels of different photos differ {found:.2g}-fold in size at the same points"
    # beside a ratio of 1, which photos at one distance have
    return judged(found, float(above - below) / 2, THRESHOLD, "×", words)
