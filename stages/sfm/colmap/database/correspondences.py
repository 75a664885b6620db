"""The verified matches of a database as arrays."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from stages.sfm.colmap.database.features import read_keypoints
from stages.sfm.pose_check import MIN_PAIR_MATCHES, PairMatches

MAX_MATCHES_CHECKED = 200  # of a pair, drawn by the seed: their median is known to a tenth of their spread


class Correspondences(NamedTuple):
    """Verified matches of a database, keypoints numbered through all photos; match k belongs to ``pairs[pair[k]]``."""

    pairs: Int[np.ndarray, "pairs 2"]  # image ids
    pair: Int[np.ndarray, "matches"]
    keypoint: Int[np.ndarray, "matches 2"]
    begins: Int[np.ndarray, "photos+1"]  # where each photo's keypoints begin


def read_correspondences(db: pycolmap.Database, geometries: dict[int, pycolmap.TwoViewGeometry]) -> Correspondences:
    """All verified matches, in order of ``geometries`` (by pair id)."""
    counts = [db.num_keypoints_for_image(i + 1) for i in range(db.num_images())]
    begins = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    pairs = image_pairs(geometries)
    inliers = [np.asarray(geometry.inlier_matches, int).reshape(-1, 2) for geometry in geometries.values()]
    return Correspondences(
        pairs,
        np.repeat(np.arange(len(pairs)), [len(some) for some in inliers]),
        np.concatenate([np.zeros((0, 2), int), *(s + begins[p - 1] for s, p in zip(inliers, pairs, strict=True))]),
        begins,
    )


def image_pairs(pair_ids: Iterable[int]) -> Int[np.ndarray, "pairs 2"]:
    """The image ids of COLMAP's pair ids, the lower first."""
    return np.array([pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids], int).reshape(-1, 2)


def read_pair_matches(
    db: pycolmap.Database,
    model: pycolmap.Reconstruction,
    seed: int,
    most: int | None = MAX_MATCHES_CHECKED,
) -> tuple[list[int], PairMatches]:
    """The image ids of the model's photos, and the verified matches between them for a check of their poses; ``most``
    of each pair, None: all, in their order."""
    ids = sorted(model.reg_image_ids())
    number = {image_id: place for place, image_id in enumerate(ids)}
    random = np.random.default_rng(seed)
    xy = {image_id: read_keypoints(db, image_id) for image_id in ids}
    pairs, weights, keypoints, noise = [], [], [], []
    for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        inliers = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
        if not (len(inliers) and first in number and second in number):
            continue
        pairs.append((number[first], number[second]))
        weights.append(len(inliers))
        if most and len(inliers) > most:
            inliers = inliers[random.choice(len(inliers), most, replace=False)]
        keypoints.append(inliers)
        noise.append(np.nan)
        if geometry.F is not None and len(inliers) >= MIN_PAIR_MATCHES:
            noise[-1] = _epipolar_px(geometry.F, xy[first][inliers[:, 0]], xy[second][inliers[:, 1]])
    directions = [_directions(xy[image_id], model.camera(model.image(image_id).camera_id)) for image_id in ids]
    begins = np.concatenate([[0], np.cumsum([len(some) for some in directions])]).astype(int)
    rows = [some + begins[list(pair)] for some, pair in zip(keypoints, pairs, strict=True)]
    return ids, PairMatches(
        pairs=np.array(pairs, int).reshape(-1, 2),
        weight=np.array(weights, float),
        pair=np.repeat(np.arange(len(pairs)), [len(some) for some in keypoints]),
        keypoint=np.concatenate([np.zeros((0, 2), int), *rows]),
        photo=np.repeat(np.arange(len(ids)), np.diff(begins)),
        ray_direction=np.concatenate([np.zeros((0, 3)), *directions]),
        focal_px=np.array([model.camera(model.image(i).camera_id).mean_focal_length() for i in ids]),
        pair_noise_px=np.array(noise, float),
    )


def _directions(xy: Float[np.ndarray, "keypoints 2"], camera: pycolmap.Camera) -> Float[np.ndarray, "keypoints 3"]:
    """Unit rays of a photo's keypoints in its camera's frame; along the axis where the camera model has none."""
    rays = np.asarray(camera.cam_ray_from_img(xy), float).reshape(-1, 3)
    return np.where(np.isfinite(rays).all(axis=1, keepdims=True), rays, [0.0, 0.0, 1.0])


def _epipolar_px(
    fundamental: Float[np.ndarray, "3 3"], first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]
) -> float:
    """The median distance of matches from an epipolar geometry (Sampson; Hartley and Zisserman 2004, section 11.4)."""
    x, y = (np.concatenate([xy, np.ones((len(xy), 1))], axis=1) for xy in (first, second))
    there, here = x @ fundamental.T, y @ fundamental
    slope = np.hypot(np.linalg.norm(there[:, :2], axis=1), np.linalg.norm(here[:, :2], axis=1))
    distance = np.abs(np.einsum("ij,ij->i", y, there))
    return float(np.median(np.divide(distance, slope, out=np.zeros_like(slope), where=slope > 0)))
