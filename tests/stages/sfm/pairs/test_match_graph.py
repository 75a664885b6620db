from dataclasses import replace

import numpy as np
import pytest

from stages.io.photos import Photo
from stages.sfm.pairs.match_graph import (
    MAX_NEW_PARTNERS,
    MAX_WEAK_CUT_EDGES,
    MIN_INLIERS,
    UNTESTED,
    across_weak_cuts,
    candidate_orders,
    connected,
    inlier_matrix,
    natural_order,
    neighbour_overlap,
    next_pairs,
    order_is_informative,
    pairs_apart,
    weak_cuts,
)
from stages.sfm.pairs.pair_selection import Pairs, nearest, spanning_tree, union


def walk(count: int, reach: int) -> np.ndarray:
    """Verified matches along a way: 400 with the next photo, fewer the farther, none beyond ``reach``."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count)[None])
    return np.where((apart > 0) & (apart <= reach), 400 // np.maximum(apart, 1), 0)


def grown(truth: np.ndarray, similarity: np.ndarray, neighbours: int) -> Pairs:
    pairs = union(nearest(similarity, 4), spanning_tree(similarity))
    for _ in range(8):
        inliers = inlier_matrix(len(truth), pairs, truth[pairs[:, 0], pairs[:, 1]])
        pairs = union(pairs, next_pairs(inliers, similarity, neighbours))
    return pairs


def noisy_similarity(truth: np.ndarray, noise: float) -> np.ndarray:
    random = np.random.default_rng(0).normal(scale=noise, size=truth.shape)
    return truth / 400 + random + random.T


def test_growing_finds_true_neighbours_that_retrieval_missed() -> None:
    truth = walk(120, reach=8)
    similarity = noisy_similarity(truth, noise=0.25)
    links = np.argwhere(np.triu(truth >= MIN_INLIERS))
    start, pairs = (
        {*map(tuple, some.tolist())} for some in (nearest(similarity, 4), grown(truth, similarity, neighbours=20))
    )
    found, before = (np.mean([tuple(link) in of for link in links.tolist()]) for of in (pairs, start))
    assert before < 0.4 < 0.75 < found
    assert len(pairs) < 120 * 119 / 2 / 3


def test_growing_stops_where_every_photo_was_tried_with_enough() -> None:
    truth = walk(60, reach=59)
    tried = inlier_matrix(60, (pairs := pairs_apart(np.arange(60), 1, 10)), truth[pairs[:, 0], pairs[:, 1]])
    assert len(next_pairs(tried, truth / 400.0, neighbours=9)) < 60
    assert len(next_pairs(np.where(tried == UNTESTED, 0, tried), truth / 400.0, neighbours=30)) == 0


def test_two_parts_of_the_graph_are_tried_with_each_other() -> None:
    truth = np.zeros((20, 20), int)
    truth[:10, :10] = truth[10:, 10:] = 300
    np.fill_diagonal(truth, 0)
    pairs = np.argwhere(np.triu(truth > 0))
    similarity = np.full((20, 20), 0.1)
    similarity[3, 14] = similarity[14, 3] = 0.9
    more = next_pairs(inlier_matrix(20, pairs, truth[pairs[:, 0], pairs[:, 1]]), similarity, neighbours=30)
    assert [3, 14] in more.tolist()
    assert ((more < 10).sum(axis=1) == 1).all()


def test_smaller_sides_are_tried_with_what_is_most_similar_across() -> None:
    """Fronds of one to six photos hang by one edge each on a ring: every one of them is a weak cut."""
    truth = walk(40, reach=2)
    fronds = [range(40, 41), range(41, 44), range(44, 50)]
    count = 50
    inliers = np.full((count, count), UNTESTED)
    inliers[:40, :40] = np.where(truth > 0, truth, UNTESTED)
    for place, frond in enumerate(fronds):
        inliers[np.ix_(frond, frond)] = 300
        inliers[frond[0], 10 * place] = inliers[10 * place, frond[0]] = 100
    untested = np.where(inliers == UNTESTED, np.rint(9 * noisy_similarity(inliers, 0.4)), -np.inf)  # with ties
    np.fill_diagonal(untested, -np.inf)
    found, expected = {*map(tuple, across_weak_cuts(inliers, untested).tolist())}, set()
    cuts = weak_cuts(np.where(inliers >= MIN_INLIERS, inliers, 0).astype(float))
    sides = cuts.side[cuts.edges <= MAX_WEAK_CUT_EDGES]
    assert {tuple(frond) for frond in fronds} <= {tuple(np.flatnonzero(side).tolist()) for side in sides}
    for side in sides:
        for photo in np.flatnonzero(side).tolist():
            across = [i for i in range(count) if not side[i] and np.isfinite(untested[photo, i])]
            best = sorted(across, key=lambda i: -untested[photo, i])[:MAX_NEW_PARTNERS]
            expected |= {(min(photo, i), max(photo, i)) for i in best}
    assert found == expected and len(found) > 40


def test_overlap_is_that_of_verified_neighbours() -> None:
    overlap = neighbour_overlap(walk(30, reach=3))
    np.testing.assert_allclose(np.diag(overlap), 1)
    assert overlap[10, 11] > overlap[10, 13] > overlap[10, 15] > overlap[10, 20] == 0


@pytest.mark.parametrize(("shuffled", "informative"), [(False, True), (True, False)])
def test_order_is_informative_unless_names_are_shuffled(shuffled: bool, informative: bool) -> None:
    truth = walk(60, reach=40)
    order = np.random.default_rng(1).permutation(60) if shuffled else np.arange(60)
    pairs = union(pairs_apart(order, 1, 2), nearest(truth.astype(float), 8))
    assert order_is_informative(order, inlier_matrix(60, pairs, truth[pairs[:, 0], pairs[:, 1]])) is informative


def test_numbers_in_names_count_as_numbers() -> None:
    names = ["b/img2.jpg", "b/img10.jpg", "a/IMG_3.JPG", "b/img1.jpg", "a/img_12.jpg"]
    assert [names[i] for i in natural_order(names)] == [
        "a/IMG_3.JPG",
        "a/img_12.jpg",
        "b/img1.jpg",
        "b/img2.jpg",
        "b/img10.jpg",
    ]


def test_digits_that_are_no_decimals_are_letters() -> None:
    assert natural_order(["5²3.jpg", "5²20.jpg"]).tolist() == [0, 1]


def test_weak_cuts_find_groups_that_hang_by_a_thread() -> None:
    weight = np.zeros((12, 12))
    weight[:8, :8] = weight[8:11, 8:11] = 100
    weight[7, 8] = weight[8, 7] = 40
    weight[6, 9] = weight[9, 6] = 5
    np.fill_diagonal(weight, 0)
    cuts = weak_cuts(weight)
    by_side = {tuple(np.flatnonzero(side).tolist()): (edges, total) for side, edges, total in zip(*cuts, strict=True)}
    assert by_side[(8, 9, 10)] == (2, 45)
    assert by_side[(11,)] == (0, 0)
    assert all(2 * side.sum() <= 11 for side in cuts.side)


def test_the_largest_component_is_number_0() -> None:
    edges = np.zeros((6, 6), bool)
    edges[0, 1] = edges[2, 3] = edges[3, 4] = True
    assert connected(edges).tolist() == [1, 1, 0, 0, 0, 2]


@pytest.mark.parametrize(
    ("clocks", "orders"),
    [
        ([None, 3.0, 1.0], [[0, 1, 2]]),  # one does not tell
        ([5.0, 5.0, 6.0], [[0, 1, 2]]),  # within a second by name, and so the same order
        ([2.0, 3.0, 1.0], [[2, 0, 1], [0, 1, 2]]),
    ],
)
def test_photos_may_follow_each_other_by_clock_or_by_name(clocks: list[float | None], orders: list[list[int]]) -> None:
    photos = [
        Photo(f"{number}.jpg", f"images/{number}.jpg", 8, 8, 0, None, None, False, 1.0, clock_s=clock)
        for number, clock in enumerate(clocks)
    ]
    assert [order.tolist() for order in candidate_orders(photos)] == orders
    frames = [replace(photo, time_s=float(number), clock_s=None) for number, photo in enumerate(photos)]
    assert [order.tolist() for order in candidate_orders(frames)] == [[0, 1, 2]]
