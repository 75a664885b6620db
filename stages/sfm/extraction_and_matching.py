"""Feature extraction and matching as a strategy asks for them. Runs in the worker process of stage sfm."""

import shutil
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import Note
from stages.ingest.masks import write_feature_masks
from stages.io.amounts import rough_duration
from stages.sfm.colmap.database.copies import copy_as_fisheye, copy_without_matches_of, copy_without_pairs
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import (
    RELAXED_RATIO,
    STRICT_RATIO,
    match_pairs,
    matched_pairs,
    verified_matches,
)
from stages.sfm.job import Job, JobState
from stages.sfm.pairs.match_graph import (
    MAX_GROWTH_ROUNDS,
    MIN_INLIERS,
    MIN_YIELD,
    ORDER_OVERLAP,
    candidate_orders,
    inlier_matrix,
    next_pairs,
    order_is_informative,
    pairs_apart,
)
from stages.sfm.pairs.pair_selection import (
    Pairs,
    capture_priors,
    exhaustive,
    expected_pairs,
    start_pairs,
    union,
    with_more_pairs,
)
from stages.sfm.retry_strategies import Strategy


def match_photos(strategy: Strategy, missing: list[int], state: JobState) -> tuple[Path, dict[str, Any] | None]:
    """The database with the matches that the strategy maps, and what is known of their graph where it was grown."""
    job, database, graph = state.job, state.database, None
    exact = job.matcher == "exhaustive"
    if strategy.matches == "same":
        best = state.usable()
        return state.latest(), best.match_graph if best else None
    if strategy.matches == "strict":
        _extract(database, _extraction(job), state)
        graph = _match_all(database, exact, state)
    elif strategy.matches in ("missing", "relaxed"):
        database = state.sibling(strategy.matches)
        before = matched_pairs(state.latest())
        partners = relaxed_partners(strategy, job.neighbours, len(before), len(missing))
        copy_without_matches_of({state.files[number] for number in missing}, state.latest(), database)
        pairs = with_more_pairs(before, missing, partners, lambda: state.similarity)
        _match(database, pairs, RELAXED_RATIO, exact, state)
    elif strategy.matches == "consecutive":
        database = state.sibling("consecutive")
        tried, kept = (matched_pairs(state.database) + 1).tolist(), consecutive_pairs(state)
        copy_without_pairs(state.database, database, [pair for pair in tried if tuple(pair) not in kept])
    elif strategy.matches == "fisheye":
        latest, database = state.latest(), state.sibling("fisheye")
        copy_as_fisheye(latest, database, job.seed)
    else:
        database = state.sibling("more-features")
        _extract(database, _extraction_of_more(job), state)
        graph = _match_all(database, False, state)  # exactly would take minutes, and find two in a hundred more
    return database, graph


def _extraction(job: Job) -> ExtractionOptions:
    return ExtractionOptions(job.max_image_size, job.max_features)


def _extraction_of_more(job: Job) -> ExtractionOptions:
    size = job.max_image_size
    return ExtractionOptions(2 * size, 2 * job.max_features, doubled_up_to=size, even_contrast=True)


def enlargement(state: JobState) -> float:
    """The pixels that more features are extracted from, over those of the first strategy: not four times as many where
    photos are small and were doubled before, or where their own size is less."""
    once, more = _extraction(state.job), _extraction_of_more(state.job)
    return sum(map(more.pixels, state.photos)) / sum(map(once.pixels, state.photos))


