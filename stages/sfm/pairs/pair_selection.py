"""Which pairs of photos are matched to begin with; match_graph.py says which follow.

Photos are numbered from 0. Pairs are rows (first, second) with first < second, in order, none of them twice.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nerf.geometry.georeference import GPS_ERROR_M, cartesian
from stages.io.photos import Photo
from stages.sfm.pairs import MAX_EXHAUSTIVE, Matcher

Pairs = Int[np.ndarray, "pairs 2"]
SimilarityMatrix = Float[np.ndarray, "photos photos"]

MUTUAL_FRACTION = 0.9  # of a photo's partners, about so many count it among their own
LOOP_INTERVAL = 5  # in a sequence one of so many partners is chosen for loop closure, at other times


class CapturePriors(NamedTuple):
    """When and where the photos were taken, as far as it is known.

    ``time_s``: seconds in the one video that all photos come from. ``position_m``: Cartesian, metres.
    """

    time_s: Float[np.ndarray, "photos"] | None = None
    position_m: Float[np.ndarray, "photos 3"] | None = None


def capture_priors(photos: Sequence[Photo]) -> CapturePriors:
    """When and where the photos were taken, as far as all of them tell."""
    times = [photo.time_s for photo in photos]
    places = [(photo.latitude, photo.longitude) for photo in photos]
    altitudes = [photo.altitude_m for photo in photos]
    time_s = None if None in times else np.array(times, float)
    position_m = None
    if all(None not in place for place in places):
        latitude, longitude = np.array(places, float).T
        position_m = cartesian(latitude, longitude, None if None in altitudes else np.array(altitudes, float))
    return CapturePriors(time_s, position_m)


# --- the ways of choosing


def exhaustive(count: int) -> Pairs:
    """Every photo with every other."""
    return np.stack(np.triu_indices(count, 1), axis=1)


def sequential(order: Int[np.ndarray, "photos"], overlap: int) -> Pairs:
    """Photos up to ``overlap`` steps apart in ``order``, and those 2, 4, 8, … steps apart."""
    count = len(order)
    powers = {2**i for i in range(count.bit_length())}
    steps = [step for step in sorted(powers | set(range(1, overlap + 1))) if step < count]
    return union(*(np.stack([order[:-step], order[step:]], axis=1) for step in steps))


def nearest(similarity: SimilarityMatrix, neighbours: int) -> Pairs:
    """Each photo with its ``neighbours`` most similar; ties go to the lower number."""
    count = len(similarity)
    others = np.where(np.eye(count, dtype=bool), -np.inf, similarity)
    partners = np.argsort(-others, axis=1, kind="stable")[:, : min(neighbours, count - 1)]
    return union(np.stack([np.repeat(np.arange(count), partners.shape[1]), partners.reshape(-1)], axis=1))


def spanning_tree(similarity: SimilarityMatrix) -> Pairs:
    """The pairs of largest similarity that connect all photos (Prim 1957)."""
    count = len(similarity)
    best, parent = similarity[0].astype(float), np.zeros(count, int)
    best[0] = -np.inf
    outside = np.arange(count) > 0
    pairs = []
    for _ in range(count - 1):
        likest = int(np.argmax(np.where(outside, best, -np.inf)))
        pairs.append((parent[likest], likest))
        outside[likest] = False
        closer = outside & (similarity[likest] > best)
        best[closer], parent[closer] = similarity[likest, closer], likest
    return union(np.array(pairs, int).reshape(-1, 2))


def spatial(position_m: Float[np.ndarray, "photos 3"], similarity: SimilarityMatrix, neighbours: int) -> Pairs:
    """Each photo with its ``neighbours``: half of them nearest by position, the others its most similar among the rest.

    Positions may be off by more than photos are apart, or the same for dozens of them: similarity makes up for that.
    """
    near = nearest(closeness(position_m), neighbours // 2)
    rest = similarity.astype(float)
    rest[tuple(near.T)] = rest[tuple(near.T[::-1])] = -np.inf
    return union(near, nearest(rest, neighbours - neighbours // 2), spanning_tree(similarity))


def union(*pairs: Int[np.ndarray, "n 2"]) -> Pairs:
    """Each pair that is in any of them once, whichever way round it was written."""
    together = np.sort(np.concatenate([np.zeros((0, 2), int), *pairs]), axis=1)
    return np.unique(together[together[:, 0] != together[:, 1]], axis=0)


def closeness(position_m: Float[np.ndarray, "n 3"]) -> SimilarityMatrix:
    """Minus the distance between any two positions, in metres."""
    return -np.sqrt(sum((axis[:, None] - axis[None]) ** 2 for axis in position_m.T))


def start_pairs(
    matcher: Matcher, neighbours: int, count: int, priors: CapturePriors, similarity: Callable[[], SimilarityMatrix]
) -> Pairs:
    """The pairs that matching begins with. ``similarity`` is asked for only where it is needed.

    Without times ``sequential`` goes by the order of the photos; ``spatial`` needs positions; ``retrieval`` begins
    with the most similar photos alone, since the match graph is grown from what verification says of them.
    """
    if matcher == "exhaustive":
        return exhaustive(count)
    if matcher == "retrieval":
        return union(nearest(similarity(), max(2, neighbours // 4)), spanning_tree(similarity()))
    if matcher == "spatial":
        assert priors.position_m is not None
        return spatial(priors.position_m, similarity(), neighbours)
    order = np.arange(count) if priors.time_s is None else np.argsort(priors.time_s, kind="stable")
    loops = max(1, neighbours // LOOP_INTERVAL)
    overlap = max(1, (neighbours - loops) // 2)
    when = np.argsort(order)
    apart = np.abs(when[:, None] - when[None]) > overlap
    return union(sequential(order, overlap), nearest(np.where(apart, similarity(), -np.inf), loops))


def with_more_pairs(
    pairs: Pairs, missing: Sequence[int], partners: int, similarity: Callable[[], SimilarityMatrix]
) -> Pairs:
    """The pairs again, and those of unregistered photos with so many ``partners`` each, the most similar ones."""
    count = int(pairs.max(initial=0)) + 1
    if len(pairs) == count * (count - 1) // 2:
        return pairs
    order = np.argsort(-similarity()[list(missing)], axis=1, kind="stable")[:, : partners + 1]  # itself is one of them
    return union(pairs, np.stack([np.repeat(missing, order.shape[1]), order.reshape(-1)], axis=1))


# --- the choice among them


def expected_pairs(matcher: Matcher, count: int, neighbours: int) -> int:
    """About how many pairs there will be."""
    everything = count * (count - 1) // 2
    return (
        everything
        if matcher == "exhaustive"
        else min(everything, round(count * neighbours * (1 - MUTUAL_FRACTION / 2)))
    )


def choose(count: int, neighbours: int, priors: CapturePriors) -> Matcher:
    """Every pair of a set of ordinary size; else by time, GPS position or similarity."""
    if count <= MAX_EXHAUSTIVE:
        return "exhaustive"
    if priors.time_s is not None:
        return "sequential"
    if priors.position_m is not None and _is_spread_out(priors.position_m, neighbours):
        return "spatial"
    return "retrieval"


def _is_spread_out(position_m: Float[np.ndarray, "photos 3"], neighbours: int) -> bool:
    """Whether neighbourhoods are larger than the error of positions, as far as these can tell: indoors it is larger."""
    farthest = np.sort(-closeness(position_m), axis=1)[:, min(neighbours, len(position_m) - 1)]
    return bool(np.median(farthest) > GPS_ERROR_M)
