"""COLMAP's synthetic matches and models, with known poses, and what may be wrong with them."""

from collections.abc import Container
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

PHOTOS, FOCAL_PX = 16, 1280.0


class Made(NamedTuple):
    database: Path
    model: Any


def make(folder: Path, points: int = 400, cameras: int = 1) -> Made:
    """Photos around points, all matched with each other, half a pixel of noise; a model with the true poses."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=cameras, num_frames_per_rig=PHOTOS // cameras, num_points3D=points, num_points2D_without_point3D=20
    )
    database = folder / "made.db"
    with pycolmap.Database.open(database) as db:
        model = pycolmap.synthesize_dataset(options, db)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model, db)
    return Made(database, model)


def turn(model: Any, image_id: int, degrees: float) -> None:
    """Turn a registered photo where it stands."""
    image = model.image(image_id)
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.radians([0.0, degrees, 0.0])), np.zeros(3))
    frame = model.frame(image.frame_id)
    frame.rig_from_world = turned * frame.rig_from_world


def turned_alone(made: Made, image_id: int) -> Any:
    """The true model but for one photo that is turned."""
    wrong = pycolmap.Reconstruction(made.model)
    turn(wrong, image_id, degrees=3.0)
    return wrong


def mismatch(database: Path, pairs: Container[tuple[int, int]]) -> None:
    """Let the matches of these pairs join keypoints of different points."""
    random = np.random.default_rng(0)
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            if (pair := pycolmap.pair_id_to_image_pair(pair_id)) in pairs:
                matches = np.array(geometry.inlier_matches)
                matches[:, 1] = random.permutation(matches[:, 1])
                geometry.inlier_matches = matches
                db.delete_two_view_geometry(*pair)
                db.write_two_view_geometry(*pair, geometry)


def look_apart(made: Made) -> None:
    """Turn the photos so that their axes do not meet, with the keypoints and matches that they then have."""
    random = np.random.default_rng(0)
    for image_id in range(1, PHOTOS + 1):
        turn(made.model, image_id, random.uniform(-15, 15))
    with pycolmap.Database.open(made.database) as db, pycolmap.DatabaseTransaction(db):
        camera, keypoints = made.model.camera(1), {}
        for image_id in range(1, PHOTOS + 1):
            image = made.model.image(image_id)
            seen = [point.point3D_id if point.has_point3D() else None for point in image.points2D]
            projected = [None if one is None else image.project_point(made.model.point3D(one).xyz) for one in seen]
            keypoints[image_id] = np.array([(-1.0, -1.0) if one is None else one for one in projected])
            db.update_keypoints(image_id, np.pad(keypoints[image_id], ((0, 0), (0, 4))))
        for pair_id, matches in zip(*db.read_all_matches(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            geometry = pycolmap.estimate_two_view_geometry(
                camera, keypoints[first], camera, keypoints[second], np.asarray(matches, np.uint32)
            )
            db.delete_two_view_geometry(first, second)
            db.write_two_view_geometry(first, second, geometry)


def enter_focal_length(database: Path, focal_px: float, by_exif: bool, model: str | None = None) -> None:
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        old = db.read_camera(1)
        name = model or old.model_name
        camera = pycolmap.Camera.create_from_model_name(1, name, focal_px, old.width, old.height)
        camera.has_prior_focal_length = by_exif
        db.update_camera(camera)


def focal_length(database: Path) -> float:
    with pycolmap.Database.open(database) as db:
        return db.read_camera(1).mean_focal_length()


def verified_pairs(database: Path) -> set[tuple[int, int]]:
    with pycolmap.Database.open(database) as db:
        ids, _ = db.read_two_view_geometries()
    return {pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids}
