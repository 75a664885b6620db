"""Degenerate sets of photos: pure rotation, a planar scene, forward motion, repeated structure.

Two photos taken from one position, or of one plane, are related by a homography H (Hartley and Zisserman 2004, ch. 13).
From one position it is H = K R K⁻¹, so with the right focal length K⁻¹ H K is a rotation; for a plane at distance d
with normal n and a camera that moved by t it is R + t nᵀ/d, and no rotation.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

# A step of 2 % of the distance to the plane makes K⁻¹ H K differ so much from a rotation; half a pixel of noise in
# photos of 300 pixels, a tenth of it.
MAX_ROTATION_DEPARTURE = 0.02
# Between two models of the same photos poses differ by less than a degree and a hundredth of the scene where both are
# right (docs/experiments/match_graph.md); repeated structure moves a photo by a facade, or a window.
MAX_ANGLE_DEG, MAX_OFFSET = 5.0, 0.05
MAX_PROPOSALS = 500
MAX_RADIAL_DEG, MIN_RADIAL_FRACTION = 15.0, 0.8
FOCAL_LENGTHS = np.geomspace(0.3, 6, 61)  # over the longer side: from 118 to 10 degrees


def departure_from_rotation(
    homographies: Float[np.ndarray, "pairs 3 3"], sizes: Int[np.ndarray, "pairs 2 2"], focal: float
) -> Float[np.ndarray, "pairs"]:
    """How far K⁻¹ H K is from a rotation, max |σ − 1| over its singular values, scaled to a determinant of 1.

    ``sizes``: width and height in pixels of both photos of a pair; ``focal`` over the longer side, the principal point
    in the middle. Infinite where H has no inverse.
    """
    far = np.full(len(homographies), np.inf)
    finite = np.isfinite(homographies).all(axis=(1, 2), keepdims=True)
    usable = np.linalg.det(np.where(finite, homographies, 0.0)) != 0
    first, second = (_calibration(sizes[usable, side], focal) for side in (0, 1))
    normalised = np.linalg.solve(second, homographies[usable] @ first)
    normalised /= np.cbrt(np.linalg.det(normalised))[:, None, None]
    far[usable] = np.abs(np.linalg.svd(normalised, compute_uv=False) - 1).max(axis=1)
    return far


def _calibration(size: Int[np.ndarray, "pairs 2"], focal: float) -> Float[np.ndarray, "pairs 3 3"]:
    matrix = np.zeros((len(size), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = focal * size.max(axis=1)
    matrix[:, :2, 2] = size / 2
    matrix[:, 2, 2] = 1
    return matrix


def count_pure_rotations(homographies: Float[np.ndarray, "pairs 3 3"], sizes: Int[np.ndarray, "pairs 2 2"]) -> int:
    """How many of the pairs are pure rotations, with the one focal length that makes most of them so.

    One for all: with a focal length of its own, many a plane seen twice would pass for a rotation.
    """
    if not len(homographies):
        return 0
    return max(
        int((departure_from_rotation(homographies, sizes, focal) < MAX_ROTATION_DEPARTURE).sum())
        for focal in FOCAL_LENGTHS
    )


# --- forward motion


def epipoles_inside(
    fundamental: Float[np.ndarray, "pairs 3 3"], sizes: Int[np.ndarray, "pairs 2 2"]
) -> Bool[np.ndarray, "pairs"]:
    """Whether the camera moves towards something visible: both epipoles, F e = 0 and Fᵀ e' = 0, lie in the photos.

    Around an epipole points have next to no parallax, whatever their depth. F maps points of the first photo to lines
    of the second; ``sizes``: width and height in pixels of both photos of a pair. False where F is zero.
    """
    inside = np.any(fundamental != 0, axis=(1, 2), keepdims=True)[:, 0, 0]
    for side, matrix in ((0, fundamental), (1, fundamental.transpose(0, 2, 1))):
        epipole = np.linalg.svd(matrix)[2][:, 2]
        epipole = epipole * np.where(epipole[:, 2:] < 0, -1, 1)
        limit = epipole[:, 2:] * sizes[:, side]
        inside &= ((epipole[:, :2] > 0) & (epipole[:, :2] < limit)).all(axis=1)
    return inside


def flow_is_radial(
    first: Float[np.ndarray, "matches 2"], second: Float[np.ndarray, "matches 2"], size: Int[np.ndarray, "2"]
) -> bool:
    """Whether most matches move straight away from one point of the picture, or towards it, as in forward motion with
    little rotation. For pairs that a homography explains, where the epipole is not defined.

    The point e is the one whose rays the offsets o at x cross least: min Σ (o × (x − e))² / |o|².
    """
    offsets = second - first
    length = np.linalg.norm(offsets, axis=1)
    moving = length > 0
    if moving.sum() < 2:
        return False
    across = np.stack([-offsets[moving, 1], offsets[moving, 0]], axis=1) / length[moving, None]
    focus, _, rank, _ = np.linalg.lstsq(across, (across * first[moving]).sum(axis=1), rcond=None)
    if rank < 2 or not ((focus > 0) & (focus < size)).all():
        return False
    rays = first[moving] - focus
    outwards = (rays * offsets[moving]).sum(axis=1)
    radial = np.abs(outwards) > np.cos(np.radians(MAX_RADIAL_DEG)) * np.linalg.norm(rays, axis=1) * length[moving]
    return max((radial & (outwards > 0)).mean(), (radial & (outwards < 0)).mean()) > MIN_RADIAL_FRACTION


# --- repeated structure


def different_poses(
    first: Float[np.ndarray, "photos 3 4"], second: Float[np.ndarray, "photos 3 4"], extent: float
) -> Bool[np.ndarray, "photos"]:
    """Which photos have other poses (from the camera) in the second model than in the first.

    They are compared after the similarity between the models on which most photos agree; every two photos propose one,
    or of many photos as many pairs as MAX_PROPOSALS, from all over the list. ``extent``: how far apart the first
    model's cameras are (root mean square). None of fewer than three photos.
    """
    best = np.zeros(len(first), bool)
    none = best.copy()
    if len(first) < 3:
        return none
    between = first[:, :, :3] @ second[:, :, :3].transpose(0, 2, 1)
    pairs = list(combinations(range(len(first)), 2))
    for pair in pairs[:: -(-len(pairs) // MAX_PROPOSALS)]:
        chosen = list(pair)
        u, _, vt = np.linalg.svd(between[chosen].sum(axis=0))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        step, other_step = (np.linalg.norm(np.diff(of[chosen, :, 3], axis=0)) for of in (first, second))
        if other_step == 0:
            continue
        moved = step / other_step * second[:, :, 3] @ rotation.T
        off = first[:, :, 3] - moved
        far = np.linalg.norm(off - off[chosen].mean(axis=0), axis=1) > MAX_OFFSET * extent
        cosine = (np.einsum("nij,ij->n", between, rotation) - 1) / 2
        agreeing = ~far & (cosine > np.cos(np.radians(MAX_ANGLE_DEG)))
        best = max(best, agreeing, key=np.sum)
    return ~best if best.any() else none  # they all are in one position: nothing to compare
