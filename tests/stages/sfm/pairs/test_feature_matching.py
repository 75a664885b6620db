import numpy as np
import pytest

from stages.sfm.pairs.feature_matching import (
    BLOCK,
    MAX_DISTANCE,
    PROBES,
    index_features,
    match_descriptors,
    match_indexed,
)
from stages.sfm.pairs.image_retrieval import CELLS, visual_words


def random_descriptors(count: int, seed: int) -> np.ndarray:
    """Bytes of about the length that SIFT's have."""
    values = np.random.default_rng(seed).exponential(size=(count, 128))
    return np.rint(512 * values / np.linalg.norm(values, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def one_by_one(first: np.ndarray, second: np.ndarray, max_ratio: float) -> list[list[int]]:
    """The same by the definition, in whole numbers."""
    squared = ((first[:, None].astype(int) - second[None].astype(int)) ** 2).sum(axis=2)

    def keeps(distances: np.ndarray, chosen: int) -> bool:
        others = np.delete(distances, chosen)
        near = distances[chosen] < MAX_DISTANCE**2
        return near and (not len(others) or distances[chosen] < max_ratio**2 * others.min())

    best = squared.argmin(axis=1)
    return [
        [i, int(j)]
        for i, j in enumerate(best)
        if keeps(squared[i], j) and squared[:, j].argmin() == i and keeps(squared[:, j], i)
    ]


def views(count: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two photos that share half of their features, in another order and with noise."""
    random = np.random.default_rng(seed)
    first, strangers = random_descriptors(count, seed), random_descriptors(count // 2, seed + 1)
    again = first[: count // 2] + random.normal(scale=noise, size=(count // 2, 128))
    second = np.concatenate([strangers, np.rint(again).clip(0, 255).astype(np.uint8)])
    return first, second[random.permutation(len(second))]


@pytest.mark.parametrize("count", [2, 3, BLOCK - 1, BLOCK, 3 * BLOCK + 5])
@pytest.mark.parametrize("max_ratio", [0.8, 0.9])
def test_matches_are_those_of_the_definition(count: int, max_ratio: float) -> None:
    first, second = views(count, noise=18.0)
    assert match_descriptors(first, second, max_ratio).tolist() == one_by_one(first, second, max_ratio)


def test_shared_features_find_each_other() -> None:
    first, second = views(200, noise=3.0)
    matches = match_descriptors(first, second, 0.8)
    assert matches.dtype == np.uint32
    assert matches[:, 0].tolist() == list(range(100))
    off = first[matches[:, 0]].astype(int) - second[matches[:, 1]]
    assert 0 < np.abs(off).max() < 20


def test_it_does_not_matter_which_photo_comes_first() -> None:
    first, second = views(150, noise=18.0)
    there, back = match_descriptors(first, second, 0.9), match_descriptors(second, first, 0.9)
    assert len(there) > 20
    assert sorted(there.tolist()) == sorted(back[:, ::-1].tolist())


def test_what_repeats_is_not_matched() -> None:
    first, second = views(40, noise=0.0)
    assert len(match_descriptors(first, second, 0.8)) == 20
    assert len(match_descriptors(first, np.concatenate([second, second]), 0.8)) == 0
    assert len(match_descriptors(np.concatenate([first, first]), second, 0.8)) == 0


def test_far_descriptors_are_not_matched() -> None:
    here, far = np.zeros((1, 128), np.uint8), np.zeros((1, 128), np.uint8)
    for square, expected in ((358, 1), (359, 0)):  # MAX_DISTANCE is 358.4
        far[0, :2] = 255, round((square**2 - 255**2) ** 0.5)
        assert len(match_descriptors(here, far, 0.8)) == expected


def test_the_largest_bytes_are_told_apart_exactly() -> None:
    """Scores of four million differ by a half: float32 must not round anywhere on the way."""
    bright = np.full((3, 128), 255, np.uint8)
    bright[1, 0], bright[2, :2] = 254, 254
    assert match_descriptors(bright, bright, 0.8).tolist() == [[0, 0], [1, 1], [2, 2]]


@pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 5), (5, 0)])
def test_no_features_no_matches(first: int, second: int) -> None:
    found = match_descriptors(random_descriptors(5, 0)[:first], random_descriptors(5, 1)[:second], 0.8)
    assert found.shape == (0, 2)


# --- by a vocabulary


def indexed(first: np.ndarray, second: np.ndarray, words: np.ndarray, max_ratio: float = 0.8) -> list[list[int]]:
    return match_indexed(index_features(first, words), index_features(second, words), max_ratio).tolist()


def words_of(descriptors: np.ndarray) -> np.ndarray:
    return np.rint(visual_words(descriptors.astype(np.float32), np.random.default_rng(0), CELLS))


def test_probing_all_cells_matches_exactly() -> None:
    first, second = views(300, noise=18.0)
    words = words_of(first)[:PROBES]
    assert indexed(first, second, words) == match_descriptors(first, second, 0.8).tolist()


def test_indexed_matches_are_nearly_all_and_hardly_any_others() -> None:
    first, second = views(2000, noise=8.0)
    exact = {*map(tuple, match_descriptors(first, second, 0.8).tolist())}
    found = {*map(tuple, indexed(first, second, words_of(np.concatenate([first, second]))))}
    assert 0.95 * len(exact) < len(exact & found) <= len(exact) and len(exact) > 900
    assert len(found - exact) < 0.02 * len(exact)


def test_indexed_matches_do_not_depend_on_which_photo_comes_first() -> None:
    first, second = views(800, noise=8.0)
    words = words_of(np.concatenate([first, second]))
    assert indexed(first, second, words) == sorted([i, j] for j, i in indexed(second, first, words))


@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (0, 0), (1, 1)])
def test_photos_with_hardly_any_features_are_indexed_too(counts: tuple[int, int]) -> None:
    words = words_of(random_descriptors(300, 7))
    first, second = (random_descriptors(count, 3) for count in counts)
    assert indexed(first, second, words) == ([[0, 0]] if min(counts) else [])
