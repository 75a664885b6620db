"""How large a square is that several posed photos show: its side in the units of the poses, with a standard error.

The square is fitted as a whole, by its side, place and orientation (7 numbers), to the corners in all photos, in
pixels. Errors of the poses are common to the four corners of a photo, so the standard error is by the jackknife over
photos (Efron and Stein 1981), and no less than what the residuals alone tell.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from nerf.geometry.alignment import align

UNIT_SQUARE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
TOLERANCE = 0.1  # of its side in a photo: a corner farther off belongs to another square
MAX_PAIRS = 200  # of photos that propose where the square is
HUBER_PX = 1.0
GROUPS = 20  # of photos, each left out once


class CornerObservations(NamedTuple):
    """A square in n photos: ``camera_from_world`` [R | t], the corners as x/z, y/z of their ray directions, and what a
    unit of these is in pixels."""

    camera_from_world: Float[np.ndarray, "n 3 4"]
    corners: Float[np.ndarray, "n 4 2"]
    focal_px: Float[np.ndarray, "n"]

    def of(self, which: Bool[np.ndarray, "n"]) -> "CornerObservations":
        """Those of some photos."""
        return CornerObservations(*(each[which] for each in self))


class Square(NamedTuple):
    """``side`` and its ``standard_error``, ``corners`` (4, 3), how far they are from a square where each is located by
    itself (the largest ratio of its sides and diagonals, less 1), and which photos agree about where it is."""

    side: float
    standard_error: float
    corners: Float[np.ndarray, "4 3"]
    irregularity: float
    agreeing: Bool[np.ndarray, "n"]


def fit_square(seen: CornerObservations) -> Square | None:
    """The square that most photos agree on; None where no two do."""
    agreeing = _largest_agreement(seen)
    if agreeing.sum() < 2:
        return None
    inliers = seen.of(agreeing)
    points = triangulate(inliers)
    start = align(UNIT_SQUARE, points)
    parameters = np.concatenate(
        [Rotation.from_matrix(start.rotation).as_rotvec(), start.translation / start.scale, [np.log(start.scale)]]
    )
    solved = _solve(inliers, parameters)
    sides = [*np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)]
    sides += [np.linalg.norm(points[i] - points[i + 2]) / np.sqrt(2) for i in (0, 1)]
    relative = max(_error_by_residuals(solved), _error_by_jackknife(inliers, solved.x))
    side = float(np.exp(solved.x[6]))
    return Square(side, side * relative, _corners(solved.x), float(max(sides) / min(sides)) - 1, agreeing)


def triangulate(seen: CornerObservations) -> Float[np.ndarray, "4 3"]:
    """Each corner by itself: the point with the least algebraic error (Hartley and Zisserman 2004, section 12.2)."""
    rows = seen.corners[..., None] * seen.camera_from_world[:, None, None, 2] - seen.camera_from_world[:, None, :2]
    equations = rows.transpose(1, 0, 2, 3).reshape(4, -1, 4)
    solution, *_ = zip(
        *(np.linalg.lstsq(corner[:, :3], -corner[:, 3], rcond=None) for corner in equations), strict=True
    )
    return np.array(solution)


def _largest_agreement(seen: CornerObservations) -> Bool[np.ndarray, "n"]:
    """The photos that agree with the place that two of them tell, for the two with which most agree."""
    count = len(seen.focal_px)
    best = np.zeros(count, bool)
    pairs = list(combinations(range(count), 2))
    perimeter = np.linalg.norm(seen.corners - np.roll(seen.corners, 1, axis=1), axis=2).sum(axis=1)
    for pair in pairs[:: -(-len(pairs) // MAX_PAIRS)] if pairs else ():
        points = triangulate(seen.of(np.isin(np.arange(count), pair)))
        off = np.linalg.norm(_projected(points, seen) - seen.corners, axis=2).max(axis=1)
        agreeing = off < TOLERANCE * perimeter / 4  # NaN, behind a camera, is no agreement
        if agreeing.sum() > best.sum():
            best = agreeing
    return best


def _projected(points: Float[np.ndarray, "4 3"], seen: CornerObservations) -> Float[np.ndarray, "n 4 2"]:
    """x/z, y/z in each photo; NaN behind it."""
    rotation, translation = seen.camera_from_world[:, :, :3], seen.camera_from_world[:, :, 3]
    in_camera = points @ rotation.transpose(0, 2, 1) + translation[:, None]
    depth = np.where(in_camera[..., 2:] > 0, in_camera[..., 2:], np.nan)
    return in_camera[..., :2] / depth


def _corners(parameters: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 3"]:
    """Rotation vector, centre in sides, logarithm of the side."""
    turned = UNIT_SQUARE @ Rotation.from_rotvec(parameters[:3]).as_matrix().T
    return np.exp(parameters[6]) * (turned + parameters[3:6])


def _solve(seen: CornerObservations, start: Float[np.ndarray, "7"]):
    def residuals(parameters: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        off = (_projected(_corners(parameters), seen) - seen.corners) * seen.focal_px[:, None, None]
        return np.where(np.isfinite(off), off, 1e3).ravel()

    return least_squares(residuals, start, loss="huber", f_scale=HUBER_PX, x_scale="jac")


def _error_by_residuals(solved) -> float:
    """The standard error of the logarithm of the side if residuals are independent."""
    freedom = max(1, len(solved.fun) - 7)
    variance = 2 * solved.cost / freedom
    try:
        return float(np.sqrt(variance * np.linalg.inv(solved.jac.T @ solved.jac)[6, 6]))
    except np.linalg.LinAlgError:
        return float("inf")


def _error_by_jackknife(seen: CornerObservations, start: Float[np.ndarray, "7"]) -> float:
    """The standard error of the logarithm of the side by leaving out one group of photos after the other; 0 for two
    photos, of which one alone tells no size."""
    count = len(seen.focal_px)
    if count < 3:
        return 0.0
    group = np.arange(count) % min(count, GROUPS)
    logs = np.array([_solve(seen.of(group != left_out), start).x[6] for left_out in range(group.max() + 1)])
    return float(np.sqrt((len(logs) - 1) * logs.var()))
