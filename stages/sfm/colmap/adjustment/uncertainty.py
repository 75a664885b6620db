"""How well each photo's pose is known, in its own pixels. Call it in a worker process."""

import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_matrix

from stages.hardware.memory import available_bytes
from stages.io.amounts import bytes_in_words
from stages.sfm.colmap.adjustment.observations import Observations, observations, points_in_camera, residuals

MIN_OBSERVATIONS = 6  # of a photo: 12 equations for 6 unknowns; with fewer its pose is not known
MATRICES = 6  # of 6 n × 6 n float64 for n photos, that are there at once at most
STEP = 1e-5  # of finite differences, as a share of the distance: rounding and curvature are both far below a percent


def pose_uncertainty_px(model: pycolmap.Reconstruction, noise: float) -> dict[int, float]:
    """By image id: how far, root mean square over the points a photo sees, its pose may have moved them, in pixels.

    It is the covariance of the bundle adjustment at its minimum (points and poses unknown, cameras as they are),
    propagated to the projections of the points at their places. A model may be shifted, turned and scaled as a whole,
    which is no error: among the frames that differ by that, the one is taken in which all photos together move
    least in pixels. This fixes the gauge without preferring any photo (inner constraints; Triggs et al. 2000,
    Bundle Adjustment, section 9.3). Cameras are held since refining poses could not mend them: a focal length a little
    long looks like places a little far away.

    ``noise`` scales adjustments' soft-L1. Photos with very few observations have no entry. Raises LinAlgError where the
    equations leave more than the frame open (points without depth), and MemoryError, with the sizes, where there is no
    room for the covariance, which grows with the square of the number of photos.
    """
    seen = observations(model)
    counts = dict(zip(*(a.tolist() for a in np.unique(seen.image, return_counts=True)), strict=True))
    keep = np.isin(seen.image, [i for i, count in counts.items() if count >= MIN_OBSERVATIONS])
    seen = Observations(*(part[keep] for part in seen))
    point, views = np.unique(seen.point, return_counts=True)
    seen = Observations(*(part[np.isin(seen.point, point[views >= 2])] for part in seen))  # one view gives no depth
    ids = np.unique(seen.image)
    if not len(ids):
        return {}
    needed, free = MATRICES * (6 * len(ids)) ** 2 * 8, available_bytes()
    if needed > free:
        raise MemoryError(f"computing it takes {bytes_in_words(needed)}, and only {bytes_in_words(free)} are free")
    to_pose, to_point = _jacobians(model, seen)
    covariance = _whitened_covariance(model, seen, ids, to_pose, to_point)
    sigma = _error_px(residuals(model, seen), noise, len(ids), len(np.unique(seen.point)))
    traces = np.einsum("iaia->i", covariance.reshape(len(ids), 6, len(ids), 6))
    return {i: sigma * float(np.sqrt(trace / counts[i])) for i, trace in zip(ids.tolist(), traces, strict=True)}


def _jacobians(
    model: pycolmap.Reconstruction, seen: Observations
) -> tuple[Float[np.ndarray, "n 2 6"], Float[np.ndarray, "n 2 3"]]:
    """Of each observation's projection, by its photo's turn (radians) and shift in the camera's frame and by its point.

    The turn φ and shift τ take cam_from_world = (R, t) to (exp([φ]) R, t + τ), so points x to R x + t + φ × R x + τ.
    """
    to_pose, to_point = np.empty((len(seen.xy), 2, 6)), np.empty((len(seen.xy), 2, 3))
    for image_id, (mine, points) in points_in_camera(model, seen).items():
        camera, pose = model.camera(model.image(image_id).camera_id), model.image(image_id).cam_from_world().matrix()
        step = STEP * np.linalg.norm(points, axis=1)
        ray_direction = np.empty((len(points), 2, 3))
        for axis, unit in enumerate(np.eye(3)):
            ahead, behind = (np.asarray(camera.img_from_cam(points + s * step[:, None] * unit)) for s in (1, -1))
            ray_direction[:, :, axis] = (ahead - behind) / (2 * step[:, None])
        # J (φ × y) = Σ φ_a J (e_a × y) with y = R x
        turned = np.cross(np.eye(3)[None], (points - pose[:, 3])[:, None])
        to_pose[mine, :, :3] = np.einsum("nij,naj->nia", ray_direction, turned)
        to_pose[mine, :, 3:] = ray_direction
        to_point[mine] = ray_direction @ pose[:, :3]
    return to_pose, to_point


