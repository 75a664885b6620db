"""From photos to the matches that an attempt maps by. Runs in the child process of stage sfm."""

import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from stages.ingest.masks import write_feature_masks
from stages.io.amounts import rough_duration
from stages.sfm.colmap.mapping import MAPPING_MODEL
from stages.sfm.colmap.matching import (
    LOOSE_RATIO,
    STRICT_RATIO,
    Search,
    copy_as_fisheye,
    copy_without_matches_of,
    copy_without_pairs,
    extract_features,
    fill_database,
    match_pairs,
    matched_pairs,
    verified_matches,
)
from stages.sfm.pairs.match_graph import (
    MIN_INLIERS,
    MIN_YIELD,
    ORDER_OVERLAP,
    ROUNDS,
    in_order,
    inlier_matrix,
    next_pairs,
    order_tells,
    possible_orders,
)
from stages.sfm.pairs.pair_selection import (
    Pairs,
    exhaustive,
    expected_pairs,
    places_of,
    second_look,
    start_pairs,
    union,
)
from stages.sfm.retry_strategies import Attempt
from stages.sfm.work import Work


def matched(attempt: Attempt, missing: list[int], work: Work) -> tuple[Path, dict[str, Any] | None]:
    """The database with the matches that the attempt works on, and what is known of their graph where it was grown."""
    job, database, graph = work.job, work.database, None
    if attempt.matches == "same":
        best = work.usable()
        return work.latest(), best.match_graph if best else None
    if attempt.matches == "strict":
        _find_features(database, Search(job.max_image_size, job.max_features), work)
        graph = _match_all(database, work)
    elif attempt.matches == "loose":
        database = work.beside("loose")
        before = matched_pairs(work.latest())
        copy_without_matches_of({work.files[number] for number in missing}, work.latest(), database)
        _match(database, second_look(before, missing, job.neighbours, lambda: work.similarity), LOOSE_RATIO, work)
    elif attempt.matches == "row":
        database = work.beside("row")
        tried, steps = (matched_pairs(work.database) + 1).tolist(), steps_of_row(work)
        copy_without_pairs(work.database, database, [pair for pair in tried if tuple(pair) not in steps])
    elif attempt.matches == "fisheye":
        latest, database = work.latest(), work.beside("fisheye")
        copy_as_fisheye(latest, database, job.seed)
    else:
        database = work.beside("rich")
        twice = Search(2 * job.max_image_size, 2 * job.max_features, doubled_up_to=job.max_image_size)
        _find_features(database, twice, work)
        graph = _match_all(database, work)
    return database, graph


def _find_features(database: Path, search: Search, work: Work) -> None:
    work.begin("features", database=str(database))
    fill_database(database, work.photos, work.job.camera_model or MAPPING_MODEL, work.job.camera_params)
    masks = Path(work.job.folder, "masks")
    if write_feature_masks(work.images.parent, work.photos, masks):
        search = search._replace(masks=masks)
    extract_features(database, work.images, work.photos, search)
    shutil.rmtree(masks, ignore_errors=True)
    work.end("features")


def _match_all(database: Path, work: Work) -> dict[str, Any] | None:
    """Match every pair, or grow the match graph: round by round, where verification says that it pays.

    Returns how many pairs were tried and verified, and whether the order of names or times helped to choose them.
    """
    job, count, places = work.job, len(work.photos), places_of(work.photos)
    if job.matcher == "exhaustive":
        _match(database, exhaustive(count), STRICT_RATIO, work)
        return None
    orders = possible_orders(work.photos)
    pairs = union(
        start_pairs(job.matcher, job.neighbours, count, places, lambda: work.similarity),
        *(in_order(order, 1, 2) for order in orders),
    )

    def tried() -> np.ndarray:
        _match(database, pairs, STRICT_RATIO, work)
        return inlier_matrix(count, pairs, verified_matches(database, pairs))

    inliers = tried()
    if telling := [order for order in orders if order_tells(order, inliers)]:
        pairs = union(pairs, *(in_order(order, 3, ORDER_OVERLAP) for order in telling))
        inliers = tried()
    for _ in range(ROUNDS):
        more = next_pairs(inliers, work.similarity, job.neighbours)
        if not len(more):
            break
        pairs = union(pairs, more)
        inliers = tried()
        if (inliers[more[:, 0], more[:, 1]] >= MIN_INLIERS).mean() < MIN_YIELD:
            break
    verified = int((verified_matches(database, pairs) >= MIN_INLIERS).sum())
    helped = "photos next to each other by name or time are among them" if telling else "their order says nothing"
    work.say(note=f"{verified:,} of {len(pairs):,} tried pairs of photos verified; {helped}")
    return {"tried": len(pairs), "verified": verified, "order": bool(telling)}


def row_of(database: Path, work: Work) -> list[int]:
    """The photos, by image id, in the order in which they were taken; none where neither times nor names tell it."""
    pairs, orders = matched_pairs(database), possible_orders(work.photos)
    inliers = inlier_matrix(len(work.photos), pairs, verified_matches(database, pairs))
    return next(((order + 1).tolist() for order in orders if order_tells(order, inliers)), [])


def steps_of_row(work: Work) -> set[tuple[int, int]]:
    """The pairs of photos taken one after the other (image ids, the lower first).

    Where a place repeats itself they are the only ones that are sure to show the same: they share more of it than of
    its likeness (docs/experiments/match_graph.md).
    """
    return {(min(step), max(step)) for step in pairwise(row_of(work.database, work))}


def _match(database: Path, pairs: Pairs, max_ratio: float, work: Work) -> None:
    def expect(left: int, seconds: float) -> None:
        if work.job.matcher == "exhaustive":
            work.say(note=f"matching {left:,} pairs of photos: about {rough_duration(seconds)}")

    expected = expected_pairs(work.job.matcher, len(work.photos), work.job.neighbours)
    work.begin("matching", database=str(database), pairs=max(len(pairs), expected))
    exact = work.job.matcher == "exhaustive" or max_ratio != STRICT_RATIO
    match_pairs(database, pairs, work.job.seed, max_ratio, expect, None if exact else work.features(database))
    work.end("matching")
