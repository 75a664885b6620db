"""Sparse models on disk, in COLMAP's own files."""

import errno
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.colmap.cameras import native, plain
from stages.contract import StageError
from stages.sparse_model import SparseImage, SparseModel

if TYPE_CHECKING:
    import pycolmap


# At most, in COLMAP's binary files: a feature with its part of a track, a point, a photo with its name; and the rest.
BYTES_PER_PLACE, BYTES_PER_POINT, BYTES_PER_IMAGE, FIXED_BYTES = 32, 51, 1024, 1 << 16


def read_model(sparse: Path) -> SparseModel:
    """Read a COLMAP model (binary or text). Raises StageError if it is damaged."""
    import pycolmap

    try:
        model = pycolmap.Reconstruction(sparse)
    except (ValueError, RuntimeError, LookupError, OSError) as error:
        raise StageError(
            f"cannot read the COLMAP model in {sparse.name}", str(error), "Check that it is a complete COLMAP model."
        ) from error
    camera_ids = sorted(model.cameras)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    point_ids = np.array(sorted(model.point3D_ids()), np.int64)
    points = [model.point3D(i) for i in point_ids]
    seen = [image.get_observation_points2D() for image in images]
    return SparseModel(
        cameras=[plain(model.camera(i)) for i in camera_ids],
        images=[
            SparseImage(i.name, camera_ids.index(i.camera_id), i.cam_from_world().inverse().matrix()) for i in images
        ],
        xyz=np.array([p.xyz for p in points]).reshape(-1, 3),
        rgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        error_px=np.array([p.error for p in points], float),
        view=np.repeat(np.arange(len(images)), [len(s) for s in seen]),
        point=np.searchsorted(point_ids, np.array([p.point3D_id for s in seen for p in s], np.int64)),
        xy=np.array([p.xy for s in seen for p in s], float).reshape(-1, 2),
    )


def load_native(sparse: Path) -> "pycolmap.Reconstruction":
    """A model that this program wrote, as COLMAP has it."""
    import pycolmap

    return pycolmap.Reconstruction(sparse)


def write_native(sparse: Path, model: "pycolmap.Reconstruction") -> None:
    """Write ``model`` as COLMAP's binary files. Raises OSError where the disk has no room: COLMAP itself would leave
    files that end in the middle, and say nothing."""
    sparse.mkdir(parents=True, exist_ok=True)
    places = sum(image.num_points2D() for image in map(model.image, model.reg_image_ids()))
    needed = BYTES_PER_PLACE * places + BYTES_PER_POINT * model.num_points3D() + BYTES_PER_IMAGE * model.num_images()
    if shutil.disk_usage(sparse).free < needed + FIXED_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(sparse))
    model.write_binary(sparse)


def write_model(sparse: Path, model: SparseModel) -> None:
    """The inverse of :func:`read_model`: standard binary files. Points are numbered anew, errors computed anew."""
    import pycolmap

    new = pycolmap.Reconstruction()
    for index, camera in enumerate(model.cameras):
        new.add_camera_with_trivial_rig(native(camera, index + 1))
    tracks = [pycolmap.Track() for _ in model.xyz]
    begins = np.searchsorted(model.view, np.arange(len(model.images) + 1))
    for index, image in enumerate(model.images):
        mine = slice(begins[index], begins[index + 1])
        for keypoint, point in enumerate(model.point[mine]):
            tracks[point].add_element(index + 1, keypoint)
        places = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in model.xy[mine]])
        entry = pycolmap.Image(name=image.file, camera_id=image.camera + 1, image_id=index + 1, points2D=places)
        new.add_image_with_trivial_frame(entry, pycolmap.Rigid3d(image.sfm_from_camera).inverse())
    for xyz, rgb, track in zip(model.xyz, model.rgb, tracks, strict=True):
        new.add_point3D(xyz, track, rgb)
    new.update_point_3d_errors()
    write_native(sparse, new)
