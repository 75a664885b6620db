"""Matrices of imported poses as rotations: rounded and scaled ones are set right, others are refused."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from stages.contract import StageError
from stages.io.colmap_files import MAX_COORDINATE
from stages.io.transforms_files import pose_matrix
from stages.sfm.imported.posed_photos import unusable

# The root mean square stretch of a matrix beside its scale, as an angle, is about what its rotation is off by where the
# numbers were rounded: 0.02° of three decimals, 0.2° of two. Beyond this a matrix is no rotation.
MAX_STRETCH_DEG = 0.05
MAX_ENTRY = 1e6  # of a matrix that is looked at more closely: products of three of them are numbers


class NearestRotation(NamedTuple):
    """The rotation nearest to a matrix, by which it ``scales``, and the ``stretch_deg`` that is left."""

    matrix: Float[np.ndarray, "3 3"]
    scale: float
    stretch_deg: float


def rigid(matrix: Any, where: str) -> tuple[Float[np.ndarray, "3 4"], NearestRotation]:
    """A matrix as it stands in a file, with the rotation that is nearest to it. Raises StageError, saying ``where``,
    for one that mirrors, shears or is not finite."""
    what = f"the transform_matrix of {where}"
    try:
        pose = pose_matrix(matrix)
    except ValueError as error:
        raise unusable("sfm.frame-pose", what, str(error)) from error
    if (distance := np.abs(pose[:, 3]).max()) > MAX_COORDINATE:
        why = f"its position is {distance:.3g} units from the origin; the limit is {MAX_COORDINATE:g}"
        raise unusable("sfm.pose-far-away", what, why)
    if not (largest := np.abs(pose[:, :3]).max()) <= MAX_ENTRY:
        raise unusable("sfm.pose-large-entry", what, f"it is no rotation: it holds {largest:.3g}")
    if np.linalg.det(pose[:, :3]) < 0:
        raise StageError(
            "sfm.pose-mirrors",
            f"cannot use {what}",
            "it mirrors (its determinant is negative): the world is left-handed, or one camera axis is reversed",
            "Negate one row of every matrix if the world is left-handed (Unity, Unreal), else the column of that axis.",
        )
    rotation = _nearest_rotation(pose[:, :3])
    if not rotation.stretch_deg <= MAX_STRETCH_DEG:
        off = f"its axes are off by {rotation.stretch_deg:.2g}°, and it scales by {rotation.scale:.4g}"
        why = f"it is no rotation: {off if rotation.scale > 0 else 'its determinant is 0'}"
        raise unusable("sfm.pose-no-rotation", what, why)
    return np.concatenate([rotation.matrix, pose[:, 3:]], axis=1), rotation


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> NearestRotation:
    """By singular values (Schönemann 1966); infinitely stretched where one of them is 0."""
    u, stretch, vt = np.linalg.svd(matrix)
    scale = float(np.cbrt(stretch.prod()))
    off = np.degrees(np.sqrt(np.mean((stretch / scale - 1) ** 2))) if scale > 0 else np.inf
    return NearestRotation(u @ vt, scale, float(off))
