"""From what each neighbour says of a photo's depths to what several of them agree on.

Two neighbours agree at a pixel where their distances differ by less than a pixel of either's disparity: a match by
chance, on a thing that moved or in a reflection, has another distance in every pair. Kept is the distance that most
neighbours agree on, their mean by variance; at least two have to.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

MIN_VIEWS = 2
AGREEING_PX = 1.0
# Neighbours share the noise of the photo itself, and none sees what its poses have wrong: errors on walls are so much
# larger than those of independent means (tests/stages/depth: median |error / sigma| is then that of a normal law).
SIGMA_FACTOR = 1.6
MAX_SIGMA = 0.02  # relative: what is not known better is no help


class Candidate(NamedTuple):
    """What one neighbour says of a photo: inverse distances along the rays, their standard deviations, and by how much
    they change with a pixel of disparity; NaN where it says nothing."""

    inverse: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    per_pixel: Float[np.ndarray, "h w"]


class DepthMap(NamedTuple):
    """Distances along a photo's unit rays in scene units, 0 where not known; their relative standard deviations; and
    how many neighbours agree."""

    distance: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    views: UInt8[np.ndarray, "h w"]

    @property
    def coverage(self) -> float:
        """Share of the pixels whose distance is known."""
        return float(np.mean(self.distance > 0))


def agreed(candidates: list[Candidate], shape: tuple[int, int]) -> DepthMap:
    """The depth map that ``candidates`` agree on."""
    best = np.zeros(shape, np.uint8)
    inverse, variance = np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
    for one in candidates:
        votes, weight, total = np.zeros(shape, np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for other in candidates:
            tolerance = AGREEING_PX * np.minimum(one.per_pixel, other.per_pixel)
            with np.errstate(invalid="ignore"):
                agrees = np.abs(one.inverse - other.inverse) <= tolerance  # NaN agrees with nothing
            own = np.where(agrees, 1 / np.square(other.sigma), 0)
            votes += agrees
            weight += own
            total += np.where(agrees, own * other.inverse, 0)
        found = np.divide(1, weight, out=np.full(shape, np.inf, np.float32), where=weight > 0)
        better = (votes > best) | ((votes == best) & (found < variance))
        best, variance = np.where(better, votes, best), np.where(better, found, variance)
        inverse = np.where(better, total * np.where(np.isfinite(found), found, 0), inverse)
    known = (best >= MIN_VIEWS) & (inverse > 0)
    distance = np.divide(1, inverse, out=np.zeros(shape, np.float32), where=known)
    sigma = SIGMA_FACTOR * np.sqrt(np.where(known, variance, 0)) * distance
    kept = known & (sigma < MAX_SIGMA)
    distance, sigma = np.where(kept, distance, 0), np.where(kept, sigma, 0)
    return DepthMap(distance, sigma.astype(np.float32), np.where(kept, best, 0).astype(np.uint8))
