from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.georeference import cartesian
from stages.sfm.pairs import MAX_EXHAUSTIVE
from stages.sfm.pairs.pair_selection import (
    CapturePriors,
    choose,
    closeness,
    exhaustive,
    nearest,
    sequential,
    spanning_tree,
    start_pairs,
    union,
    with_more_pairs,
)


def similarity(count: int, seed: int = 0) -> np.ndarray:
    """Cosines of random unit vectors."""
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors @ vectors.T


def partners(pairs: np.ndarray, count: int) -> list[set[int]]:
    found: list[set[int]] = [set() for _ in range(count)]
    for first, second in pairs.tolist():
        found[first].add(second)
        found[second].add(first)
    return found


def groups(pairs: np.ndarray, count: int) -> int:
    """How many groups of photos hang together."""
    of = list(range(count))
    for first, second in pairs.tolist():
        of = [of[first] if group == of[second] else group for group in of]
    return len(set(of))


def is_proper(pairs: np.ndarray) -> bool:
    rows = pairs.tolist()
    return (
        all(first < second for first, second in rows) and rows == sorted(rows) and len({*map(tuple, rows)}) == len(rows)
    )


def unused() -> np.ndarray:
    raise AssertionError("nobody needs to know what looks alike")


@given(st.integers(1, 20))
def test_exhaustive_is_every_pair_once(count: int) -> None:
    pairs = exhaustive(count)
    assert is_proper(pairs)
    assert len(pairs) == count * (count - 1) // 2
    np.testing.assert_array_equal(start_pairs("exhaustive", 3, count, CapturePriors(), unused), pairs)


