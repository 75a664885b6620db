"""Why an image is unregistered, and in which images models differ. Call it in a worker process."""

from collections import Counter
from collections.abc import Container, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from nerf.geometry.alignment import align
from stages.sfm.colmap.database.features import read_keypoints
from stages.sfm.degeneracy import different_poses
from stages.sfm.registration import PLANAR_CONFIGS
from stages.sfm.retry_strategies import MIN_POSE_INLIERS

NEARLY_ALL = 0.9
# A single image may merely have a bad pose in one of two models: it takes several to say that the models contradict.
MIN_DIFFERENT, MIN_DIFFERENT_FRACTION = 2, 0.2
MAX_DIFFERENT_FRACTION = 0.05  # of the images that two models share, whose poses may differ


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


def find_conflict(models: Sequence[pycolmap.Reconstruction]) -> dict[str, Any] | None:
    """The largest sub-model that shares images with the best one (the first) and gives some of them different poses.

    ``group`` is its number, ``shared`` how many images both have, ``different`` how many of them have different poses;
    these are the ``photos``, and ``others`` those that it alone has. Where there are none of the latter nothing is lost
    by it: the poses of the best model have passed the check, and the group has nothing to add.
    """
    if len(models) < 2:
        return None
    best = _poses(models[0])
    centres = np.array(list(best.values()))[:, :, 3]
    extent = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(axis=1).mean()))
    for group, model in enumerate(models[1:], start=1):
        poses = _poses(model)
        if not (shared := sorted(best.keys() & poses.keys())):
            continue
        here, there = (np.array([of[name] for name in shared]) for of in (best, poses))
        different = different_poses(here, there, extent)
        if different.sum() >= max(MIN_DIFFERENT, MIN_DIFFERENT_FRACTION * len(shared)):
            others = sorted(poses.keys() - best.keys())
            moved = [name for name, is_different in zip(shared, different, strict=True) if is_different]
            facts = {"group": group, "shared": len(shared), "different": len(moved), "photos": moved, "others": others}
            return facts if others else None
    return None


def compare_models(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> dict[str, Any]:
    """How far two models of the same images agree, after the similarity on which most of them do.

    ``photos`` is how many both have, ``agree`` how many of them have the same pose in both, ``different`` the files of
    those that do not; ``centre`` and ``degrees`` are mean differences of the former, centres as fractions of the extent
    of the first model's cameras.
    """
    first, second = _poses(model), _poses(other)
    shared = sorted(first.keys() & second.keys())
    facts: dict[str, Any] = {"photos": len(shared), "agree": 0, "different": [], "centre": None, "degrees": None}
    if len(shared) < 3:
        return facts
    here, there = (np.array([of[name] for name in shared]) for of in (first, second))
    extent = float(np.linalg.norm(np.ptp(here[:, :, 3], axis=0)))
    different = different_poses(here, there, extent)
    moved = [name for name, is_different in zip(shared, different, strict=True) if is_different]
    here, there = here[~different], there[~different]
    facts |= {"agree": len(here), "different": moved}
    with suppress(ValueError):  # all in one line: nothing to align by
        first_from_second = align(there[:, :, 3], here[:, :, 3])
        aligned = np.array([first_from_second.pose(pose) for pose in there])
        off = np.linalg.norm(aligned[:, :, 3] - here[:, :, 3], axis=1)
        cosine = (np.einsum("nij,nij->n", aligned[:, :, :3], here[:, :, :3]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        facts |= {"centre": float(off.mean() / extent), "degrees": float(turned.mean())}
    return facts


def disagree(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> bool:
    """Whether two models of the same images give more than a few of them different poses."""
    compared = compare_models(model, other)
    return len(compared["different"]) > MAX_DIFFERENT_FRACTION * compared["photos"]


def _poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """By name, (3, 4) from the image's camera to the model's frame."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.cam_from_world().inverse().matrix() for image in images}


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