def _whitened_covariance(
    model: pycolmap.Reconstruction,
    seen: Observations,
    ids: np.ndarray,
    to_pose: Float[np.ndarray, "n 2 6"],
    to_point: Float[np.ndarray, "n 2 3"],
) -> Float[np.ndarray, "k k"]:
    """The poses' covariance for unit noise, in coordinates in which a pose's own information is the identity.

    There the information of poses alone is S = I − B Bᵀ, what is left once the points follow; directions Q of the gauge
    are its null space, and the pseudo-inverse is (S + Q Qᵀ)⁻¹ − Q Qᵀ. Its trace over one photo is the sum of squared
    pixels by which its points move.
    """
    place, point = np.searchsorted(ids, seen.image), np.unique(seen.point, return_inverse=True)[1]
    pose_roots = np.linalg.cholesky(_sums(np.einsum("nki,nkj->nij", to_pose, to_pose), place))
    point_roots = np.linalg.cholesky(_sums(np.einsum("nki,nkj->nij", to_point, to_point), point))
    ours = np.linalg.solve(pose_roots[place], to_pose.transpose(0, 2, 1))  # (n, 6, 2)
    theirs = np.linalg.solve(point_roots[point], to_point.transpose(0, 2, 1))  # (n, 3, 2)
    order = np.lexsort((point, place))
    blocks = np.einsum("nik,njk->nij", ours, theirs)[order]
    begins = np.searchsorted(place[order], np.arange(len(ids) + 1))
    shape = (6 * len(ids), 3 * len(point_roots))
    coupling = bsr_matrix((blocks, point[order], begins), shape=shape).tocsr()
    gauge = np.concatenate([_gauge(model.image(i).cam_from_world().matrix()) for i in ids.tolist()]).reshape(-1, 6, 7)
    free, _ = np.linalg.qr(np.einsum("nji,njk->nik", pose_roots, gauge).reshape(-1, 7))
    information = np.eye(shape[0]) - (coupling @ coupling.T).toarray() + free @ free.T
    return cho_solve(cho_factor(information), np.eye(shape[0])) - free @ free.T


def _sums(blocks: Float[np.ndarray, "n a a"], of: np.ndarray) -> Float[np.ndarray, "m a a"]:
    out = np.zeros((int(of.max()) + 1, *blocks.shape[1:]))
    np.add.at(out, of, blocks)
    return out


def _gauge(pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "6 7"]:
    """How a pose (turn, shift) changes as the world turns, shifts and grows, while points keep their coordinates."""
    rotation, translation = pose[:, :3], pose[:, 3]
    out = np.zeros((6, 7))
    out[:3, :3] = out[3:, 3:6] = rotation
    out[3:, 6] = translation
    return out


def _error_px(residual: Float[np.ndarray, "n 2"], scale: float, poses: int, points: int) -> float:
    """Standard deviation of a coordinate that has the effect of these residuals r under soft-L1 of this scale s.

    √(E[ψ²] / E[ψ']²) with the influence ψ(r) = r / √(1 + (r/s)²) (Huber 1981, section 7.6), where residuals are
    enlarged to what they would be if poses and points did not follow the noise.
    """
    count = 2 * len(residual)
    left = 1 - (6 * poses + 3 * points - 7) / count  # the share of the noise's square that residuals show
    square = (residual**2).sum(axis=1) / max(left, 1 / count) / scale**2
    influence = scale**2 * np.mean(square / (1 + square)) / 2  # of a coordinate
    slope = np.mean((1 - square / (2 * (1 + square))) / np.sqrt(1 + square))
    return float(np.sqrt(influence) / slope)
