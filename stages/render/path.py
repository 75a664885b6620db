"""The cameras of the video: a path along the training photos, or cameras from a file."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerf.geometry import camera_paths
from nerf.geometry.camera_paths import levelled, nearest_rotations
from nerf.geometry.near_far import near_and_far_between_views
from nerf.geometry.rays import Rays, rays_of_view
from nerf.geometry.scene import Camera, Scene, Similarity
from stages.contract import StageError, bounded
from stages.io.transforms_export import OPENGL_FROM_OPENCV
from stages.io.transforms_files import pose_matrix, read_transforms
from stages.render.planning import MAX_GIVEN_FPS, PathKind
from stages.sfm.colmap.cameras import camera_rays, rescaled
from stages.sfm.imported.transforms_intrinsics import intrinsics_of, read_intrinsics

MAX_SIDE = 2**15  # pixels: four times as many as any screen has
MIN_FOCAL = 0.5  # in widths: a pinhole wider than 90 degrees stretches its corners
MIN_CAMERA_EXTENT = 1e-6  # scene units
TRIAL_FRAMES = 120  # of a path that may be unsuited
MAX_FOCAL_RATIO = 1.1  # between the longest and the shortest focal length of photos that are shown with one


@dataclass(frozen=True)
class CameraPath:
    """One camera, all of one size, and one pose ``scene_from_camera`` (frames, 3, 4) per frame; ``fps`` where the file
    that they come from has one."""

    cameras: tuple[Camera, ...]
    poses: np.ndarray
    fps: int | None = None

    def resized(self, width: int) -> "CameraPath":
        """The same views, ``width`` pixels wide; width and height even."""
        return replace(self, cameras=tuple(resized(camera, width) for camera in self.cameras))

    def select(self, frames: Sequence[int]) -> "CameraPath":
        """Only these frames."""
        return CameraPath(tuple(self.cameras[i] for i in frames), self.poses[list(frames)])


def path_rays(path: CameraPath, scene: Scene) -> Iterator[Rays]:
    """The rays (height, width) of every frame, on the CPU; near and far are those of the photos around it."""
    views = scene.of_split("train")
    near, far = near_and_far_between_views(
        path.poses,
        np.stack([view.scene_from_camera[:, 3] for view in views]),
        np.array([view.near for view in views]),
        np.array([view.far for view in views]),
        scene.bounded,
    )
    ray_directions = last = None
    for index, camera in enumerate(path.cameras):
        if ray_directions is None or camera != last:  # one camera's at a time: 25 MB at 1920×1080
            ray_directions, last = torch.from_numpy(camera_rays(camera, camera.width, camera.height)), camera
        pose = torch.from_numpy(path.poses[index]).float()
        yield rays_of_view(ray_directions, pose, float(near[index]), float(far[index]))


def default_path(scene: Scene) -> PathKind:
    """An orbit around an object if up is known; a spiral for a forward-facing capture if the photos look where it
    looks; interpolated otherwise, and where an orbit or a spiral would leave the space that the photos show to be
    free."""
    poses = _poses(scene)
    near = np.array([view.near for view in scene.of_split("train")])

    def is_clear(path: np.ndarray) -> bool:
        return camera_paths.keeps_clear(path, poses, near)

    if scene.capture_type == "object-centric" and scene.up_known and is_clear(camera_paths.orbit(poses, TRIAL_FRAMES)):
        return "orbit"
    spiral = scene.capture_type == "forward-facing" and camera_paths.suits_spiral(poses)
    if spiral and is_clear(camera_paths.spiral(poses, TRIAL_FRAMES)):
        return "spiral"
    return "interpolated"


def _poses(scene: Scene) -> np.ndarray:
    """Of the training photos, (n, 3, 4); levelled in a forward-facing capture: photos held sideways would tilt the
    path."""
    poses = np.stack([view.scene_from_camera for view in scene.of_split("train")])
    return levelled(poses) if scene.capture_type == "forward-facing" else poses


def make_path(scene: Scene, kind: PathKind, frames: int) -> CameraPath:
    """A path along the training photos, with an undistorted camera of median focal length or, if focal lengths differ,
    of those of the photos nearby. Raises StageError for an orbit around photos from one place."""
    path_of = {
        "orbit": camera_paths.orbit,
        "spiral": camera_paths.spiral,
        "interpolated": camera_paths.interpolated,
    }[kind]
    poses = _poses(scene)
    if kind == "orbit" and np.ptp(poses[:, :, 3], axis=0).max() < MIN_CAMERA_EXTENT:
        hint = "Use --render.path interpolated, or leave it out for the default."
        raise StageError("render.no-orbit", "there is no orbit", "all photos were taken from one place", hint)
    path, camera, relative = path_of(poses, frames), median_camera(scene), _relative_focals(scene)
    if np.ptp(np.log(relative)) <= math.log(MAX_FOCAL_RATIO):
        return CameraPath((camera,) * frames, path)
    focals = camera_paths.zoomed(poses, relative, path)
    return CameraPath(tuple(_pinhole(camera.width, camera.height, focal) for focal in focals), path)


def _relative_focals(scene: Scene) -> np.ndarray:
    """Of the training photos, in longest sides."""
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    return np.array([camera.params[0] / max(camera.width, camera.height) for camera in cameras])


def _pinhole(width: int, height: int, relative: float) -> Camera:
    """With a focal length in longest sides, at most 90 degrees wide."""
    focal = max(float(relative) * max(width, height), MIN_FOCAL * width)
    return Camera("PINHOLE", width, height, (focal, focal, width / 2, height / 2))


def median_camera(scene: Scene) -> Camera:
    """The most usual photo size with the median focal length, as a pinhole with a centred principal point.

    Of sizes that are equally usual (each photo may have been cut by hand) it is the median in shape and in area.
    """
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    counts = Counter((camera.width, camera.height) for camera in cameras)
    most = max(counts.values())
    usual = [size for size, count in counts.items() if count == most]
    shape, area = (sorted(each)[len(usual) // 2] for each in ([w / h for w, h in usual], [w * h for w, h in usual]))
    width, height = round(math.sqrt(area * shape)), round(math.sqrt(area / shape))
    return _pinhole(width, height, float(np.median(_relative_focals(scene))))


def path_from_file(scene: Scene, file: Path) -> CameraPath:
    """The cameras of a transforms.json (or of a path.json that this stage wrote), which lives in the sfm frame.

    Poses are OpenGL camera-to-world matrices; intrinsics stand at the top or in each frame, and what is missing of
    them is taken from the photos.
    Raises StageError if the file cannot be used.
    """
    content = read_transforms(file)
    usual = median_camera(scene)
    focal = usual.params[0] / max(usual.width, usual.height)
    cameras, poses = [], []
    for index, frame in enumerate(content["frames"]):
        try:
            cameras.append(read_intrinsics(intrinsics_of(frame, content), usual.width, usual.height, focal))
            poses.append(_in_scene(frame["transform_matrix"], scene.scene_from_sfm))
        except (TypeError, ValueError, ArithmeticError) as error:
            hint = "Use the format of output/transforms.json or output/path.json."
            raise StageError(
                "render.unusable-frame", f"cannot use frame {index} of {file.name}", str(error), hint
            ) from error
    if (side := max(max(camera.width, camera.height) for camera in cameras)) > MAX_SIDE:
        raise StageError(
            "render.large-frames",
            f"cannot render the frames of {file.name}",
            f"one is {side} pixels long",
            f"Give at most {MAX_SIDE}.",
        )
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise StageError(
            "render.frame-sizes",
            f"cannot make one video of {file.name}",
            "its frames differ in size",
            "Give all frames one w and h.",
        )
    return CameraPath(tuple(cameras), np.stack(poses), _fps(content, file))


def _fps(content: dict[str, Any], file: Path) -> int | None:
    """Frames per second of a path.json; None where the file has none. Raises StageError where no video has it."""
    value = content.get("fps")
    if value is None:
        return None
    if not isinstance(value, int | float) or not 0.5 < value <= MAX_GIVEN_FPS:
        hint = "Correct it, or leave it out and give --render.fps."
        why = f"its fps is {bounded(repr(value))} instead of a number from 1 to {MAX_GIVEN_FPS}"
        raise StageError("render.unusable-fps", f"cannot make a video of {file.name}", why, hint)
    return round(value)


def _in_scene(matrix: Any, scene_from_sfm: Similarity) -> np.ndarray:
    """An OpenGL pose in the sfm frame as ours. Scaled axes are accepted: the nearest rotation is taken."""
    pose = pose_matrix(matrix)
    if not np.linalg.det(pose[:, :3]) > 0:
        raise ValueError("its transform_matrix mirrors or is singular")
    rotation = nearest_rotations(pose[:, :3] @ OPENGL_FROM_OPENCV)
    return scene_from_sfm.pose(np.concatenate([rotation, pose[:, 3:]], axis=1))


def even_height(width: int, camera: Camera) -> int:
    """The even number of rows that keeps the camera's proportions best."""
    return max(2, 2 * round(width * camera.height / camera.width / 2))


def resized(camera: Camera, width: int) -> Camera:
    """The same view with another (even) width and the even height next to its proportions."""
    return rescaled(camera, width, even_height(width, camera))
