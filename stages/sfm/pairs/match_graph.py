"""The match graph: photos, and between them the pairs that were matched and verified. Which pairs to try next.

Only verification decides about a pair. It starts with neighbours in order and similar photos, and goes on to where
verified pairs point: to photos whose verified neighbours are the same, to photos with few verified pairs, and across
the graph's weak cuts, until every photo has been tried with enough others.

``inliers`` is symmetric: the verified matches of each pair, 0 where a pair failed, UNTESTED where it was not tried.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from stages.io.photos import Photo
from stages.sfm.pairs.pair_selection import Pairs, SimilarityMatrix, spanning_tree, union

UNTESTED = -1
MIN_INLIERS = 30  # verified matches from which on a pair links two photos; mapping asks a photo for as many
MAX_COUNTED_INLIERS = 400  # verified matches; a pair with more says no more about which photos look at the same things
ORDER_OVERLAP = 5  # photos before and after each in the order of names or time that are tried with it
MAX_NEW_PARTNERS = 4  # untested partners of each photo that are tried in a round
MIN_OVERLAP = 0.05  # cosine of two photos' verified neighbours, from which on it is worth trying the pair
MIN_YIELD = 0.25  # share of a round's pairs that must turn out as links for another round
MAX_GROWTH_ROUNDS = 8
MAX_WEAK_CUT_EDGES = 3  # of links across a cut that is weak: untested pairs across it are added


def inlier_matrix(count: int, pairs: Pairs, inliers: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "photos photos"]:
    """The symmetric matrix of the graph."""
    matrix = np.full((count, count), UNTESTED)
    matrix[pairs[:, 0], pairs[:, 1]] = matrix[pairs[:, 1], pairs[:, 0]] = inliers
    return matrix


def pairs_apart(order: Int[np.ndarray, "photos"], first: int, last: int) -> Pairs:
    """Photos that are ``first`` to ``last`` positions apart in ``order``."""
    steps = range(first, min(last, len(order) - 1) + 1)
    return union(*(np.stack([order[:-step], order[step:]], axis=1) for step in steps))


def order_is_informative(order: Int[np.ndarray, "photos"], inliers: Int[np.ndarray, "photos photos"]) -> bool:
    """Whether photos next to each other in ``order`` share as many verified matches as the most similar ones.

    In a shuffled set they share what any two photos do, and trying more of them is useless.
    """
    consecutive = inliers[order[:-1], order[1:]]
    tested = np.where(inliers < 0, 0, inliers)
    tested[order[:-1], order[1:]] = tested[order[1:], order[:-1]] = 0
    return bool(np.median(consecutive) >= np.median(tested.max(axis=1)) / 2) if len(order) > 1 else False


def next_pairs(inliers: Int[np.ndarray, "photos photos"], similarity: SimilarityMatrix, neighbours: int) -> Pairs:
    """Untested pairs for the next round, none where the graph is saturated.

    Two photos with the same verified neighbours see the same things. Photos with few links are tried with their most
    similar ones as well, and so are both sides of a weak cut.
    """
    tested = (inliers >= 0).sum(axis=1)
    allowed = np.clip(neighbours - tested, 0, MAX_NEW_PARTNERS)
    overlap = np.where(inliers == UNTESTED, neighbour_overlap(inliers), -np.inf)
    np.fill_diagonal(overlap, -np.inf)
    every = np.arange(len(inliers))
    by_overlap = _best_partners(every, np.where(overlap >= MIN_OVERLAP, overlap, -np.inf), allowed)
    links = (inliers >= MIN_INLIERS).sum(axis=1)
    few_links = np.where(links < MAX_NEW_PARTNERS, MAX_NEW_PARTNERS, 0)
    untested = np.where(inliers == UNTESTED, similarity.astype(float), -np.inf)
    np.fill_diagonal(untested, -np.inf)
    return union(by_overlap, _best_partners(every, untested, few_links), across_weak_cuts(inliers, untested))


def neighbour_overlap(inliers: Int[np.ndarray, "photos photos"]) -> Float[np.ndarray, "photos photos"]:
    """The cosine between any two photos' rows of verified matches, saturated, each photo its own best neighbour."""
    weight = np.sqrt(np.clip(np.where(inliers >= MIN_INLIERS, inliers, 0), 0, MAX_COUNTED_INLIERS).astype(float))
    np.fill_diagonal(weight, np.sqrt(MAX_COUNTED_INLIERS))
    length = np.linalg.norm(weight, axis=1)
    return weight @ weight.T / (length[:, None] * length[None])


