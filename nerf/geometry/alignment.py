"""The similarity between two sets of points, or of camera poses, that belong together."""

import numpy as np
from jaxtyping import Float

from nerf.geometry.pose_distance import rotation_angles
from nerf.geometry.scene import Similarity

MAX_DEVIATION = 3.0  # of the median one: poses farther off do not count
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


def fit_poses(base: Float[np.ndarray, "photos 3 4"], piece: Float[np.ndarray, "photos 3 4"]) -> Similarity | None:
    """The similarity that brings poses (world from camera) of the same photos from one frame closest to the other:
    their mean rotation, then scale and translation between their centres by least squares. None where the centres fall
    together, which leaves the scale open.

    Photos on one line are enough, since their rotations tell how the pieces are turned around it.
    """
    rotation = _mean_rotation(base, piece)
    middle, turned = base[:, :, 3].mean(axis=0), piece[:, :, 3] @ rotation.T
    offsets, turned_offsets = base[:, :, 3] - middle, turned - turned.mean(axis=0)
    scale = float((offsets * turned_offsets).sum()) / max(float((turned_offsets**2).sum()), np.finfo(float).tiny)
    if not (np.isfinite(scale) and scale > 0):
        return None
    return Similarity(scale, rotation, middle - scale * turned.mean(axis=0))


def _mean_rotation(
    base: Float[np.ndarray, "photos 3 4"], piece: Float[np.ndarray, "photos 3 4"]
) -> Float[np.ndarray, "3 3"]:
    u, _, vt = np.linalg.svd((base[:, :, :3] @ piece[:, :, :3].transpose(0, 2, 1)).sum(axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def align_poses(poses: Float[np.ndarray, "n 3 4"], targets: Float[np.ndarray, "n 3 4"]) -> Similarity:
    """As :func:`fit_poses` brings ``poses`` to ``targets``, without those that are three times as far off as the median
    one, in angle or place. The scale is 1 where it is open."""
    used = np.ones(len(poses), bool)
    for _ in range(2):
        found = _fitted_at_any_scale(targets[used], poses[used])
        angle = rotation_angles(found.rotation @ poses[:, :, :3], targets[:, :, :3])
        distance = np.linalg.norm(found.points(poses[:, :, 3]) - targets[:, :, 3], axis=1)
        used = np.all([off <= MAX_DEVIATION * np.median(off) for off in (angle, distance)], axis=0)
    return _fitted_at_any_scale(targets[used], poses[used])


def _fitted_at_any_scale(base: Float[np.ndarray, "n 3 4"], piece: Float[np.ndarray, "n 3 4"]) -> Similarity:
    if found := fit_poses(base, piece):
        return found
    rotation = _mean_rotation(base, piece)
    return Similarity(1.0, rotation, base[:, :, 3].mean(axis=0) - rotation @ piece[:, :, 3].mean(axis=0))
