"""Which features of two photos look alike: nearest neighbours among byte descriptors, by matrix products.

|q − b|² = |q|² − 2 (q·b − |b|²/2). For 128 bytes every partial sum of q·b − |b|²/2 is a multiple of 1/2 below 2²³,
which float32 holds exactly, so the answer does not depend on the order of summation: not on threads, nor on the
library that multiplies, nor on the machine.

:func:`match_descriptors` compares every feature with every other. :func:`match_indexed` compares those that fall into
the same cells of a common vocabulary: an inverted file (Jégou et al. 2011, "Product quantization for nearest neighbor
search", section 4), which finds 98 % of the matches in a fifth of the time (docs/stages/sfm.md).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

MAX_DISTANCE = 0.7 * 512  # a match lies nearer than this: COLMAP's max_distance, and its length of a SIFT descriptor
BLOCK = 64  # rows of the matrix of distances at a time: they stay in the cache
PROBES = 4  # cells of the vocabulary that a feature is compared in, of 32: 97.6 % of the matches, 98.0 % of the inliers

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
    return nearest, _is_distinct(_half_squares(rows[:, :-1])[:, 0], best, second, max_ratio)


def _is_distinct(
    half_squares: Float[np.ndarray, "queries"],
    best: Float[np.ndarray, "queries"],
    second: Float[np.ndarray, "queries"],
    max_ratio: float,
) -> Bool[np.ndarray, "queries"]:
    """Whether the nearest is near, and much nearer than the second; both are given as q·b − |b|²/2."""
    squares = 2 * half_squares.astype(float)
    best_squared, second_squared = squares - 2 * best.astype(float), squares - 2 * second.astype(float)
    return (best_squared < max_ratio**2 * second_squared) & (best_squared < MAX_DISTANCE**2)


def _half_squares(descriptors: Float[np.ndarray, "n 128"]) -> Float[np.ndarray, "n 1"]:
    return 0.5 * np.einsum("ij,ij->i", descriptors, descriptors)[:, None]


# --- by an inverted file


@dataclass(frozen=True)
class IndexedFeatures:
    """The descriptors of a photo, sorted by the cell of a vocabulary that they fall into.

    Row k is feature ``feature[k]``; rows ``begins[c]`` to ``begins[c + 1]`` fall into cell c. Rows
    ``probing[probe_begins[c]:probe_begins[c + 1]]`` have cell c among their PROBES nearest; it is their ``probe``-th
    entry there.
    """

    feature: Int[np.ndarray, "features"]
    descriptors: Float[np.ndarray, "features 128"]
    half_squares: Float[np.ndarray, "features"]
    begins: Int[np.ndarray, "cells+1"]
    probing: Int[np.ndarray, "probes"]
    probe: Int[np.ndarray, "probes"]
    probe_begins: Int[np.ndarray, "cells+1"]


def index_features(descriptors: Descriptors, vocabulary: Float[np.ndarray, "cells 128"]) -> IndexedFeatures:
    """``vocabulary`` holds whole numbers, so that which cell is nearest does not depend on the machine."""
    every = descriptors.astype(np.float32)
    cells, probes = len(vocabulary), min(PROBES, len(vocabulary))
    score = every @ vocabulary.T - _half_squares(vocabulary)[:, 0]
    nearest = np.argsort(-score, axis=1, kind="stable")[:, :probes]
    order = np.argsort(nearest[:, 0], kind="stable") if len(every) else np.zeros(0, int)
    probed = nearest[order].reshape(-1)
    by_cell = np.argsort(probed, kind="stable")
    edges = np.arange(cells + 1)
    rows = every[order]
    return IndexedFeatures(
        feature=order,
        descriptors=rows,
        half_squares=_half_squares(rows)[:, 0],
        begins=np.searchsorted(nearest[order, 0], edges) if len(every) else np.zeros(cells + 1, int),
        probing=by_cell // probes,
        probe=by_cell % probes,
        probe_begins=np.searchsorted(probed[by_cell], edges),
    )


def match_indexed(first: IndexedFeatures, second: IndexedFeatures, max_ratio: float) -> Int[np.ndarray, "matches 2"]:
    """As :func:`match_descriptors`, but a feature is compared only with those in the cells of the vocabulary that are
    nearest to it."""
    there, distinct = _nearest_indexed(first, second, max_ratio, np.ones(len(first.feature), bool))
    mine = np.flatnonzero(distinct)
    chosen = np.zeros(len(second.feature), bool)
    chosen[there[mine]] = True
    back, distinct = _nearest_indexed(second, first, max_ratio, chosen)
    mine = mine[distinct[there[mine]] & (back[there[mine]] == mine)]
    matches = np.stack([first.feature[mine], second.feature[there[mine]]], axis=1)
    return matches[np.argsort(matches[:, 0])].astype(np.uint32)


def _nearest_indexed(
    queries: IndexedFeatures, base: IndexedFeatures, max_ratio: float, wanted: Bool[np.ndarray, "queries"]
) -> tuple[Int[np.ndarray, "queries"], Bool[np.ndarray, "queries"]]:
    """As :func:`_nearest`, by rows, of the queries that are ``wanted``."""
    count, probes = len(queries.feature), int(queries.probe.max(initial=0)) + 1
    best, second = np.full((2, count, probes), -np.inf, np.float32)
    nearest = np.zeros((count, probes), int)
    for cell in range(len(base.begins) - 1):
        some = slice(queries.probe_begins[cell], queries.probe_begins[cell + 1])
        begin, end = base.begins[cell], base.begins[cell + 1]
        row, probe = queries.probing[some], queries.probe[some]
        row, probe = row[wanted[row]], probe[wanted[row]]
        if begin == end or not len(row):
            continue
        score = queries.descriptors[row] @ base.descriptors[begin:end].T - base.half_squares[begin:end]
        at = np.arange(len(row)), score.argmax(axis=1)
        nearest[row, probe], best[row, probe] = begin + at[1], score[at]
        score[at] = -np.inf
        second[row, probe] = score.max(axis=1)
    each = np.arange(count), best.argmax(axis=1)
    top, runner_up = best[each], second[each]
    best[each] = -np.inf
    found = np.isfinite(top)
    top, runner_up = np.where(found, top, 0), np.maximum(best.max(axis=1), runner_up)
    return nearest[each], found & _is_distinct(queries.half_squares, top, runner_up, max_ratio)
