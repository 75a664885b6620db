"""Models of imported poses: points that verified matches tell at these, and poses or intrinsics adjusted to
them. Call it in a worker process."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from nerf.geometry.alignment import align_poses
from stages.sfm.colmap.adjustment.bundle_adjustment import adjustment_options, bundle_adjust
from stages.sfm.colmap.adjustment.observations import noise_px, observations
from stages.sfm.colmap.database.copies import copy_with_cameras_of
from stages.sfm.colmap.mappers import pipeline_options
from stages.sfm.colmap.models import load_native, read_model, write_model, write_native

MAX_ERROR_MULTIPLE = 5.0  # of the median error of imported poses: observations that are farther off do not count
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # what OPENCV has more parameters than


def triangulate(
    sparse: Path, database: Path, images: Path, target: Path, excluded: Collection[int], limit_px: float
) -> int:
    """Write to the folder ``target`` the model in ``sparse``, with the database's image ids, with the points that
    verified matches tell at its poses, which stay, as its cameras do; observations are at most ``limit_px`` off. The
    images ``excluded`` (ids) take no part. The number of points; nothing is written where there are none.
    """
    model = load_native(sparse)
    for image_id in excluded:
        model.deregister_frame(model.image(image_id).frame_id)
    if model.num_reg_images() > 1:
        model = triangulated(model, database, images, limit_px)
    if model.num_points3D():
        write_native(target, model)
    return model.num_points3D()


def adjust_poses(sparse: Path, database: Path, images: Path, target: Path, error_px: float, limit_px: float) -> bool:
    """Write to the folder ``target`` the model in ``sparse``, with the database's image ids, its poses adjusted to the
    verified matches; ``error_px``: their median error at the given poses, ``limit_px``: that of an observation at most,
    in the end. Cameras stay, and so does the frame: a similarity lays the new poses on the given ones. Photos without
    observations keep theirs. False, and nothing is written, where the matches tell no points at these poses.
    """
    given, model = read_model(sparse), _at_unit_size(load_native(sparse))
    for limit in (max(MAX_ERROR_MULTIPLE * error_px, limit_px), limit_px):
        model = triangulated(model, database, images, limit, colours=False)
        if not model.num_points3D():
            return False
        bundle_adjust(model, set(model.cameras), adjustment_options(False, noise_px(model, observations(model))))
    adjusted = {
        model.image(i).name: model.image(i).cam_from_world().inverse().matrix()
        for i in model.reg_image_ids()
        if model.image(i).num_points3D
    }
    before = {image.file: image.sfm_from_camera for image in given.images}
    back = align_poses(np.array(list(adjusted.values())), np.array([before[name] for name in adjusted]))
    poses = before | {name: back.pose(pose) for name, pose in adjusted.items()}
    write_model(target, replace(given, images=[replace(i, sfm_from_camera=poses[i.file]) for i in given.images]))
    return True


def adjust_intrinsics(
    sparse: Path, database: Path, images: Path, target: Path, error_px: float, limit_px: float
) -> bool:
    """As :func:`adjust_poses`, but poses stay and intrinsics are adjusted, of perspective cameras with OPENCV's
    distortion."""
    model = load_native(sparse)
    for camera in model.cameras.values():
        if camera.model_name in PERSPECTIVE:
            params = dict(zip(camera.params_info.split(", "), camera.params, strict=True))
            focal = [params.get(name, params.get("f")) for name in ("fx", "fy")]
            radial = [params.get("k1", params.get("k", 0.0)), params.get("k2", 0.0)]
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [*focal, params["cx"], params["cy"], *radial, 0.0, 0.0]
    limit = max(MAX_ERROR_MULTIPLE * error_px, limit_px)
    model = triangulated(model, database, images, limit, colours=False)
    if not model.num_points3D():
        return False
    adjustment = adjustment_options(True, noise_px(model, observations(model)))
    bundle_adjust(model, set(), adjustment, constant_poses=True)
    write_native(target, model)
    return True


def triangulated(
    model: pycolmap.Reconstruction, database: Path, images: Path, limit_px: float, colours: bool = True
) -> pycolmap.Reconstruction:
    """The model, with the database's image ids, with points at its poses; observations are at most ``limit_px`` off."""
    options = pipeline_options(0)
    options.extract_colors = colours
    options.mapper.filter_max_reproj_error = limit_px
    options.triangulation.complete_max_reproj_error = limit_px
    options.triangulation.merge_max_reproj_error = limit_px
    with TemporaryDirectory(dir=database.parent) as scratch:
        own = Path(scratch, "database.db")
        copy_with_cameras_of(model, database, own)
        return pycolmap.triangulate_points(model, own, images, scratch, options=options)


def _at_unit_size(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model about its middle, so large that its cameras are a unit from there in the median: numbers of map
    projections are too large to be adjusted."""
    centres = np.array([model.image(i).projection_center() for i in model.reg_image_ids()])
    middle = np.median(centres, axis=0)
    size = float(np.median(np.linalg.norm(centres - middle, axis=1))) or 1.0
    model.transform(pycolmap.Sim3d(1 / size, pycolmap.Rotation3d(np.eye(3)), -middle / size))
    return model