@given(st.integers(2, 40), st.integers(1, 50), st.integers(0, 5))
def test_retrieval_begins_with_the_most_similar_and_all_hang_together(count: int, neighbours: int, seed: int) -> None:
    alike = similarity(count, seed)
    pairs = start_pairs("retrieval", neighbours, count, CapturePriors(), lambda: alike)
    assert is_proper(pairs)
    assert groups(pairs, count) == 1
    for photo, found in enumerate(partners(pairs, count)):
        best = sorted(set(range(count)) - {photo}, key=lambda other: -alike[photo, other])[: max(2, neighbours // 4)]
        assert found >= set(best)


def test_separate_groups_are_joined_by_their_likest_pair() -> None:
    alike = np.full((6, 6), -0.5)
    alike[:3, :3] = alike[3:, 3:] = 0.9
    alike[1, 5] = alike[5, 1] = 0.1
    assert groups(nearest(alike, 2), 6) == 2
    assert [1, 5] in start_pairs("retrieval", 2, 6, CapturePriors(), lambda: alike).tolist()


@given(st.integers(1, 12), st.integers(0, 9))
def test_the_spanning_tree_is_the_largest_of_all(count: int, seed: int) -> None:
    """Kruskal: take the likest pairs first, unless their photos hang together already."""
    alike, expected = similarity(count, seed), np.zeros((0, 2), int)
    for pair in sorted(exhaustive(count).tolist(), key=lambda pair: -alike[pair[0], pair[1]]):
        if groups(more := union(expected, np.array([pair])), count) < groups(expected, count):
            expected = more
    np.testing.assert_array_equal(spanning_tree(alike), expected)


def test_ties_go_to_the_lower_number() -> None:
    assert nearest(np.ones((4, 4)), 1).tolist() == [[0, 1], [0, 2], [0, 3]]


@given(st.permutations(range(20)), st.integers(1, 8))
def test_a_sequence_has_its_neighbours_and_powers_of_two(order: list[int], overlap: int) -> None:
    pairs = sequential(np.array(order), overlap)
    assert is_proper(pairs)
    when = np.argsort(order)
    steps = {abs(int(when[first] - when[second])) for first, second in pairs.tolist()}
    assert steps == set(range(1, overlap + 1)) | {1, 2, 4, 8, 16}
    assert len(pairs) == sum(20 - step for step in steps)


def test_a_video_that_returns_is_closed_by_what_looks_alike() -> None:
    angle = 2 * np.pi * np.arange(60) / 60
    around = np.cos(angle[:, None] - angle[None])
    shuffled = np.random.default_rng(0).permutation(60)
    times = np.empty(60)
    times[shuffled] = np.arange(60) / 30
    frame = np.argsort(shuffled)
    alike = around[np.ix_(frame, frame)]
    pairs = start_pairs("sequential", 10, 60, CapturePriors(time_s=times), lambda: alike)
    found = {frozenset(pair) for pair in pairs.tolist()}
    assert frozenset((int(shuffled[0]), int(shuffled[59]))) in found
    assert all(frozenset((int(a), int(b))) in found for a, b in pairwise(shuffled))
    assert len(pairs) < 60 * 10


def test_without_times_a_sequence_goes_by_name() -> None:
    pairs = start_pairs("sequential", 5, 12, CapturePriors(), lambda: similarity(12)).tolist()
    assert all([i, i + 1] in pairs for i in range(11))


@pytest.mark.parametrize(
    ("latitude", "longitude", "step"),
    [
        ([0.0, 0.0], [0.0, 1e-3], 111.3195),  # a thousandth of a degree along the equator, 6378137 m in radius
        ([0.0, 0.0], [179.9995, -179.9995], 111.3195),  # across the date line
        ([89.9995, 89.9995], [0.0, 180.0], 111.694),  # across the pole, where a degree is longest
        ([45.0, 45.0], [200.0, -160.0], 0.0),  # the same place, written otherwise
    ],
)
def test_distances_have_no_seams(latitude: list[float], longitude: list[float], step: float) -> None:
    places = cartesian(np.array(latitude), np.array(longitude), None)
    assert -closeness(places)[0, 1] == pytest.approx(step, rel=1e-4, abs=1e-6)


def test_altitude_is_metres_upwards() -> None:
    low, high = (cartesian(np.array([50.0]), np.array([8.0]), np.array([height])) for height in (100.0, 130.0))
    np.testing.assert_allclose(np.linalg.norm(high - low), 30)


def test_nearest_places_are_those_next_door() -> None:
    """A walk along the date line: the k nearest of a photo are its neighbours along the way."""
    steps = np.arange(20)
    places = cartesian(10 + 1e-4 * steps, np.where(steps % 2, 180.0, -180.0), None)
    walk = union(np.stack([steps[:-1], steps[1:]], axis=1), np.array([[0, 2], [17, 19]]))
    assert nearest(closeness(places), 2).tolist() == walk.tolist()
    alike = similarity(20)
    pairs = start_pairs("spatial", 4, 20, CapturePriors(position_m=places), lambda: alike)
    assert is_proper(pairs) and groups(pairs, 20) == 1
    assert {*map(tuple, walk.tolist())} < {*map(tuple, pairs.tolist())}
    assert min(map(len, partners(pairs, 20))) >= 4


@pytest.mark.parametrize("error_m", [15.0, 0.0], ids=["scattered indoors", "one stale fix"])
def test_where_positions_tell_nothing_looks_choose_half_of_the_partners(error_m: float) -> None:
    """Photos around a room: its likest are partners of each, whatever GPS says."""
    angle = 2 * np.pi * np.arange(120) / 120
    alike = np.cos(angle[:, None] - angle[None])
    places = np.random.default_rng(0).normal(0, error_m, (120, 3))
    found = partners(start_pairs("spatial", 30, 120, CapturePriors(position_m=places), lambda: alike), 120)
    likest = partners(nearest(alike, 14), 120)
    assert all(mine <= theirs for mine, theirs in zip(likest, found, strict=True))
    assert sum(map(len, found)) <= 2 * 120 * 30


def test_missing_photos_get_the_partners_asked_for() -> None:
    alike = similarity(40)
    pairs = nearest(alike, 4)
    again = with_more_pairs(pairs, [3, 17], 12, lambda: alike)
    assert {*map(tuple, pairs.tolist())} < {*map(tuple, again.tolist())}
    assert all(3 in pair or 17 in pair for pair in {*map(tuple, again.tolist())} - {*map(tuple, pairs.tolist())})
    assert 12 <= len(partners(again, 40)[3]) <= 14
    everyone = with_more_pairs(pairs, list(range(40)), 8, lambda: alike)
    assert min(map(len, partners(everyone, 40))) >= 8
    np.testing.assert_array_equal(with_more_pairs(exhaustive(9), [2], 4, unused), exhaustive(9))


def test_pairs_are_chosen_of_sets_above_ordinary_size() -> None:
    assert choose(MAX_EXHAUSTIVE, 30, CapturePriors()) == "exhaustive"
    assert choose(MAX_EXHAUSTIVE + 1, 30, CapturePriors()) == "retrieval"


def test_time_and_place_are_used_where_they_are_known() -> None:
    along = np.arange(200.0)
    street = np.stack([5 * along, 0 * along, 0 * along], axis=1)
    assert choose(200, 30, CapturePriors(time_s=along, position_m=street)) == "sequential"
    assert choose(200, 30, CapturePriors(position_m=street)) == "spatial"
    assert choose(200, 30, CapturePriors(position_m=street / 100)) == "retrieval", (
        "GPS does not tell photos in a room apart"
    )
