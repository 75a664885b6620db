"""Intrinsics of a few photos that hang together: what mapping of many begins with."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from stages.io.photos import Photo
from stages.sfm.checked_mapping import calibrate_by_few
from stages.sfm.colmap.database.calibration import set_focal_length
from stages.sfm.colmap.database.images import fill_database
from stages.sfm.colmap.database.matching import best_linked, match_pairs
from stages.sfm.retry_strategies import MappingOptions
from tests.stages.sfm.pairs.test_feature_matching import random_descriptors

PHOTOS, SIZE, FOCAL, DISTORTION = 14, (320, 240), 300.0, -0.05


def rotation_matrix(axis_angle: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(axis_angle)[0]


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos along a wall in relief, by hand; the last one sees nothing of it. The focal length in the
    database is a tenth too long, and nothing there tells the distortion."""
    path, random = tmp_path_factory.mktemp("strip") / "matches.db", np.random.default_rng(0)
    photos = [Photo(f"{i}.png", f"images/{i}.png", *SIZE, 0, None, None, False, 1.0) for i in range(PHOTOS)]
    fill_database(path, photos, "SIMPLE_RADIAL")
    points = random.uniform((-2, -1, 2.0), (9, 1, 3.0), (2500, 3))
    looks = random_descriptors(len(points), 0)
    with pycolmap.Database.open(path) as db:
        for number in range(PHOTOS):
            away = (0.5 * number, 0.1 * (number % 3), 0.0) if number < PHOTOS - 1 else (-50.0, 0.0, 0.0)
            seen = (points - away) @ rotation_matrix(random.uniform(-0.15, 0.15, 3))
            flat = seen[:, :2] / seen[:, 2:]
            xy = FOCAL * flat * (1 + DISTORTION * (flat**2).sum(axis=1, keepdims=True)) + np.array(SIZE) / 2
            xy += random.normal(scale=0.1, size=xy.shape)
            inside = ((xy > 0) & (xy < SIZE)).all(axis=1)
            shapes = np.tile([1, 0, 0, 1], (int(inside.sum()), 1))
            db.write_keypoints(number + 1, np.hstack([xy[inside], shapes]).astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(number + 1, pycolmap.FeatureDescriptors(data=looks[inside], type=kind))
        camera = db.read_camera(1)
        set_focal_length(camera, 1.1 * FOCAL)
        camera.has_prior_focal_length = True
        db.update_camera(camera)
    pairs = np.array([(i, j) for i in range(PHOTOS) for j in range(i + 1, min(i + 4, PHOTOS))])
    match_pairs(path, pairs, 0, 0.8)
    return path


def test_the_best_linked_images_hang_together(strip: Path) -> None:
    numbers = sorted(int(name.removesuffix(".png")) for name in best_linked(strip, 5))
    assert numbers == list(range(numbers[0], numbers[0] + 5))
    assert len(best_linked(strip, 50)) == PHOTOS - 1, "the one that sees nothing is linked with none"


def test_few_photos_tell_focal_length_and_distortion(strip: Path, tmp_path: Path) -> None:
    job: Any = SimpleNamespace(seed=0, folder=str(tmp_path))
    state = SimpleNamespace(job=job, images=tmp_path, thinned=True, send=lambda **_: None)
    state.photos = [SimpleNamespace(camera_group=0)] * PHOTOS
    assert calibrate_by_few(strip, MappingOptions(), cast(Any, state))
    with pycolmap.Database.open(strip) as db:
        camera = db.read_camera(1)
    assert camera.has_prior_focal_length
    focal_px, _, _, distortion = camera.params
    assert focal_px == pytest.approx(FOCAL, rel=0.005) and distortion == pytest.approx(DISTORTION, abs=0.005)
