"""Which features of two photos look alike: exact nearest neighbours among byte descriptors, by matrix products.

|q − b|² = |q|² − 2 (q·b − |b|²/2). For 128 bytes every partial sum of q·b − |b|²/2 is a multiple of 1/2 below 2²³,
which float32 holds exactly, so the answer does not depend on the order of summation: not on threads, nor on the
library that multiplies, nor on the machine.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

FARTHEST = 0.7 * 512  # a match lies nearer than this: COLMAP's max_distance, and its length of a SIFT descriptor
BLOCK = 64  # rows of the matrix of distances at a time: they stay in the cache

Descriptors = UInt8[np.ndarray, "features 128"]


def match_descriptors(first: Descriptors, second: Descriptors, max_ratio: float) -> Int[np.ndarray, "matches 2"]:
    """Pairs of features (uint32) that are each other's nearest, in order of the first.

    Each must also be nearer than ``max_ratio`` times the second nearest (Lowe 2004, section 7.1), from either side.
    """
    there, distinct = _nearest(first, second, max_ratio)
    mine = np.flatnonzero(distinct)
    # The way back matters only for those that were chosen: few, where two photos show different things.
    chosen, place = np.unique(there[mine], return_inverse=True)
    back, distinct = _nearest(second[chosen], first, max_ratio)
    mutual = distinct[place] & (back[place] == mine)
    return np.stack([mine[mutual], there[mine][mutual]], axis=1).astype(np.uint32)


def _nearest(
    queries: Descriptors, base: Descriptors, max_ratio: float
) -> tuple[Int[np.ndarray, "queries"], Bool[np.ndarray, "queries"]]:
    """The nearest of ``base`` to each query, and whether it is near and much nearer than the second."""
    if not len(base):
        return np.zeros(len(queries), int), np.zeros(len(queries), bool)
    nearest = np.empty(len(queries), int)
    best, second = np.empty((2, len(queries)), np.float32)
    columns = base.astype(np.float32)
    columns = np.concatenate([columns, -_half_squares(columns)], axis=1).T
    rows = queries.astype(np.float32)
    rows = np.concatenate([rows, np.ones((len(rows), 1), np.float32)], axis=1)
    for begin in range(0, len(queries), BLOCK):
        part = slice(begin, begin + BLOCK)
        score = rows[part] @ columns
        nearest[part] = score.argmax(axis=1)
        each = np.arange(len(score)), nearest[part]
        best[part], score[each] = score[each], -np.inf
        second[part] = score.max(axis=1)
    squares = 2 * _half_squares(rows[:, :-1])[:, 0].astype(float)
    best_squared, second_squared = squares - 2 * best.astype(float), squares - 2 * second.astype(float)
    return nearest, (best_squared < max_ratio**2 * second_squared) & (best_squared < FARTHEST**2)


def _half_squares(descriptors: Float[np.ndarray, "n 128"]) -> Float[np.ndarray, "n 1"]:
    return 0.5 * np.einsum("ij,ij->i", descriptors, descriptors)[:, None]
