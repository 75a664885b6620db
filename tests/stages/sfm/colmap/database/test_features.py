from pathlib import Path

import numpy as np
import pycolmap
import pytest

import stages.sfm.colmap.database.features as features_module
from stages.sfm.colmap.database.features import Features, image_similarity
from tests.stages.sfm.colmap.conftest import COUNT


@pytest.mark.parametrize(("least", "free_bytes", "read"), [(2, 0, 12), (2, 1e9, 6), (6, 0, 6)])
def test_features_stay_in_memory_as_long_as_there_is_room(
    least: int, free_bytes: float, read: int, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = np.random.default_rng(1).integers(0, 60, (8, 128)).astype(np.float32)
    monkeypatch.setattr(features_module, "MIN_CACHED_PHOTOS", least)
    monkeypatch.setattr(features_module, "available_bytes", lambda: free_bytes)
    indexed, real = [], features_module.index_features
    monkeypatch.setattr(features_module, "index_features", lambda *args: indexed.append(args) or real(*args))
    features = Features(words)
    with pycolmap.Database.open(database) as db:
        for photo in [*range(COUNT), *range(COUNT)]:
            assert len(features.read(db, photo)().keypoints) > 200
    assert len(indexed) == read


def test_the_bytes_of_features_are_counted(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features_module, "MIN_CACHED_PHOTOS", 1)
    each = 400 * (128 + 2 * 8)  # at most: not all points are in all photos
    monkeypatch.setattr(features_module, "available_bytes", lambda: 3 * each / features_module.CACHE_SHARE)
    features, opened = Features(), []
    real = features_module.read_descriptors
    monkeypatch.setattr(features_module, "read_descriptors", lambda db, photo: opened.append(photo) or real(db, photo))
    with pycolmap.Database.open(database) as db:
        for photo in (0, 1, 2, 0, 3, 4, 0, 1):
            features.read(db, photo)
    assert opened == [0, 1, 2, 3, 4, 1]


def test_photos_of_the_same_points_look_alike(database: Path) -> None:
    alike = image_similarity(database, COUNT, seed=0)
    assert alike.shape == (COUNT, COUNT)
    assert alike[:-1, -1].max() < alike[:-1, :-1].min()
