"""Reconstructions in memory whose lens is known exactly, for tests of its choice and of poses' uncertainty."""

import numpy as np
import pycolmap

from nerf.geometry.scene import Camera
from stages.sfm.colmap.adjustment.bundle_adjustment import adjustment_options
from stages.sfm.colmap.adjustment.intrinsics import set_camera_models
from stages.sfm.colmap.adjustment.observations import observations, points_in_camera, residuals
from stages.sfm.colmap.cameras import native

WIDTH, HEIGHT = 900, 600


def lens(model: str, *params: float) -> Camera:
    return Camera(model, WIDTH, HEIGHT, tuple(map(float, params)))


def look_at(centre: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """cam_from_world (3, 4) of a camera that looks at a place, turned about its axis."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)


def photographed(
    *cameras: Camera, seed: int = 0, photos: int = 10, points: int = 500, noise: float = 0.5, room: bool = False
) -> "pycolmap.Reconstruction":
    """Photos from around a cloud of points, or from inside it (``room``), as a model with true cameras and points.

    The cameras take turns. Where points were seen is off by Gaussian noise (deviation of a coordinate in pixels).
    """
    random = np.random.default_rng(seed)
    angle = 2.0 * np.arange(photos) / photos + random.normal(0, 0.05, photos)
    around = np.stack([np.cos(angle), np.sin(angle), random.uniform(0.1, 0.5, photos)], axis=1)
    centres, target = (0.7 * around, 3 * around) if room else (3 * around, np.zeros(3))
    xyz = random.uniform(-1, 1, (points, 3))
    if room:
        xyz *= 3 / np.abs(xyz).max(axis=1, keepdims=True)
    poses = [
        look_at(centre, aim + random.normal(0, 0.2, 3), roll)
        for centre, aim, roll in zip(centres, np.broadcast_to(target, centres.shape), angle % 0.7 * 2, strict=True)
    ]
    model = pycolmap.Reconstruction()
    for camera_id, camera in enumerate(cameras, start=1):
        model.add_camera_with_trivial_rig(native(camera, camera_id))
    tracks = [pycolmap.Track() for _ in xyz]
    for image_id, pose in enumerate(poses, start=1):
        camera = model.camera(1 + image_id % len(cameras))
        seen = np.asarray(camera.img_from_cam(xyz @ pose[:, :3].T + pose[:, 3]))
        seen = seen + random.normal(0, noise, seen.shape)
        inside = np.flatnonzero((seen > 0).all(axis=1) & (seen < (camera.width, camera.height)).all(axis=1))
        for keypoint, point in enumerate(inside):
            tracks[point].add_element(image_id, keypoint)
        places = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen[inside]])
        image = pycolmap.Image(
            name=f"{image_id:02d}.jpg", camera_id=camera.camera_id, image_id=image_id, points2D=places
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for place, track in zip(xyz, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(place, track)
    return model


def adjust(model: "pycolmap.Reconstruction", principal_point: bool = False, intrinsics: bool = True) -> None:
    """Bundle adjustment as the stage does it, for a noise of half a pixel."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    if not intrinsics:
        for camera_id in model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(adjustment_options(principal_point, 0.5), config, model).solve()


def mapped(truth: "pycolmap.Reconstruction", widest: float = 180.0) -> "pycolmap.Reconstruction":
    """What mapping would leave: SIMPLE_RADIAL, centred, without observations 4 px off or beyond an angle (degrees)."""
    model = pycolmap.Reconstruction(truth)
    for image_id, (mine, points) in points_in_camera(model, seen := observations(model)).items():
        off = np.degrees(np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2]))
        _drop(model, image_id, seen.point[mine][off > widest].tolist())
    set_camera_models(model, dict.fromkeys(model.cameras, "SIMPLE_RADIAL"))
    for _ in range(2):
        adjust(model)
        seen = observations(model)
        far = ~(np.linalg.norm(residuals(model, seen), axis=1) < 4)
        for image_id in np.unique(seen.image[far]).tolist():
            _drop(model, image_id, seen.point[far & (seen.image == image_id)].tolist())
    return model


def _drop(model: "pycolmap.Reconstruction", image_id: int, points: list[int]) -> None:
    """Delete what an image sees of these points, and points that it leaves with one observation."""
    for point_id in points:
        if model.exists_point3D(point_id):
            track = model.point3D(point_id).track.elements
            model.delete_observation(image_id, next(e.point2D_idx for e in track if e.image_id == image_id))
