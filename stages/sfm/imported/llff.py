"""LLFF's ``poses_bounds.npy``: cameras of the photos of a folder in order of their names (Mildenhall et al. 2019).

A row per photo: a 3 × 5 matrix, row by row, and the nearest and farthest depth. The matrix has world_from_camera with
axes (down, right, backward), the place, and height, width and focal length in pixels.
https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Camera
from stages.io.photos import Photo
from stages.io.sparse_model import SparseModel
from stages.sfm.imported.conventions import PoseConvention, world_from_camera
from stages.sfm.imported.imported_poses import ImportedPoses, notes_on_photos
from stages.sfm.imported.orientation import fits_only_upright
from stages.sfm.imported.posed_photos import distinct, posed_photo, unusable, without_rays
from stages.sfm.imported.rotations import rigid

ROW = 17
# From LLFF's camera axes, down, right and backward, to OpenCV's, right, down and forward.
LLFF_FROM_OPENCV = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class LlffCamera(NamedTuple):
    """A pinhole camera with its principal point in the middle, and its pose with OpenCV axes, not yet checked to be a
    rotation."""

    camera: Camera
    world_from_camera: Float[np.ndarray, "3 4"]


def read_llff_poses(
    file: Path, photos: Sequence[Photo], rows: Mapping[str, str], convention: PoseConvention
) -> ImportedPoses:
    """Poses of a file; ``rows`` maps the place of a row, from 0, to a photo's name. Raises StageError."""
    try:
        given = read_llff(file)
    except (OSError, ValueError) as error:
        raise unusable("sfm.llff-unreadable", file.name, str(error)) from error
    if len(given) != len(rows):
        why = f"it has {len(given)} rows for {len(rows)} photos; it needs one row for each photo"
        raise unusable("sfm.llff-count", file.name, why)
    by_name = {photo.name: photo for photo in photos}
    of = [(by_name[name], given[int(row)]) for row, name in rows.items() if name in by_name]
    upright = any(fits_only_upright(one.camera, photo) for photo, one in of)
    posed = []
    for photo, one in sorted(of, key=lambda pair: pair[0].image_name):
        where = f"the row of {file.name} for {photo.name!r}"
        matrix, _ = rigid(one.world_from_camera, where)
        pose = world_from_camera(matrix, convention)
        posed.append(posed_photo(photo, photo.name, where, one.camera, pose, upright))
    left_out = without_rays(posed)
    model = SparseModel.without_points(*distinct([one for one in posed if one.file not in left_out]))
    unposed = by_name.keys() - rows.values()  # decoded whatever they are called
    return ImportedPoses(model, left_out, None, notes_on_photos((), unposed, posed, left_out))


def read_llff(file: Path) -> list[LlffCamera]:
    """The cameras of all photos. Raises OSError, and ValueError with the reason."""
    try:
        with file.open("rb") as stream:
            rows = np.lib.format.read_array(stream)  # as np.load, but for pickles, which run code
    except (ValueError, EOFError, OverflowError, MemoryError) as error:
        raise ValueError(f"it is no NumPy array ({error})") from error
    if not (rows.ndim == 2 and rows.shape[1] == ROW and rows.dtype.kind in "fiu"):
        shape = " × ".join(map(str, rows.shape))
        raise ValueError(f"it holds {shape} instead of a row of {ROW} numbers for each photo")
    return [_camera(row, number) for number, row in enumerate(rows.astype(np.float64), 1)]


def _camera(row: Float[np.ndarray, "17"], number: int) -> LlffCamera:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    if not np.isfinite(matrix).all():
        raise ValueError(f"row {number} holds NaN or infinity")
    if not all(1 <= side < 2**31 and side.is_integer() for side in (height, width)):
        raise ValueError(f"row {number} says that the photo has {width:g} × {height:g} pixels")
    camera = Camera("PINHOLE", int(width), int(height), (focal, focal, width / 2, height / 2))
    return LlffCamera(camera, np.concatenate([matrix[:, :3] @ LLFF_FROM_OPENCV, matrix[:, 3:4]], axis=1))
