"""Photos' features as they are read from COLMAP's database: for matching, and for how similar photos are."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float

from stages.hardware import cluster
from stages.hardware.memory import available_bytes
from stages.sfm.pairs.feature_matching import index_features
from stages.sfm.pairs.image_retrieval import WORDS, Words, photo_similarity, vocabulary
from stages.sfm.pairs.pair_selection import SimilarityMatrix

# Features are held in memory for so many photos at least, and for more as long as they take no more than this share of
# what is free. Of 4096 features indexed ones take 2.5 MB, others 0.6.
MIN_CACHED_PHOTOS, CACHE_SHARE = 256, 0.25


class PhotoFeatures(NamedTuple):
    """What matching and verification need of a photo."""

    camera: pycolmap.Camera
    keypoints: np.ndarray  # (keypoints, 2), pixels
    features: Any  # descriptors, (keypoints, 128) bytes, or IndexedFeatures of them


SharedFeatures = Callable[[], PhotoFeatures]
"""As they reach whoever matches, on this machine or another one."""


class Features:
    """Photos' features as they are compared: exactly, or with ``words`` by an inverted file, which takes a fifth of the
    time and misses two matches in a hundred. The latest photos are kept."""

    def __init__(self, words: Words | None = None) -> None:
        self._words, self._room = words, CACHE_SHARE * available_bytes()
        self._photos: dict[int, tuple[SharedFeatures, int]] = {}
        self._bytes = 0

    def read(self, db: pycolmap.Database, photo: int) -> SharedFeatures:
        """Those of the photo with this number, for work anywhere."""
        if (found := self._photos.pop(photo, None)) is None:
            camera = db.read_camera(db.read_image(photo + 1).camera_id)
            keypoints = read_keypoints(db, photo + 1).copy()  # without the shapes beside them
            features: Any = read_descriptors(db, photo)
            if self._words is not None:
                features = index_features(features, self._words)
            arrays = [features] if self._words is None else vars(features).values()
            size = keypoints.nbytes + sum(array.nbytes for array in arrays)
            found = cluster.share(PhotoFeatures(camera, keypoints, features)), size
            self._bytes += size
        self._photos[photo] = found  # the latest last
        while len(self._photos) > MIN_CACHED_PHOTOS and self._bytes > self._room:
            self._bytes -= self._photos.pop(next(iter(self._photos)))[1]
        return found[0]


def read_descriptors(db: pycolmap.Database, photo: int) -> np.ndarray:
    """Of the photo with this number, (keypoints, 128) bytes."""
    return np.array(db.read_descriptors(photo + 1).data, np.uint8).reshape(-1, 128)


def read_keypoints(db: pycolmap.Database, image_id: int) -> Float[np.ndarray, "keypoints 2"]:
    """Where an image's keypoints are, in pixels."""
    return np.array(db.read_keypoints(image_id), float).reshape(-1, 6)[:, :2]


def read_vocabulary(database: Path, count: int, seed: int, words: int) -> Words:
    """So many visual words of these photos' features."""
    with pycolmap.Database.open(database) as db:
        return vocabulary(partial(read_descriptors, db), count, seed, words)


def image_similarity(database: Path, count: int, seed: int) -> SimilarityMatrix:
    """How much any two photos look alike, by their features."""
    words = read_vocabulary(database, count, seed, WORDS)
    with pycolmap.Database.open(database) as db:
        return photo_similarity(partial(read_descriptors, db), count, words)