def relaxed_partners(strategy: Strategy, neighbours: int, matched: int, missing: int) -> int:
    """How many photos each of the ``missing`` ones is matched with again, where pairs are chosen and so many were
    ``matched`` already."""
    if strategy.matches == "missing":
        return 2 * neighbours
    return max(2 * neighbours, matched // missing)  # few: together as many pairs as were matched already


def relaxed_pairs(strategy: Strategy, missing: int, matched: int, state: JobState) -> float:
    """About how many pairs that will be, a pair of missing photos counted once."""
    photos = len(state.photos)
    partners = photos - 1
    if state.job.matcher != "exhaustive":
        partners = min(partners, relaxed_partners(strategy, state.job.neighbours, matched, missing))
    return missing * partners * (1 - missing / photos / 2)


def _extract(database: Path, extraction: ExtractionOptions, state: JobState) -> None:
    state.begin("features", database=str(database))
    model = state.job.camera_model or MAPPING_MODEL
    fill_database(database, state.photos, model, state.job.camera_params, state.turns)
    masks = Path(state.job.folder, "masks")
    if write_feature_masks(state.images.parent, state.photos, masks):
        extraction = extraction._replace(masks=masks)
    extract_features(database, state.images, state.photos, extraction, partial(_note_few_features, state), state.turns)
    shutil.rmtree(masks, ignore_errors=True)
    state.end("features")


def _note_few_features(state: JobState, median: float, chosen: ExtractionOptions) -> None:
    few = f"the photos yield few features (median {median:,.0f})"
    if chosen.even_contrast:
        note = Note("sfm.low-contrast", f"{few}: their contrast is low, and is raised for feature extraction")
    else:
        note = Note("sfm.features-enlarged", f"{few}: extracting from photos enlarged to four times the pixels")
    state.send(note=note)


def _match_all(database: Path, exact: bool, state: JobState) -> dict[str, Any] | None:
    """Match every pair, or grow the match graph: round by round, where verification says that it pays.

    Returns how many pairs were tried and verified, and whether the order of names or times helped to choose them.
    """
    job, count, priors = state.job, len(state.photos), capture_priors(state.photos)
    if job.matcher == "exhaustive":
        _match(database, exhaustive(count), STRICT_RATIO, exact, state)
        return None
    orders = candidate_orders(state.photos)
    pairs = union(
        start_pairs(job.matcher, job.neighbours, count, priors, lambda: state.similarity),
        *(pairs_apart(order, 1, 2) for order in orders),
    )

    def tried() -> np.ndarray:
        _match(database, pairs, STRICT_RATIO, exact, state)
        return inlier_matrix(count, pairs, verified_matches(database, pairs))

    inliers = tried()
    if informative := [order for order in orders if order_is_informative(order, inliers)]:
        pairs = union(pairs, *(pairs_apart(order, 3, ORDER_OVERLAP) for order in informative))
        inliers = tried()
    for _ in range(MAX_GROWTH_ROUNDS):
        more = next_pairs(inliers, state.similarity, job.neighbours)
        if not len(more):
            break
        pairs = union(pairs, more)
        inliers = tried()
        if (inliers[more[:, 0], more[:, 1]] >= MIN_INLIERS).mean() < MIN_YIELD:
            break
    verified = int((verified_matches(database, pairs) >= MIN_INLIERS).sum())
    helped = "they include photos taken in sequence" if informative else "the order of the photos did not help"
    state.send(
        note=Note(
            "sfm.verified-pairs", f"{verified:,} of {len(pairs):,} matched pairs of photos were verified; {helped}"
        )
    )
    return {"tried": len(pairs), "verified": verified, "order": bool(informative)}


def capture_sequence(database: Path, state: JobState) -> list[int]:
    """The photos, by image id, in the order in which they were taken; none where neither times nor names tell it."""
    pairs, orders = matched_pairs(database), candidate_orders(state.photos)
    inliers = inlier_matrix(len(state.photos), pairs, verified_matches(database, pairs))
    return next(((order + 1).tolist() for order in orders if order_is_informative(order, inliers)), [])


def consecutive_pairs(state: JobState) -> set[tuple[int, int]]:
    """The pairs of photos taken one after the other (image ids, the lower first).

    Where a scene has repeated structure they are the only ones that are sure to show the same part of it
    (docs/experiments/match_graph.md).
    """
    return {(min(pair), max(pair)) for pair in pairwise(capture_sequence(state.database, state))}


def _match(database: Path, pairs: Pairs, max_ratio: float, exact: bool, state: JobState) -> None:
    """Match these pairs, every feature with every other (``exact``) or by an inverted file."""

    def expect(left: int, seconds: float) -> None:
        if state.job.matcher == "exhaustive":
            state.send(
                note=Note(
                    "sfm.matching-time", f"matching {left:,} pairs of photos takes about {rough_duration(seconds)}"
                )
            )

    expected = expected_pairs(state.job.matcher, len(state.photos), state.job.neighbours)
    state.begin("matching", database=str(database), pairs=max(len(pairs), expected))
    match_pairs(database, pairs, state.job.seed, max_ratio, expect, None if exact else state.features(database))
    state.end("matching")
