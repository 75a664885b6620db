"""Sparse models on disk, in COLMAP's own files."""

import errno
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

from stages.contract import StageError
from stages.io.colmap_files import NO_POINT, read_model_files
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import native, pixel_map, plain, turned_camera, turned_pose

# At most, in COLMAP's binary files: a feature with its part of a track, a point, a photo with its name; and the rest.
BYTES_PER_PLACE, BYTES_PER_POINT, BYTES_PER_IMAGE, FIXED_BYTES = 32, 51, 1024, 1 << 16


def read_model(sparse: Path) -> SparseModel:
    """Read a COLMAP model (binary or text). Raises StageError if it is damaged."""
    try:
        files = read_model_files(sparse)
    except (ValueError, OverflowError, OSError) as error:
        raise StageError(
            "sfm.damaged-model",
            f"cannot read the COLMAP model in {sparse}",
            str(error),
            "Correct it or export the model again; or leave out the cameras to find them from the photos.",
        ) from error
    camera_ids = sorted(files.cameras)
    images = sorted(files.images.values(), key=lambda image: image.name)
    point_ids = np.array(sorted(files.points), np.int64)
    points = [files.points[i] for i in point_ids.tolist()]
    seen = [image.points != NO_POINT for image in images]
    return SparseModel(
        cameras=[files.cameras[i] for i in camera_ids],
        images=[SparseImage(i.name, camera_ids.index(i.camera), world_from_camera(i.pose)) for i in images],
        xyz=np.array([p.xyz for p in points]).reshape(-1, 3),
        rgb=np.array([p.rgb for p in points], np.uint8).reshape(-1, 3),
        error_px=np.array([p.error_px for p in points], float),
        view=np.repeat(np.arange(len(images)), [int(s.sum()) for s in seen]),
        point=np.searchsorted(point_ids, _joined([i.points[s] for i, s in zip(images, seen, strict=True)], (0,))),
        xy=_joined([i.xy[s] for i, s in zip(images, seen, strict=True)], (0, 2)),
    )


def _joined(parts: list[np.ndarray], empty: tuple[int, ...]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros(empty)


def world_from_camera(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "3 4"]:
    """The inverse of COLMAP's camera_from_world, (qw, qx, qy, qz, tx, ty, tz), whose quaternion is normalised."""
    quaternion = pose[:4] / np.abs(pose[:4]).max()  # first, or the square of a tiny one is zero
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.concatenate([rotation, -(rotation @ pose[4:])[:, None]], axis=1)


def load_native(sparse: Path) -> pycolmap.Reconstruction:
    """A model that this program wrote, as COLMAP has it."""
    return pycolmap.Reconstruction(sparse)


def turned_upright(model: pycolmap.Reconstruction, turns: Mapping[str, int]) -> pycolmap.Reconstruction:
    """The model with these images (by name), their cameras and poses turned by so many quarter turns clockwise. Images
    that were turned by different amounts get cameras of their own."""
    new, camera_ids = pycolmap.Reconstruction(), dict[tuple[int, int], int]()
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        before, by = plain(model.camera(image.camera_id)), turns.get(image.name, 0)
        camera, key = turned_camera(before, by), (image.camera_id, by)
        if key not in camera_ids:
            camera_ids[key] = len(camera_ids) + 1
            new.add_camera_with_trivial_rig(native(camera, camera_ids[key]))
        places = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        places = (
            np.c_[places, np.ones(len(places))]
            @ pixel_map((before.width, before.height), by, camera.width, camera.height).T
        )
        points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in places])
        entry = pycolmap.Image(name=image.name, camera_id=camera_ids[key], image_id=image_id, points2D=points2D)
        pose = turned_pose(image.cam_from_world().inverse().matrix(), by)
        new.add_image_with_trivial_frame(entry, pycolmap.Rigid3d(pose).inverse())
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        new.add_point3D(point.xyz, point.track, point.color)
    new.update_point_3d_errors()
    return new


def write_native(sparse: Path, model: pycolmap.Reconstruction) -> None:
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
