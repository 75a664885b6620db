"""How many true neighbours ways of choosing pairs find, and how many of the pairs they pick show nothing in common.

    python -m benchmarks.match_graph WORKSPACE [--photos 60] [--neighbours 30] [--out FILE.json]

WORKSPACE has a finished stage ingest. All pairs of the first N photos by name are matched and verified: the truth.
Then each way is asked for pairs: VLAD by 128 words, the largest 512 features of each photo matched directly, COLMAP's
vocabulary tree (pycolmap.VisualIndex, made of the photos' own features), the order of names, and the match graph grown
from VLAD (stages/sfm/pairs/match_graph.py), with names in order and shuffled. Printed, and written as JSON: pairs,
recall of the best 20 partners of each photo by verified matches, and the share of pairs that verify.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks.record import Record, add_out
from stages.io.photos import read_photos
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.features import Features, image_similarity, read_descriptors, read_vocabulary
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import STRICT_RATIO, match_pairs, verified_matches
from stages.sfm.pairs.feature_matching import match_descriptors
from stages.sfm.pairs.image_retrieval import CELLS
from stages.sfm.pairs.match_graph import (
    MAX_GROWTH_ROUNDS,
    MIN_INLIERS,
    ORDER_OVERLAP,
    inlier_matrix,
    next_pairs,
    order_is_informative,
    pairs_apart,
)
from stages.sfm.pairs.pair_selection import Pairs, SimilarityMatrix, exhaustive, nearest, spanning_tree, union

BEST = 20  # partners of a photo that count
LARGEST = 512  # features of a photo
WORDS = 4096  # of the vocabulary tree


def main() -> None:
    """Measure every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--photos", type=int, default=60)
    parser.add_argument("--neighbours", type=int, default=30)
    add_out(parser)
    asked = parser.parse_args()
    ingest = next((asked.workspace / "ingest").iterdir())
    photos = sorted((p for p in read_photos(ingest) if not p.near_duplicate_of), key=lambda p: p.file)[: asked.photos]
    count = len(photos)
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch, "all.db")
        fill_database(database, photos, MAPPING_MODEL)
        extract_features(database, ingest / "images", photos, ExtractionOptions(1600, 4096))
        every = exhaustive(count)
        match_pairs(database, every, 0, STRICT_RATIO, features=Features(read_vocabulary(database, count, 0, CELLS)))
        truth = inlier_matrix(count, every, verified_matches(database, every))
        vlad = image_similarity(database, count, 0)
        ways = {
            "VLAD": nearest(vlad, asked.neighbours),
            f"{LARGEST} largest features": nearest(largest_features(database, count), asked.neighbours),
            "vocabulary tree": vocabulary_tree(database, count, asked.neighbours),
            "order of names": pairs_apart(np.arange(count), 1, asked.neighbours // 2),
            "grown": grown(np.arange(count), truth, vlad, asked.neighbours),
            "grown, names shuffled": grown(np.random.default_rng(0).permutation(count), truth, vlad, asked.neighbours),
        }
    record = Record(asked.out)
    for name, pairs in ways.items():
        record.add(way=name, photos=count, **scores(pairs, truth))


def scores(pairs: Pairs, truth: np.ndarray) -> dict[str, float | int]:
    """How many of each photo's best partners are among the pairs, and how many of the pairs verify."""
    chosen = np.zeros(truth.shape, bool)
    chosen[tuple(pairs.T)] = chosen[tuple(pairs.T[::-1])] = True
    best = np.argsort(-truth, axis=1, kind="stable")[:, :BEST]
    links = np.take_along_axis(truth, best, axis=1) >= MIN_INLIERS
    found = np.take_along_axis(chosen, best, axis=1) & links
    recall = float((found.sum(axis=1) / np.maximum(links.sum(axis=1), 1)).mean())
    verified = float((truth[tuple(pairs.T)] >= MIN_INLIERS).mean())
    return {"pairs": len(pairs), "recall": round(recall, 3), "verified": round(verified, 3)}


def grown(order: np.ndarray, truth: np.ndarray, similarity: SimilarityMatrix, neighbours: int) -> Pairs:
    """The pairs of a match graph grown as stage sfm does, each answered from the truth."""

    def tried(pairs: Pairs) -> np.ndarray:
        return inlier_matrix(len(truth), pairs, truth[tuple(pairs.T)])

    pairs = union(pairs_apart(order, 1, 2), nearest(similarity, neighbours // 4), spanning_tree(similarity))
    if order_is_informative(order, tried(pairs)):
        pairs = union(pairs, pairs_apart(order, 3, ORDER_OVERLAP))
    for _ in range(MAX_GROWTH_ROUNDS):
        pairs = union(pairs, next_pairs(tried(pairs), similarity, neighbours))
    return pairs


def largest_features(database: Path, count: int) -> SimilarityMatrix:
    """How many of the photos' largest features match (Wu 2013, "Towards linear-time incremental structure from
    motion", section 3: preemptive matching)."""
    with pycolmap.Database.open(database) as db:
        largest = []
        for photo in range(count):
            shape = np.array(db.read_keypoints(photo + 1), float).reshape(-1, 6)
            area = np.abs(shape[:, 2] * shape[:, 5] - shape[:, 3] * shape[:, 4])
            largest.append(read_descriptors(db, photo)[np.argsort(-area, kind="stable")[:LARGEST]])
    found = np.zeros((count, count))
    for first, second in exhaustive(count).tolist():
        matches = len(match_descriptors(largest[first], largest[second], STRICT_RATIO))
        found[first, second] = found[second, first] = matches
    return found


def vocabulary_tree(database: Path, count: int, neighbours: int) -> Pairs:
    """The pairs that COLMAP's vocabulary tree matching takes, with a tree made of these photos' own features."""
    random = np.random.default_rng(0)
    with pycolmap.Database.open(database) as db:
        every = [read_descriptors(db, photo) for photo in range(count)]
        sample = np.concatenate([some[random.permutation(len(some))[: WORDS // count * 20]] for some in every])
        features = pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, sample.astype(np.float32))
        index = pycolmap.VisualIndex.create(128, 64)
        index.build(pycolmap.VisualIndex.BuildOptions(num_visual_words=WORDS, num_threads=1), features)
        tree = database.with_name("tree.bin")
        index.write(tree)
        options = pycolmap.VocabTreePairingOptions(num_images=neighbours + 1, vocab_tree_path=tree, num_threads=1)
        pairs = pycolmap.VocabTreePairGenerator(options, db).all_pairs()
    return union(np.array(pairs, int).reshape(-1, 2) - 1)


if __name__ == "__main__":
    main()