def _best_partners(
    photos: Int[np.ndarray, "some"], score: Float[np.ndarray, "some photos"], each: Int[np.ndarray, "some"]
) -> Pairs:
    """Of each of some photos its best partners, as many as it may have; none whose score is minus infinity."""
    order = np.argsort(-score, axis=1, kind="stable")
    rank = np.arange(score.shape[1])[None] < each[:, None]
    chosen = rank & np.isfinite(np.take_along_axis(score, order, axis=1))
    row, place = np.nonzero(chosen)
    return union(np.stack([photos[row], order[row, place]], axis=1))


# --- weak cuts


class Cuts(NamedTuple):
    """Cuts of a graph: how many edges go across, and their total weight."""

    side: Bool[np.ndarray, "cuts photos"]  # the smaller one
    edges: Int[np.ndarray, "cuts"]
    weight: Float[np.ndarray, "cuts"]


def weak_cuts(weight: Float[np.ndarray, "photos photos"]) -> Cuts:
    """For each edge of the maximum spanning forest: the cut between the two trees that are left without it.

    ``weight`` is symmetric, 0 where there is no edge. Groups that hardly connect to the rest are on one side of such a
    cut, since within a group edges are heavier than across (single linkage). Components come as cuts without edges.
    """
    component = connected(weight > 0)
    parts = [component == number for number in range(1, int(component.max(initial=0)) + 1)]
    ends = spanning_tree(np.where(weight > 0, weight, -1.0))
    ends = ends[weight[ends[:, 0], ends[:, 1]] > 0]
    tree = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=weight.shape)
    below = np.eye(len(weight), dtype=bool)
    for number in range(int(component.max(initial=-1)) + 1):
        whole = component == number
        order, parent = breadth_first_order(tree, int(np.argmax(whole)), directed=False)
        for photo in order[:0:-1]:
            below[parent[photo]] |= below[photo]
        parts += [below[i] if 2 * below[i].sum() <= whole.sum() else whole & ~below[i] for i in order[1:]]
    side = np.array(parts, bool).reshape(-1, len(weight))
    edges, across = (
        np.einsum("ci,ci->c", side.astype(float) @ of, (~side).astype(float)) for of in (1.0 * (weight > 0), weight)
    )
    return Cuts(side, np.rint(edges).astype(int), across)


class Linked(NamedTuple):
    """A photo, and how strongly it is linked with those before it; infinitely, for the first."""

    photo: int
    links: float


def most_linked(strength: Num[np.ndarray, "photos photos"]) -> Iterator[Linked]:
    """All photos in the order in which they hang together: the one that is linked most, then again and again the one
    that is linked most with those before. ``strength`` is symmetric and has no photo linked with itself."""
    photo, links, taken = int(strength.sum(axis=1).argmax()), math.inf, np.zeros(len(strength), bool)
    towards = np.zeros(len(strength))
    for _ in range(len(strength)):
        yield Linked(photo, links)
        taken[photo] = True
        towards += strength[photo]
        photo = int(np.where(taken, -1, towards).argmax())
        links = float(towards[photo])


def connected(edges: Bool[np.ndarray, "photos photos"]) -> Int[np.ndarray, "photos"]:
    """The number of each photo's connected component, the largest being 0."""
    _, label = connected_components(csr_matrix(edges), directed=False)
    by_size = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(by_size, kind="stable")[label]


def across_weak_cuts(inliers: Int[np.ndarray, "photos photos"], untested: Float[np.ndarray, "photos photos"]) -> Pairs:
    """The most similar untested pairs across the graph's weak cuts, a few for each photo on the smaller side."""
    found = [np.zeros((0, 2), int)]
    cuts = weak_cuts(np.where(inliers >= MIN_INLIERS, inliers, 0).astype(float))
    for side in cuts.side[cuts.edges <= MAX_WEAK_CUT_EDGES]:
        photos = np.flatnonzero(side)
        across = np.where(side[None], -np.inf, untested[photos])
        found.append(_best_partners(photos, across, np.full(len(photos), MAX_NEW_PARTNERS)))
    return union(*found)


def natural_order(names: Sequence[str]) -> Int[np.ndarray, "photos"]:
    """The order of names in which numbers count as numbers: a2 comes before a10."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", name.casefold())
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]

    return np.array(sorted(range(len(names)), key=lambda i: (key(names[i]), names[i])), int)


def candidate_orders(photos: Sequence[Photo]) -> list[np.ndarray]:
    """The orders in which the photos may have been taken: of their times, where all are known, and of their names,
    where that is another."""
    by_name = natural_order([photo.name for photo in photos])
    clock_s = [photo.clock_s if photo.time_s is None else photo.time_s for photo in photos]
    if None in clock_s:
        return [by_name]
    by_time = by_name[np.argsort(np.array(clock_s, float)[by_name], kind="stable")]  # within a second by name
    return [by_time] if np.array_equal(by_time, by_name) else [by_time, by_name]
