"""Matching and verification of pairs of photos, and what is matched so far."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap

from stages.hardware import cluster
from stages.hardware.device import processors
from stages.sfm.colmap.database.correspondences import image_pairs
from stages.sfm.colmap.database.features import Features, PhotoFeatures, SharedFeatures
from stages.sfm.pairs.feature_matching import IndexedFeatures, match_descriptors, match_indexed
from stages.sfm.pairs.match_graph import inlier_matrix, most_linked
from stages.sfm.pairs.pair_selection import Pairs

# Lowe's ratio: 0.8 is SIFT's own. 0.9 lets in many mismatches, most of which verification throws out again, and
# finds views that lie farther apart; only photos that otherwise stay unregistered are matched like that.
STRICT_RATIO = 0.8
RELAXED_RATIO = 0.9
# Of a pair's verification, in place of COLMAP's 10,000: among so many mismatches nearly every pair would take them all.
# It is five times as fast, and one verified pair in sixty is lost (docs/experiments/few_features.md).
RELAXED_TRIALS = 1000
BLOCK_SIZE = 32  # pairs of photos that are worked on and committed at once (progress, resuming)


Item = TypeVar("Item")
Result = TypeVar("Result")


def match_pairs(
    database: Path,
    pairs: Pairs,
    seed: int,
    max_ratio: float,
    on_expected: Callable[[int, float], None] = lambda left, seconds: None,
    features: Features | None = None,
) -> None:
    """Match and verify these pairs of photos (numbered from 0) where that has not been done yet.

    ``max_ratio`` is Lowe's: the best match must be nearer than this share of the second best. ``features`` says how
    features are compared, exactly without it, and keeps those that were read for further calls. ``on_expected`` is
    told how many pairs there are to match and how long it will take, once a first block, spread over all, is done.
    """
    with pycolmap.Database.open(database) as db, ThreadPoolExecutor(processors()) as pool:
        todo = _spread([(i, j) for i, j in pairs.tolist() if not db.exists_two_view_geometry(i + 1, j + 1)])
        photo = partial((features or Features()).read, db)
        every = _blocks(todo)
        blocks = ([(photo(i), photo(j)) for i, j in block] for block in every)
        matched = cluster.fan_out(partial(_match_block, max_ratio, seed), blocks, partial(_on_own_cores, pool))
        started = time.monotonic()
        for number, (block, found) in enumerate(zip(every, matched, strict=True)):
            with pycolmap.DatabaseTransaction(db):
                for (i, j), (matches, geometry) in zip(block, found, strict=True):
                    db.write_matches(i + 1, j + 1, matches)
                    db.write_two_view_geometry(i + 1, j + 1, geometry)
            if number == 0:
                on_expected(len(todo), (time.monotonic() - started) * len(todo) / len(block))


def _spread(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same pairs, a block from all over them first: what it costs then holds for the rest."""
    step = max(1, len(pairs) // BLOCK_SIZE)
    first = pairs[::step][:BLOCK_SIZE]
    chosen = set(first)
    return first + [pair for pair in pairs if pair not in chosen]


def _blocks(todo: list[Item]) -> list[list[Item]]:
    return [todo[begin : begin + BLOCK_SIZE] for begin in range(0, len(todo), BLOCK_SIZE)]


def _on_own_cores(
    pool: ThreadPoolExecutor, work: Callable[[list[Item]], list[Result]], blocks: Iterable[list[Item]]
) -> Iterator[list[Result]]:
    """Each block on all cores, at work while the one before is written."""
    before = list[Future[list[Result]]]()
    for block in chain(blocks, [list[Item]()]):
        ahead = [pool.submit(work, [pair]) for pair in block]
        if before:
            yield [found for each in before for found in each.result()]
        before = ahead


Block = list[tuple[SharedFeatures, SharedFeatures]]


Matched = tuple[np.ndarray, pycolmap.TwoViewGeometry]
"""Matches, and the geometry of two views with those that it explains: none where they are too few."""


def _match_block(max_ratio: float, seed: int, block: Block) -> list[Matched]:
    options, photos = _verification(seed), {each: each() for pair in block for each in pair}
    if max_ratio > STRICT_RATIO:
        options.ransac.max_num_trials = RELAXED_TRIALS
    return [_match(photos[first], photos[second], max_ratio, options) for first, second in block]


def _match(
    first: PhotoFeatures, second: PhotoFeatures, max_ratio: float, options: pycolmap.TwoViewGeometryOptions
) -> Matched:
    match: Any = match_indexed if isinstance(first.features, IndexedFeatures) else match_descriptors
    matches = match(first.features, second.features, max_ratio)
    return matches, _verified(first, second, matches, options)


def verify_again(db: pycolmap.Database, seed: int) -> None:
    """Verify all matches anew, by the cameras and keypoints that the database has now."""
    todo = [
        (*pycolmap.pair_id_to_image_pair(pair_id), np.asarray(matches, np.uint32))
        for pair_id, matches in zip(*db.read_all_matches(), strict=True)
    ]
    every, photo = _blocks(todo), partial(Features().read, db)
    with ThreadPoolExecutor(processors()) as pool:
        blocks = ([(photo(i - 1), photo(j - 1), matches) for i, j, matches in block] for block in every)
        verified = cluster.fan_out(partial(_verify_block, seed), blocks, partial(_on_own_cores, pool))
        for block, geometries in zip(every, verified, strict=True):
            for (i, j, _), geometry in zip(block, geometries, strict=True):
                db.delete_two_view_geometry(i, j)
                db.write_two_view_geometry(i, j, geometry)


def _verify_block(
    seed: int, block: list[tuple[SharedFeatures, SharedFeatures, np.ndarray]]
) -> list[pycolmap.TwoViewGeometry]:
    options = _verification(seed)
    return [_verified(first(), second(), matches, options) for first, second, matches in block]


def _verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    return options


def _verified(
    first: PhotoFeatures, second: PhotoFeatures, matches: np.ndarray, options: pycolmap.TwoViewGeometryOptions
) -> pycolmap.TwoViewGeometry:
    views = first.camera, first.keypoints, second.camera, second.keypoints
    return pycolmap.estimate_two_view_geometry(*views, matches, options)


def verified_matches(database: Path, pairs: Pairs) -> np.ndarray:
    """How many verified matches each of these pairs has; 0 where it was not matched or failed."""
    with pycolmap.Database.open(database) as db:
        found = dict(zip(*db.read_two_view_geometry_num_inliers(), strict=True))
    return np.array([found.get(pycolmap.image_pair_to_pair_id(i + 1, j + 1), 0) for i, j in pairs.tolist()], int)


def matched_pairs(database: Path) -> Pairs:
    """All pairs of photos that were matched so far, verified or not."""
    with pycolmap.Database.open(database) as db:
        ids, _ = db.read_all_matches()
    return image_pairs(ids) - 1


def best_linked(database: Path, count: int, cameras: Collection[int]) -> list[str]:
    """The names of so many images of these cameras (ids) that hang together by the most verified matches: the one that
    has most, then again and again the one that has most with those taken. Fewer where no other is linked with them."""
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        pair_ids, inliers = db.read_two_view_geometry_num_inliers()
    graph = inlier_matrix(len(images), image_pairs(pair_ids) - 1, np.array(inliers, int))
    of_these = np.array([image.camera_id in cameras for image in images])
    strength = np.where(of_these[:, None] & of_these, np.maximum(graph, 0), 0)  # none where none was tried
    linked = takewhile(lambda one: one.links > 0, most_linked(strength))
    return [images[photo].name for photo, _ in islice(linked, count)]
