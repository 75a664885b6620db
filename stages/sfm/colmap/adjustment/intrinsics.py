"""Intrinsics: the candidates (a camera model, its principal point refined or fixed), how a mapped camera becomes one of
them, and when one is degenerate."""

from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import least_squares

from stages.ingest.exif import FOCAL_RANGE
from stages.sfm.colmap.adjustment.observations import observations, points_in_camera
from stages.sfm.colmap.cameras import is_fisheye, share_without_ray, why_no_ray

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)
FIT_POINTS = 300
MAX_PRINCIPAL_POINT_OFFSET = 0.1  # of the image, from its centre: lenses are centred to a percent or two


class CameraModelCandidate(NamedTuple):
    """A candidate: a camera model, and whether the principal point is refined or stays in the centre."""

    model: str
    principal_point: bool

    @property
    def free_parameters(self) -> int:
        """How many numbers of the camera are refined."""
        parameters = pycolmap.Camera.create_from_model_name(1, self.model, 1.0, 2, 2).params
        return len(parameters) - 2 * (not self.principal_point)

    @property
    def complexity(self) -> tuple[bool, int]:
        """The simpler of two candidates has the smaller one.

        Ordinary lenses are made to draw straight lines straight, and at their angles a fisheye's series describes
        much the same rays. So a fisheye model counts as less simple than all others, however few its numbers.
        """
        return is_fisheye(self.model), self.free_parameters

    @property
    def principal_point_state(self) -> str:
        """What becomes of the principal point, in a word."""
        return "refined" if self.principal_point else "fixed"


def set_camera_models(model: pycolmap.Reconstruction, names: dict[int, str]) -> None:
    """Give cameras (by id) the models named and centred principal points; their points are projected where
    they were before.

    Cameras without points stay as they are.
    """
    seen = observations(model)
    points: dict[int, list[np.ndarray]] = {}
    for image_id, (_, mine) in points_in_camera(model, seen).items():
        points.setdefault(model.image(image_id).camera_id, []).append(mine)
    for camera_id, name in names.items():
        camera = model.camera(camera_id)
        middle = [camera.width / 2, camera.height / 2]
        centred = [camera.params[i] for i in camera.principal_point_idxs()] == middle
        if camera_id in points and not (camera.model_name == name and centred):
            mine = np.concatenate(points[camera_id])
            new = _fitted(camera, name, mine[:: -(-len(mine) // FIT_POINTS)])
            camera.model, camera.params = new.model, list(new.params)


def _fitted(camera: pycolmap.Camera, name: str, points: Float[np.ndarray, "n 3"]) -> pycolmap.Camera:
    """The centred camera of a model that projects points in the camera's frame most nearly as this one does."""
    target = np.asarray(camera.img_from_cam(points))
    points, target = points[np.isfinite(target[:, 0])], target[np.isfinite(target[:, 0])]
    new = pycolmap.Camera.create_from_model_name(
        camera.camera_id, name, camera.mean_focal_length(), camera.width, camera.height
    )
    params = np.array(new.params)  # with the principal point in the centre
    centre, focal = list(new.principal_point_idxs()), list(new.focal_length_idxs())
    free = np.setdiff1d(np.arange(len(params)), centre)
    unit = np.where(np.isin(free, focal), camera.mean_focal_length(), 1.0)

    def residuals(x: np.ndarray) -> np.ndarray:
        params[free] = x * unit
        new.params = params.tolist()
        return (np.asarray(new.img_from_cam(points)) - target).ravel()

    residuals(least_squares(residuals, params[free] / unit).x)
    return new


def why_degenerate(camera: pycolmap.Camera) -> str | None:
    """What makes an adjusted camera degenerate, or None."""
    size = np.array([camera.width, camera.height])
    params = np.array(camera.params)
    if not np.isfinite(params).all():
        return "its parameters are not finite"
    focal = params[list(camera.focal_length_idxs())] / size.max()
    if focal.min() < FOCAL_RANGE[0] or focal.max() > FOCAL_RANGE[1]:
        return f"its focal length is {focal.min():.2g} to {focal.max():.2g} times the longer side"
    off = float(np.abs(params[list(camera.principal_point_idxs())] / size - 0.5).max())
    if off > MAX_PRINCIPAL_POINT_OFFSET:
        return f"its principal point is off the centre by {off:.0%} of the image"
    lost = share_without_ray(camera)
    return f"{why_no_ray(camera.model_name)} at {lost:.1%} of the pixels" if lost else None


def degenerate_cameras(model: pycolmap.Reconstruction) -> dict[int, str]:
    """The registered photos whose camera is degenerate, by image id, and what makes it so."""
    camera_of = {i: model.image(i).camera_id for i in sorted(model.reg_image_ids())}
    found = {camera_id: why_degenerate(model.camera(camera_id)) for camera_id in set(camera_of.values())}
    return {i: why for i, camera_id in camera_of.items() if (why := found[camera_id])}
