"""From what each neighbour says of a photo's depths to what several of them agree on.

Two neighbours agree at a pixel where their distances differ by less than a pixel of either's disparity: a match by
chance, on a thing that moved or in a reflection, has another distance in every pair. Kept is the distance that most
neighbours agree on, their mean by variance; at least two have to.

Neighbours may be wrong together: where a pattern repeats and cameras stand at even distances, each pair is off by one
period, and all see one surface in front of the true one. Along it nothing tells, but it ends somewhere. So distances
are judged by the patch: pixels beside each other on one surface. A patch that more sparse points contradict than
support is not kept, nor one of a few pixels, which are chance matches.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

MIN_VIEWS = 2
AGREEING_PX = 1.0
# Neighbours share the noise of the photo itself, and none sees what its poses have wrong: errors on walls are so much
# larger than those of independent means (tests/stages/depth: median |error / sigma| is then that of a normal law).
SIGMA_FACTOR = 1.6
MAX_SIGMA = 0.02  # relative: what is not known better is no help
MAX_STEP = 0.01  # of the distance, from a pixel to the next on one patch
MIN_PATCH_PIXELS = 25
SUPPORTS, CONTRADICTS = 0.01, 0.02  # of the distance: up to which a sparse point supports its patch, and from which not


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


class SparseDepths(NamedTuple):
    """At which pixels of a photo's depth map it shows a sparse point, and how far away that is (scene units)."""

    row: Int[np.ndarray, "n"]
    column: Int[np.ndarray, "n"]
    distance: Float[np.ndarray, "n"]

    def disagreement(self, depth: DepthMap) -> Float[np.ndarray, "n"]:
        """|distance / that of the sparse point - 1|; NaN where the pixel has no depth."""
        found = depth.distance[self.row, self.column]
        return np.where(found > 0, np.abs(found / np.maximum(self.distance, 1e-30) - 1), np.nan)


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


def plausible(depth: DepthMap, sparse: SparseDepths) -> DepthMap:
    """``depth`` without small patches and those that more sparse points contradict than support."""
    patch, count = _patches(depth.distance)
    off, of_points = sparse.disagreement(depth), patch[sparse.row, sparse.column]
    with np.errstate(invalid="ignore"):
        against, in_favour = (np.bincount(of_points[at], minlength=count) for at in (off > CONTRADICTS, off < SUPPORTS))
    sizes = np.bincount(patch.ravel(), weights=(depth.distance > 0).ravel(), minlength=count)
    kept = ((sizes >= MIN_PATCH_PIXELS) & (in_favour >= against))[patch]
    return DepthMap(*(np.where(kept, each, 0).astype(each.dtype) for each in depth))


def _patches(distance: Float[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "h w"], int]:
    """The number of each pixel's patch, and how many there are; pixels that are not known are each one of their own."""
    pixel = np.arange(distance.size).reshape(distance.shape)
    joined = []
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        nearer = np.minimum(distance[one], distance[other])
        same = (nearer > 0) & (np.abs(distance[one] - distance[other]) < MAX_STEP * nearer)
        joined.append(np.stack([pixel[one][same], pixel[other][same]]))
    edges = np.concatenate(joined, axis=1)
    graph = coo_matrix((np.ones(edges.shape[1], bool), edges), (distance.size, distance.size))
    count, patch = connected_components(graph, directed=False)
    return patch.reshape(distance.shape), count
