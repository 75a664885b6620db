"""Observations of a reconstruction as arrays: where points were seen, how far from where they should be."""

from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

MEDIAN_PER_SIGMA = 1.1774  # the median length of a 2-D Gaussian vector over the deviation of its coordinates: √(2 ln 2)
MIN_NOISE_PX = 0.01  # no detector places a feature better than this


class Observations(NamedTuple):
    """Some observations of a model, in order of image."""

    image: Int[np.ndarray, "n"]  # image ids
    point: Int[np.ndarray, "n"]  # point ids
    xy: Float[np.ndarray, "n 2"]  # pixels

    def of_image(self, image_id: int) -> slice:
        """Where the observations of one image lie."""
        begin, end = np.searchsorted(self.image, (image_id, image_id + 1))
        return slice(int(begin), int(end))


def observations(model: pycolmap.Reconstruction) -> Observations:
    """All observations of a model."""
    ids = sorted(model.reg_image_ids())
    seen = [model.image(i).get_observation_points2D() for i in ids]
    return Observations(
        np.repeat(np.array(ids, np.int64), [len(s) for s in seen]),
        np.array([p.point3D_id for s in seen for p in s], np.int64),
        np.array([p.xy for s in seen for p in s], float).reshape(-1, 2),
    )


def shared_points(model: pycolmap.Reconstruction) -> csr_matrix:
    """How many points any two registered images, in order of their ids, both see."""
    ids, seen = sorted(model.reg_image_ids()), observations(model)
    points, point = np.unique(seen.point, return_inverse=True)
    where = np.searchsorted(ids, seen.image), point
    sees = csr_matrix((np.ones(len(point)), where), shape=(len(ids), len(points)))
    return sees @ sees.T


def points_in_camera(
    model: pycolmap.Reconstruction, seen: Observations
) -> dict[int, tuple[slice, Float[np.ndarray, "m 3"]]]:
    """By image id: where its observations lie, and their points in the camera's frame."""
    ids, index = np.unique(seen.point, return_inverse=True)
    xyz = np.array([model.point3D(i).xyz for i in ids.tolist()]).reshape(-1, 3)[index]
    found = {}
    for image_id in np.unique(seen.image).tolist():
        mine, pose = seen.of_image(image_id), model.image(image_id).cam_from_world().matrix()
        found[image_id] = mine, xyz[mine] @ pose[:, :3].T + pose[:, 3]
    return found


def residuals(model: pycolmap.Reconstruction, seen: Observations) -> Float[np.ndarray, "n 2"]:
    """Projection minus observation in pixels; NaN for points behind the camera."""
    out = np.empty_like(seen.xy)
    for image_id, (mine, points) in points_in_camera(model, seen).items():
        camera = model.camera(model.image(image_id).camera_id)
        out[mine] = np.asarray(camera.img_from_cam(points)) - seen.xy[mine]
    return out


def noise_px(model: pycolmap.Reconstruction, seen: Observations) -> float:
    """Standard deviation of a coordinate of an observation, robust to mismatches.

    It is the residuals' own, from their median length, times √(2n / (2n − unknowns)): points and poses follow the
    noise, which makes residuals smaller than it. Of a model without observations it is the least there is.
    """
    count, unknowns = 2 * len(seen.xy), 3 * len(np.unique(seen.point)) + 6 * len(np.unique(seen.image))
    length = np.linalg.norm(residuals(model, seen), axis=1)
    in_front = length[np.isfinite(length)]
    if not len(in_front):
        return MIN_NOISE_PX
    sigma = float(np.median(in_front)) / MEDIAN_PER_SIGMA
    return max(sigma * (count / max(count - unknowns, 1)) ** 0.5, MIN_NOISE_PX)
