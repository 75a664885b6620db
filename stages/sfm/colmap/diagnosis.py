"""Why a photo has no place in a model. Call it in a child process."""

from collections import Counter
from collections.abc import Container, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nerf.geometry.alignment import align
from stages.sfm.degeneracy import elsewhere
from stages.sfm.registration import FLAT_CONFIGS
from stages.sfm.retry_strategies import FEWEST_MATCHES

if TYPE_CHECKING:
    import pycolmap

MOSTLY = 0.9
# A single photo may merely have a bad place in one of two models: it takes several to say that the models contradict.
FEWEST_ELSEWHERE, SHARE_ELSEWHERE = 2, 0.2


class Links(NamedTuple):
    """What the verified pairs of photos say: whether any of them ``join`` photos that have a place to photos that have
    none, and whether next to all are explained by a plane or a turn of the camera alone (``flat``)."""

    join: bool
    flat: bool


def links(database: Path, placed: Container[str]) -> Links:
    """Of all photos, those in ``placed`` having a place.

    They are joined where one photo has as many matches with all photos of the other side as mapping asks of a photo:
    with fewer, none could be added to the others, whichever side mapping began on. While none has a place every pair
    is one to begin with.
    """
    import pycolmap

    across: Counter[int] = Counter()
    flat: list[bool] = []
    with pycolmap.Database.open(database) as db:
        has_place = {image.image_id: image.name in placed for image in db.read_all_images()}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            if count := len(geometry.inlier_matches):
                pair = pycolmap.pair_id_to_image_pair(pair_id)
                if has_place[pair[0]] != has_place[pair[1]]:
                    across.update(dict.fromkeys(pair, count))
                flat.append(int(geometry.config) in FLAT_CONFIGS)
    join = max(across.values(), default=0) >= FEWEST_MATCHES if any(has_place.values()) else bool(flat)
    return Links(join, sum(flat) > MOSTLY * len(flat))


def find_conflict(models: "Sequence[pycolmap.Reconstruction]") -> dict[str, Any] | None:
    """The largest sub-model that shares photos with the best one (the first) and puts some of them elsewhere.

    ``group`` is its number, ``shared`` how many photos both have, ``elsewhere`` how many of them it puts elsewhere;
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
        apart = elsewhere(here, there, extent)
        if apart.sum() >= max(FEWEST_ELSEWHERE, SHARE_ELSEWHERE * len(shared)):
            others = sorted(poses.keys() - best.keys())
            moved = [name for name, far in zip(shared, apart, strict=True) if far]
            found = {"group": group, "shared": len(shared), "elsewhere": len(moved), "photos": moved, "others": others}
            return found if others else None
    return None


def compare_models(model: "pycolmap.Reconstruction", other: "pycolmap.Reconstruction") -> dict[str, Any]:
    """How far two models of the same photos agree, after the similarity on which most of them do.

    ``photos`` is how many both have, ``agree`` how many of them stand the same in both, ``elsewhere`` the files of
    those that do not; ``centre`` and ``degrees`` are mean differences of the former, centres as shares of the extent of
    the first model's cameras.
    """
    first, second = _poses(model), _poses(other)
    shared = sorted(first.keys() & second.keys())
    facts: dict[str, Any] = {"photos": len(shared), "agree": 0, "elsewhere": [], "centre": None, "degrees": None}
    if len(shared) < 3:
        return facts
    here, there = (np.array([of[name] for name in shared]) for of in (first, second))
    extent = float(np.linalg.norm(np.ptp(here[:, :, 3], axis=0)))
    apart = elsewhere(here, there, extent)
    facts |= {"agree": int((~apart).sum()), "elsewhere": [name for name, far in zip(shared, apart, strict=True) if far]}
    with suppress(ValueError):  # all in one line: nothing to align by
        first_from_second = align(there[~apart][:, :, 3], here[~apart][:, :, 3])
        moved = np.array([first_from_second.pose(pose) for pose in there[~apart]])
        off = np.linalg.norm(moved[:, :, 3] - here[~apart][:, :, 3], axis=1)
        cosine = (np.einsum("nij,nij->n", moved[:, :, :3], here[~apart][:, :, :3]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        facts |= {"centre": float(off.mean() / extent), "degrees": float(turned.mean())}
    return facts


def _poses(model: "pycolmap.Reconstruction") -> dict[str, np.ndarray]:
    """By name, (3, 4) from the photo's camera to the model's frame."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.cam_from_world().inverse().matrix() for image in images}


def supports(model: "pycolmap.Reconstruction", database: Path, seed: int) -> dict[str, tuple[int, int]]:
    """For every photo that is in the database but not in the model: how many of its features are points of the model
    by its verified matches, and how many of those agree on one position of the camera (P3P in RANSAC, 12 px)."""
    import pycolmap

    registered = set(model.reg_image_ids())
    found = {}
    with pycolmap.Database.open(database) as db:
        missing = [image for image in db.read_all_images() if image.image_id not in registered]
        geometries = list(zip(*db.read_two_view_geometries(), strict=True)) if missing else []
        for image in sorted(missing, key=lambda image: image.image_id):
            points = _points_seen(image.image_id, geometries, model)
            keypoints = np.asarray(db.read_keypoints(image.image_id), float)[:, :2]
            known = model.exists_camera(image.camera_id)
            camera = model.camera(image.camera_id) if known else db.read_camera(image.camera_id)
            found[image.name] = (len(points), _agreeing(points, keypoints, camera, model, seed))
    return found


def _points_seen(image_id: int, geometries: list, model: "pycolmap.Reconstruction") -> list[tuple[int, int]]:
    """(keypoint, point) pairs of an image, by its matches with registered images; each pair once."""
    import pycolmap

    seen = set()
    for pair_id, geometry in geometries:
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        if image_id not in (first, second):
            continue
        other, mine = (second, 0) if image_id == first else (first, 1)
        if not (other in model.images and model.image(other).has_pose):
            continue
        places = model.image(other).points2D
        for match in np.asarray(geometry.inlier_matches):
            if (place := places[match[1 - mine]]).has_point3D():
                seen.add((int(match[mine]), int(place.point3D_id)))
    return sorted(seen)


def _agreeing(
    points: list[tuple[int, int]],
    keypoints: np.ndarray,
    camera: "pycolmap.Camera",
    model: "pycolmap.Reconstruction",
    seed: int,
) -> int:
    import pycolmap

    if len(points) < 4:
        return 0
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = seed
    xy = keypoints[[keypoint for keypoint, _ in points]]
    xyz = np.array([model.point3D(point).xyz for _, point in points])
    answer = pycolmap.estimate_absolute_pose(xy, xyz, camera, options)
    return int(answer["num_inliers"]) if answer else 0
