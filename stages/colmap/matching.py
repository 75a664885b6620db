"""Features and matches: everything that fills COLMAP's database. Call it in a child process."""

import os
import shutil
import time
from collections.abc import Callable, Container, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.feature_matching import match_descriptors
from stages.pairing import Pairs, Similarity
from stages.retrieval import photo_similarity

if TYPE_CHECKING:
    import pycolmap

    from stages.photos import Photo

FOCAL_GUESS = 1.2  # focal length over the longer side where EXIF is silent: 45 degrees, a phone's wide lens
UPSAMPLE_UP_TO_PX = 1024  # smaller photos yield too few features at their own size
# Lowe's ratio: 0.8 is SIFT's own. 0.9 lets in many mismatches, most of which verification throws out again, and
# finds views that lie farther apart; only photos that otherwise stay without a place are matched like that.
STRICT_RATIO = 0.8
LOOSE_RATIO = 0.9
BLOCK_SIZE = 32  # pairs of photos that are committed at once (progress, resuming)
CACHED_PHOTOS = 256  # whose features are held in memory, about half a megabyte each


def fill_database(database: Path, photos: "Sequence[Photo]", camera_model: str) -> None:
    """Enter photos (in order of ``file``) and one camera per camera group, all or nothing."""
    import pycolmap

    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        if db.num_images():
            return
        camera_ids: dict[int, int] = {}
        for image_id, photo in enumerate(photos, start=1):
            if photo.camera_group not in camera_ids:
                camera_ids[photo.camera_group] = _enter_camera(db, photo, camera_model, len(camera_ids) + 1)
            camera_id = camera_ids[photo.camera_group]
            image = pycolmap.Image(name=_name(photo), camera_id=camera_id, image_id=image_id)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def _enter_camera(db: "pycolmap.Database", photo: "Photo", camera_model: str, camera_id: int) -> int:
    import pycolmap

    focal_px = photo.focal_px or FOCAL_GUESS * max(photo.width, photo.height)
    camera = pycolmap.Camera.create_from_model_name(camera_id, camera_model, focal_px, photo.width, photo.height)
    camera.has_prior_focal_length = photo.focal_px is not None
    db.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    db.write_rig(rig, use_rig_id=True)
    return camera_id


def _name(photo: "Photo") -> str:
    """The photo's name inside COLMAP."""
    return photo.file.removeprefix("images/")


def extract_features(
    database: Path, images: Path, photos: "Sequence[Photo]", max_image_size: int, max_features: int
) -> None:
    """SIFT keypoints and descriptors of every photo that has none yet; alpha is ignored.

    Photos are searched from their own size down. Doubling them first, as is COLMAP's habit, costs 4.5 times as
    much and moves no camera of a well-sized photo (benchmarks/sfm_accuracy.py), so only small ones are doubled.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = max_image_size
    options.sift.max_num_features = max_features
    small = {_name(p) for p in photos if max(p.width, p.height) <= UPSAMPLE_UP_TO_PX}
    for first_octave, is_small in ((-1, True), (0, False)):
        names = [name for name in map(_name, photos) if (name in small) is is_small]
        if names:
            options.sift.first_octave = first_octave
            pycolmap.extract_features(database, images, names, extraction_options=options, device=pycolmap.Device.cpu)


def match_pairs(
    database: Path,
    pairs: Pairs,
    seed: int,
    max_ratio: float,
    on_expected: Callable[[int, float], None] = lambda left, seconds: None,
) -> None:
    """Match and verify these pairs of photos (numbered from 0) where that has not been done yet.

    ``max_ratio`` is Lowe's: the best match must be nearer than this share of the second best. ``on_expected`` is told
    how many pairs there are to match and how long it will take, once a first block, spread over all, is done.
    """
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    with pycolmap.Database.open(database) as db, ThreadPoolExecutor(os.cpu_count()) as pool:
        todo = _spread([(i, j) for i, j in pairs.tolist() if not db.exists_two_view_geometry(i + 1, j + 1)])
        photo = lru_cache(CACHED_PHOTOS)(partial(_read_photo, db))
        for begin in range(0, len(todo), BLOCK_SIZE):
            block = todo[begin : begin + BLOCK_SIZE]
            started = time.monotonic()
            work = [pool.submit(_match, photo(i), photo(j), max_ratio, options) for i, j in block]
            with pycolmap.DatabaseTransaction(db):
                for (i, j), (matches, geometry) in zip(block, (each.result() for each in work), strict=True):
                    db.write_matches(i + 1, j + 1, matches)
                    db.write_two_view_geometry(i + 1, j + 1, geometry)
            if not begin:
                on_expected(len(todo), (time.monotonic() - started) * len(todo) / len(block))


def _spread(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same pairs, a block from all over them first: what it costs then holds for the rest."""
    step = max(1, len(pairs) // BLOCK_SIZE)
    first = pairs[::step][:BLOCK_SIZE]
    chosen = set(first)
    return first + [pair for pair in pairs if pair not in chosen]


class _Photo(NamedTuple):
    camera: "pycolmap.Camera"
    places: np.ndarray  # (keypoints, 2), pixels
    descriptors: np.ndarray  # (keypoints, 128), bytes


def _read_photo(db: "pycolmap.Database", photo: int) -> _Photo:
    camera = db.read_camera(db.read_image(photo + 1).camera_id)
    keypoints = np.array(db.read_keypoints(photo + 1), float).reshape(-1, 6)
    return _Photo(camera, keypoints[:, :2], read_descriptors(db, photo))


def look_alike(database: Path, count: int, seed: int) -> Similarity:
    """How much any two photos look alike, by their features."""
    import pycolmap

    with pycolmap.Database.open(database) as db:
        return photo_similarity(partial(read_descriptors, db), count, seed)


def read_descriptors(db: "pycolmap.Database", photo: int) -> np.ndarray:
    """Of the photo with this number, (keypoints, 128) bytes."""
    return np.array(db.read_descriptors(photo + 1).data, np.uint8).reshape(-1, 128)


def _match(
    first: _Photo, second: _Photo, max_ratio: float, options: "pycolmap.TwoViewGeometryOptions"
) -> "tuple[np.ndarray, pycolmap.TwoViewGeometry]":
    """Matches, and the geometry of two views with those that it explains: none where they are too few."""
    import pycolmap

    matches = match_descriptors(first.descriptors, second.descriptors, max_ratio)
    views = first.camera, first.places, second.camera, second.places
    return matches, pycolmap.estimate_two_view_geometry(*views, matches, options)


def copy_without_matches_of(names: Container[str], database: Path, copy: Path) -> None:
    """Copy the database, less every pair with one of these photos; nothing where the copy is there already."""
    import pycolmap

    if copy.exists():
        return
    unfinished = copy.with_suffix(".unfinished")
    for part in ("", "-wal"):  # as long as anybody reads along, the latest pages stay in the write-ahead log
        unfinished.with_name(unfinished.name + part).unlink(missing_ok=True)
        if (source := database.with_name(database.name + part)).exists():
            shutil.copyfile(source, unfinished.with_name(unfinished.name + part))
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        for first, second in combinations(images, 2):
            if first.name in names or second.name in names:
                db.delete_matches(first.image_id, second.image_id)
                db.delete_two_view_geometry(first.image_id, second.image_id)
    unfinished.replace(copy)
