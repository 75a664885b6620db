"""Why an image is unregistered: what its verified matches tell. Call it in a worker process."""

from collections import Counter
from collections.abc import Container
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from stages.sfm.colmap.database.features import read_keypoints
from stages.sfm.registration import PLANAR_CONFIGS
from stages.sfm.retry_strategies import MIN_POSE_INLIERS

NEARLY_ALL = 0.9  # of the verified pairs


class Links(NamedTuple):
    """What the verified pairs tell: whether any of them ``join`` registered to unregistered images, and whether nearly
    all are planar or pure rotations (``planar``)."""

    join: bool
    planar: bool


def links(database: Path, registered: Container[str]) -> Links:
    """Of all images, those whose names are in ``registered`` being registered.

    They are joined where one image has as many matches with all images of the other side as mapping asks of an image:
    with fewer, none could be registered, whichever side mapping began on. While none is registered every pair may be
    the initial one.
    """
    across: Counter[int] = Counter()
    planar: list[bool] = []
    with pycolmap.Database.open(database) as db:
        is_registered = {image.image_id: image.name in registered for image in db.read_all_images()}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            if count := len(geometry.inlier_matches):
                pair = pycolmap.pair_id_to_image_pair(pair_id)
                if is_registered[pair[0]] != is_registered[pair[1]]:
                    across.update(dict.fromkeys(pair, count))
                planar.append(int(geometry.config) in PLANAR_CONFIGS)
    any_registered = any(is_registered.values())
    join = max(across.values(), default=0) >= MIN_POSE_INLIERS if any_registered else bool(planar)
    return Links(join, sum(planar) > NEARLY_ALL * len(planar))


def supports(model: pycolmap.Reconstruction, database: Path, seed: int) -> dict[str, tuple[int, int]]:
    """For every image that is in the database but not in the model: how many of its features are points of the model by
    its verified matches, and how many of those agree on one pose (P3P in RANSAC, 12 px)."""
    registered = set(model.reg_image_ids())
    found = {}
    with pycolmap.Database.open(database) as db:
        missing = [image for image in db.read_all_images() if image.image_id not in registered]
        geometries = list(zip(*db.read_two_view_geometries(), strict=True)) if missing else []
        for image in sorted(missing, key=lambda image: image.image_id):
            points = _points_seen(image.image_id, geometries, model)
            keypoints = read_keypoints(db, image.image_id)
            known = model.exists_camera(image.camera_id)
            camera = model.camera(image.camera_id) if known else db.read_camera(image.camera_id)
            found[image.name] = (len(points), _pose_inliers(points, keypoints, camera, model, seed))
    return found


def _points_seen(image_id: int, geometries: list, model: pycolmap.Reconstruction) -> list[tuple[int, int]]:
    """(keypoint, point) pairs of an image, by its matches with registered images; each pair once."""
    seen = set()
    for pair_id, geometry in geometries:
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        if image_id not in (first, second):
            continue
        other, mine = (second, 0) if image_id == first else (first, 1)
        if not (other in model.images and model.image(other).has_pose):
            continue
        points2D = model.image(other).points2D
        for match in np.asarray(geometry.inlier_matches):
            if (point2D := points2D[match[1 - mine]]).has_point3D():
                seen.add((int(match[mine]), int(point2D.point3D_id)))
    return sorted(seen)


def _pose_inliers(
    points: list[tuple[int, int]],
    keypoints: np.ndarray,
    camera: pycolmap.Camera,
    model: pycolmap.Reconstruction,
    seed: int,
) -> int:
    if len(points) < 4:
        return 0
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = seed
    xy = keypoints[[keypoint for keypoint, _ in points]]
    xyz = np.array([model.point3D(point).xyz for _, point in points])
    answer = pycolmap.estimate_absolute_pose(xy, xyz, camera, options)
    return int(answer["num_inliers"]) if answer else 0
