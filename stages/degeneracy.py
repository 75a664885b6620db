"""What a set of photos lacks when no depth can be had from it: a turn of the camera on the spot, or one flat surface.

Two photos taken from one place, or of one plane, are related by a homography H (Hartley and Zisserman 2004, ch. 13).
From one place it is H = K R K⁻¹, so with the right focal length K⁻¹ H K is a rotation; for a plane at distance d with
normal n and a camera that moved by t it is R + t nᵀ/d, and no rotation.
"""

import numpy as np
from jaxtyping import Float, Int

# A step of 2 % of the distance to the plane makes K⁻¹ H K differ so much from a rotation; half a pixel of noise in
# photos of 300 pixels, a tenth of it.
LIKE_A_ROTATION = 0.02
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


def count_turns(homographies: Float[np.ndarray, "pairs 3 3"], sizes: Int[np.ndarray, "pairs 2 2"]) -> int:
    """How many of the pairs are turns of the camera on the spot, with the one focal length that makes most of them so.

    One for all: with a focal length of its own, many a plane seen twice would pass for a turn.
    """
    if not len(homographies):
        return 0
    return max(
        int((departure_from_rotation(homographies, sizes, focal) < LIKE_A_ROTATION).sum()) for focal in FOCAL_LENGTHS
    )
