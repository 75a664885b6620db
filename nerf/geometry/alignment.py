"""The similarity between two sets of points that belong together."""

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Similarity

FLAT = 1e-9  # of the largest singular value: less across a line is the rounding of its points, not an extent


def align(points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"]) -> Similarity:
    """The similarity that brings ``points`` closest to ``targets`` in the sense of least squares, never a reflection.

    Umeyama 1991, equations 40 to 42. Raises ValueError for fewer than three points or points on one line, which
    leave the rotation open.
    """
    middle, target_middle = points.mean(0), targets.mean(0)
    offsets, target_offsets = points - middle, targets - target_middle
    u, singular, vt = np.linalg.svd(target_offsets.T @ offsets / len(points))
    if len(points) < 3 or not singular[1] > FLAT * singular[0]:
        raise ValueError(f"{len(points)} points on one line fit in more than one way")
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * proper) @ vt
    scale = float((singular * proper).sum() / offsets.var(0).sum())
    return Similarity(scale, rotation, target_middle - scale * rotation @ middle)
