"""The similarity between two sets of points, or of camera poses, that belong together."""

import numpy as np
from jaxtyping import Float

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


def align_poses(poses: Float[np.ndarray, "n 3 4"], targets: Float[np.ndarray, "n 3 4"]) -> Similarity:
    """The similarity that brings camera poses, world_from_camera, closest to others of the same cameras.

    The rotation is that of the orientations (their mean by singular value decomposition), scale and translation follow
    from the centres: so it is determined for cameras on a line, too. Poses that are three times as far off as the
    median one, in angle or place, do not count. The scale is 1 where all cameras stand in one place.
    """
    used = np.ones(len(poses), bool)
    for _ in range(2):
        found = _aligned(poses[used], targets[used])
        trace = np.einsum("ij,njk,nik->n", found.rotation, poses[:, :, :3], targets[:, :, :3])
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        distance = np.linalg.norm(found.points(poses[:, :, 3]) - targets[:, :, 3], axis=1)
        used = np.all([off <= MAX_DEVIATION * np.median(off) for off in (angle, distance)], axis=0)
    return _aligned(poses[used], targets[used])


def _aligned(poses: Float[np.ndarray, "n 3 4"], targets: Float[np.ndarray, "n 3 4"]) -> Similarity:
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", targets[:, :, :3], poses[:, :, :3]))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    middle, target_middle = (each[:, :, 3].mean(axis=0) for each in (poses, targets))
    offsets, target_offsets = (poses[:, :, 3] - middle) @ rotation.T, targets[:, :, 3] - target_middle
    size = (offsets**2).sum()
    scale = float((offsets * target_offsets).sum() / size) if size > 0 else 1.0
    scale = scale if scale > 0 else 1.0
    return Similarity(scale, rotation, target_middle - scale * rotation @ middle)
