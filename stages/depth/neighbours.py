"""Which photos are matched with which, and between which depths.

A good neighbour sees the same points from a direction that differs by enough to tell their distance and by little
enough that they look the same. As in OpenMVS and MVSNet (Yao et al. 2018), each shared point counts by the angle
between the two rays to it; the sum ranks the photos. Neighbours of a photo should not all lie on one side of it: what
the one cannot see, hidden behind an edge, the others cannot see either, and no depth is kept that only one pair tells.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from nerf import REGION_HALF_SIZE
from nerf.geometry.scene import Scene, View
from stages.sfm.colmap.cameras import project

BEST_ANGLE_DEG = 7.0  # of a pair: below it the distance, above it the match gets uncertain
NARROW_DEG, WIDE_DEG = 3.0, 10.0  # deviations of the weight below and above the best angle
MIN_ANGLE_DEG = 0.5  # below it a pixel is a tenth of the distance
MAX_CANDIDATES = 24  # photos of which the angles at all shared points are asked
MIN_SHARED = 8.0  # weighted points
SAME_SIDE, SAME_SIDE_COSINE = 0.5, 0.5  # weight of a candidate on the same side as a neighbour chosen already
GRID = 9  # points along each side of the region that stand for tracks where there are none
FEW_POINTS = 20  # in a photo: below it near and far tell the range of depths
QUANTILE = 0.005
NEARER, FARTHER = 0.8, 1.6  # of the nearest and farthest point: bare surfaces carry none


class Tracks(NamedTuple):
    """Points (m, 3) in the scene's frame, and observations: ``view[k]`` of the given views sees ``point[k]``."""

    points: Float[np.ndarray, "m 3"]
    view: Int[np.ndarray, "k"]
    point: Int[np.ndarray, "k"]

    def sees(self, views: int) -> csr_matrix:
        """(views, m): 1 where a view sees a point."""
        ones = np.ones(len(self.view), np.float32)
        return csr_matrix((ones, (self.view, self.point)), (views, len(self.points)))

    def shared(self, views: int) -> csr_matrix:
        """(views, views): how many points two views share."""
        sees = self.sees(views)
        return (sees @ sees.T).tocsr()


def tracks_of(scene: Scene, views: Sequence[int], points: Mapping[str, np.ndarray]) -> Tracks:
    """What the ``views`` (indices into the scene's) see of the sparse points; of a grid of points in the region of
    interest where there are no tracks, as with imported poses of photos with alpha."""
    number = np.full(len(scene.views), -1)
    number[list(views)] = np.arange(len(views))
    view = number[points["view"]]
    if (view >= 0).any():
        return Tracks(points["xyz"].astype(float), view[view >= 0], points["point"][view >= 0].astype(int))
    axis = np.linspace(-REGION_HALF_SIZE, REGION_HALF_SIZE, GRID)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = [np.flatnonzero(_within(scene, scene.views[index], grid)) for index in views]
    return Tracks(
        grid, np.repeat(np.arange(len(seen)), [len(s) for s in seen]), np.concatenate([*seen, np.zeros(0, int)])
    )


def _within(scene: Scene, view: View, points: Float[np.ndarray, "m 3"]) -> np.ndarray:
    camera, pose = scene.cameras[view.camera], view.scene_from_camera
    at = project(camera, (points - pose[:, 3]) @ pose[:, :3])
    return np.all((at > 0) & (at < [camera.width, camera.height]), axis=1)


def choose_pairs(
    poses: Float[np.ndarray, "n 3 4"], tracks: Tracks, neighbours: int, usable: Callable[[int, int], bool]
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of photos to be matched, in order of the photos that need them: of each photo its best
    ``neighbours`` of those with which it is a ``usable`` pair."""
    sees, shared = tracks.sees(len(poses)), tracks.shared(len(poses))
    chosen: dict[tuple[int, int], None] = {}
    for photo in range(len(poses)):
        candidates = _candidates(photo, shared[photo].toarray()[0], poses, tracks.points[sees[photo].indices])
        weights = {other: _weight(photo, other, poses, tracks, sees) for other in candidates}
        for other in _best(photo, weights, poses, neighbours, usable):
            chosen.setdefault((min(photo, other), max(photo, other)))
    return list(chosen)


def _candidates(photo: int, shared: np.ndarray, poses: np.ndarray, seen: np.ndarray) -> list[int]:
    """The MAX_CANDIDATES photos that look best by how many points they share and by the angle at the middle of those
    that the photo sees."""
    if not len(seen):
        return []
    towards = poses[:, :, 3] - np.median(seen, axis=0)
    others = np.flatnonzero((shared >= MIN_SHARED) & (np.arange(len(poses)) != photo))
    likely = shared[others] * _by_angle(np.broadcast_to(towards[photo], (len(others), 3)), towards[others])
    return [int(other) for other in others[np.argsort(-likely, kind="stable")[:MAX_CANDIDATES]]]


def _best(
    photo: int, weights: dict[int, float], poses: np.ndarray, neighbours: int, usable: Callable[[int, int], bool]
) -> list[int]:
    """The best neighbours of a photo, the best first."""
    left = {other: weight for other, weight in weights.items() if weight >= MIN_SHARED}
    towards = {other: poses[other, :, 3] - poses[photo, :, 3] for other in left}
    towards = {other: way / max(float(np.linalg.norm(way)), 1e-30) for other, way in towards.items()}
    best: list[int] = []
    while left and len(best) < neighbours:
        other = max(left, key=lambda one: (left[one], -one))
        del left[other]
        if not usable(min(photo, other), max(photo, other)):
            continue
        best.append(other)
        for one in left:
            if towards[one] @ towards[other] > SAME_SIDE_COSINE:
                left[one] *= SAME_SIDE
    return best


def _weight(photo: int, other: int, poses: np.ndarray, tracks: Tracks, sees: csr_matrix) -> float:
    """The sum over the points that two photos share, each by the angle between the rays to it."""
    both = tracks.points[sees[photo].multiply(sees[other]).indices]
    return float(_by_angle(both - poses[photo, :, 3], both - poses[other, :, 3]).sum())


def _by_angle(rays: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """How much points count by the angle between the rays to them."""
    lengths = np.linalg.norm(rays, axis=1) * np.linalg.norm(others, axis=1)
    cosine = np.einsum("ni,ni->n", rays, others) / np.maximum(lengths, 1e-30)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    off = angle - BEST_ANGLE_DEG
    weight = np.exp(-0.5 * (off / np.where(off < 0, NARROW_DEG, WIDE_DEG)) ** 2)
    return np.where(angle < MIN_ANGLE_DEG, 0, weight)


def depth_range(
    poses: Float[np.ndarray, "n 3 4"],
    points: Float[np.ndarray, "m 3"],
    sees: csr_matrix,
    pair: tuple[int, int],
    views: Sequence[View],
) -> tuple[float, float]:
    """The nearest and the farthest depth at which a pair's photos may show anything, along the mean of their axes: that
    of the ``points`` that either ``sees`` (:meth:`Tracks.sees`), with room for what carries none; by near and far where
    there are few points."""
    seen = np.union1d(*(sees[index].indices for index in pair))
    axis = poses[list(pair), :, 2].sum(axis=0)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    depths = (points[seen] - poses[list(pair), :, 3].mean(axis=0)) @ axis
    depths = depths[depths > 0]
    if len(depths) < FEW_POINTS:
        return min(views[index].near for index in pair), max(views[index].far for index in pair)
    nearest, farthest = np.quantile(depths, [QUANTILE, 1 - QUANTILE])
    return NEARER * float(nearest), FARTHER * float(farthest)
