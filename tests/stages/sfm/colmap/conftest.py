from pathlib import Path

import numpy as np
import pycolmap
import pytest

from stages.io.photos import Photo
from stages.sfm.colmap.database.images import fill_database
from tests.stages.sfm.colmap.made_models import Made, make
from tests.stages.sfm.pairs.test_feature_matching import random_descriptors

COUNT = 6


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Six photos by a camera that moves sideways along a cloud of points; the last one sees another cloud."""
    path, random = tmp_path / "matches.db", np.random.default_rng(0)
    photos = [Photo(f"{i}.png", f"images/{i}.png", 320, 240, 0, None, None, False, 1.0) for i in range(COUNT)]
    fill_database(path, photos, "SIMPLE_RADIAL")
    points = random.uniform((-3, -1, 3), (3, 1, 6), (400, 3))
    alike = random_descriptors(400, 0)
    with pycolmap.Database.open(path) as db:
        for photo in range(COUNT):
            seen = points - np.array([0.3 * photo - 0.75, 0, 0])
            places = 300 * seen[:, :2] / seen[:, 2:] + (160, 120) + random.normal(scale=0.3, size=(400, 2))
            inside = ((places > 0) & (places < (320, 240))).all(axis=1)
            noisy = alike if photo < COUNT - 1 else random_descriptors(400, 1)
            noisy = np.rint(noisy + random.normal(scale=8, size=(400, 128))).clip(0, 255).astype(np.uint8)
            shapes = np.tile([1, 0, 0, 1], (int(inside.sum()), 1))
            db.write_keypoints(photo + 1, np.hstack([places[inside], shapes]).astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(photo + 1, pycolmap.FeatureDescriptors(data=noisy[inside], type=kind))
    return path


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """A model with the true poses, and its matches."""
    return make(tmp_path)
