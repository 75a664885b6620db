"""Copies of COLMAP's database with fewer matches or with other cameras."""

from collections.abc import Container, Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool

from stages.sfm.colmap.database.files import changed_copy
from stages.sfm.colmap.database.images import enter_camera, enter_image, fisheye_focal_px
from stages.sfm.colmap.database.matching import verify_again

FISHEYE_MODEL = "SIMPLE_RADIAL_FISHEYE"


def copy_without_matches_of(names: Container[str], database: Path, copy: Path) -> None:
    """Copy the database, less every pair with one of these photos; nothing where the copy is there already."""
    if copy.exists():
        return
    with changed_copy(database, copy) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        for first, second in combinations(images, 2):
            if first.name in names or second.name in names:
                db.delete_matches(first.image_id, second.image_id)
                db.delete_two_view_geometry(first.image_id, second.image_id)


def copy_without_pairs(database: Path, copy: Path, pairs: Iterable[Sequence[int]]) -> None:
    """Copy the database less what was verified of these pairs of image ids."""
    with changed_copy(database, copy) as db:
        for first, second in pairs:
            db.delete_two_view_geometry(first, second)


def copy_with_cameras_of(model: pycolmap.Reconstruction, database: Path, copy: Path) -> None:
    """Copy keypoints and verified matches to a database whose images, numbered as in the model, have its cameras."""
    with (
        pycolmap.Database.open(database) as db,
        pycolmap.Database.open(copy) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        for camera in model.cameras.values():
            enter_camera(new, camera)
        for image_id, image in sorted(model.images.items()):
            enter_image(new, image.name, image.camera_id, image_id)
            new.write_keypoints(image_id, db.read_keypoints(image_id))
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            new.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(pair_id), geometry)


def copy_as_fisheye(database: Path, copy: Path, seed: int) -> None:
    """Copy the database, its cameras become fisheyes and its matches verified anew; nothing where it is there.

    Without EXIF the focal length is :func:`fisheye_focal_px`, and counts as known.
    """
    if copy.exists():
        return
    with changed_copy(database, copy) as db:
        for camera in db.read_all_cameras():
            size = camera.width, camera.height
            focal_px = camera.mean_focal_length() if camera.has_prior_focal_length else fisheye_focal_px(*size)
            fisheye = pycolmap.Camera.create_from_model_name(camera.camera_id, FISHEYE_MODEL, focal_px, *size)
            fisheye.has_prior_focal_length = True
            db.update_camera(fisheye)
        verify_again(db, seed)


def keep_inliers(
    db: pycolmap.Database, pair: tuple[int, int], geometry: pycolmap.TwoViewGeometry, keep: Bool[np.ndarray, "n"]
) -> None:
    """Leave only some of the verified matches of a pair of image ids, which it is deleted without."""
    db.delete_two_view_geometry(*pair)
    if keep.any():
        geometry.inlier_matches = np.asarray(geometry.inlier_matches)[keep].astype(np.uint32)
        db.write_two_view_geometry(*pair, geometry)
