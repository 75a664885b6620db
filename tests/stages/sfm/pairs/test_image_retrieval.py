from collections.abc import Callable

import numpy as np

from stages.sfm.pairs.image_retrieval import photo_similarity, visual_words, vlad, vocabulary
from tests.stages.sfm.pairs.test_feature_matching import random_descriptors


def walk(photos: int, features: int = 60, step: int = 20) -> list[np.ndarray]:
    """Descriptors of photos along a way: neighbours share two thirds, the next but one a third, the others nothing."""
    world = random_descriptors(features + step * (photos - 1), 0)
    noise = np.random.default_rng(1)
    return [
        (world[step * i : step * i + features] + noise.normal(scale=6, size=(features, 128)))
        .clip(0, 255)
        .astype(np.uint8)
        for i in range(photos)
    ]


def similarity(descriptors: Callable[[int], np.ndarray], count: int, seed: int = 0) -> np.ndarray:
    return photo_similarity(descriptors, count, vocabulary(descriptors, count, seed))


def test_photos_with_shared_features_are_similar_in_order() -> None:
    photos = walk(30)
    alike = similarity(photos.__getitem__, 30)
    ranked = np.argsort(-np.where(np.eye(30, dtype=bool), -np.inf, alike), axis=1)
    for photo in range(2, 28):
        assert set(ranked[photo, :2]) == {photo - 1, photo + 1}
        assert set(ranked[photo, 2:4]) == {photo - 2, photo + 2}


def test_similarity_is_a_cosine() -> None:
    alike = similarity(walk(8).__getitem__, 8)
    np.testing.assert_allclose(np.diag(alike), 1, atol=1e-5)
    np.testing.assert_array_equal(alike, alike.T)
    assert alike.min() >= -1.0001


def test_it_is_a_function_of_features_and_seed() -> None:
    photos = walk(8)
    once, again, other = (similarity(photos.__getitem__, 8, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(once, again)
    assert (once != other).any()


def test_the_order_of_features_does_not_matter() -> None:
    features = walk(1)[0].astype(np.float32)
    words = visual_words(features, np.random.default_rng(0))
    np.testing.assert_allclose(vlad(features[::-1], words), vlad(features, words), atol=1e-5)


def test_a_pattern_that_repeats_counts_once() -> None:
    features = walk(1)[0].astype(np.float32)
    words = visual_words(walk(9)[8].astype(np.float32), np.random.default_rng(0))
    np.testing.assert_allclose(vlad(np.concatenate([features] * 5), words), vlad(features, words), atol=1e-5)


def test_words_are_centres_of_what_is_nearest_to_them() -> None:
    blobs = np.repeat(255 * np.eye(128, dtype=np.float32)[:5], 40, axis=0)
    blobs += np.random.default_rng(0).normal(size=blobs.shape).astype(np.float32)
    words = visual_words(blobs, np.random.default_rng(0))
    to_word = np.linalg.norm(blobs[:, None] - words[None], axis=2).min(axis=1)
    assert 0 < to_word.mean() < 12


def test_photos_without_features_look_like_nothing() -> None:
    photos = [*walk(3), np.zeros((0, 128), np.uint8)]
    alike = similarity(photos.__getitem__, 4)
    assert np.isfinite(alike).all()
    assert (alike[3] == 0).all()
    nothing = similarity(lambda photo: np.zeros((0, 128), np.uint8), 3)
    np.testing.assert_array_equal(nothing, np.zeros((3, 3)))
