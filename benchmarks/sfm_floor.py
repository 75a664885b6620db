"""How near features and matching come to the least time they could take on this machine.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.sfm_floor DATA [--set fox] [--photos 12]

Matching every feature of one photo with every one of another is a product of matrices: 2 · n₁ · n₂ · 129 floating point
operations, and the way back the same for the features that were chosen the first time, whatever the rest costs. The
floor is their number over the rate at which this machine multiplies large matrices of float32, one on each core.

Features are found in a pyramid of blurred pictures: per octave six pictures, each blurred from the last, as SIFT has it
(Lowe 2004, section 3). The floor is what the same blurs take with OpenCV (single precision, one photo on each core),
without looking for anything in them.

Printed are floor, time taken, and the share of it that the floor is. All photos have to fit in memory.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from benchmarks.record import Record, add_out
from pipeline.cli.terminal import PlainDisplay
from stages import ingest
from stages.hardware.device import processors
from stages.io.photos import Photo, read_photos
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.features import read_descriptors
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import STRICT_RATIO, match_pairs
from stages.sfm.pairs.feature_matching import match_descriptors
from stages.sfm.pairs.pair_selection import exhaustive
from stages.sfm.pairs.quality_level import QUALITY_LEVELS

SCALES, SIGMA = 3, 1.6  # of an octave; of the first picture


def seconds(work: Callable[[], object], times: int = 3) -> float:
    """The least of several times."""
    taken = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def products_per_second(pool: ThreadPoolExecutor, cores: int) -> float:
    """Floating point operations a second of float32 matrix products, one on each core."""
    size = 2048
    left = np.random.default_rng(0).random((size, size), np.float32)
    taken = seconds(lambda: list(pool.map(lambda _: left @ left, range(2 * cores))))
    return 2 * cores * 2 * size**3 / taken


def operations(first: np.ndarray, second: np.ndarray) -> float:
    """Of the products that matching these descriptors takes, the way back for those chosen only."""
    scores = first.astype(np.float32) @ second.astype(np.float32).T
    scores -= 0.5 * (second.astype(np.float32) ** 2).sum(axis=1)
    best, nearest = np.sort(scores, axis=1)[:, -2:], scores.argmax(axis=1)
    squares = (first.astype(float) ** 2).sum(axis=1)[:, None] - 2 * best
    distinct = squares[:, 1] < STRICT_RATIO**2 * squares[:, 0]
    return 2.0 * 129 * len(first) * (len(second) + len(np.unique(nearest[distinct])))


def blurred(path: Path, photo: Photo, extraction: ExtractionOptions) -> None:
    """All pictures in which features would be looked for."""
    size = max(photo.width, photo.height)
    scale = 2.0 if size <= extraction.doubled_up_to else min(1.0, extraction.max_image_size / size)
    read = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.float32)
    octave = [cv2.resize(read, None, fx=scale, fy=scale)]
    sigmas = [SIGMA * 2 ** (number / SCALES) for number in range(SCALES + 3)]
    while min(octave[0].shape) >= 16:
        for before, sigma in pairwise(sigmas):
            octave.append(cv2.GaussianBlur(octave[-1], (0, 0), (sigma**2 - before**2) ** 0.5))
        octave = [octave[SCALES][::2, ::2]]


def compare(photos: list[Photo], folder: Path, database: Path, record: Record) -> None:
    """Record the rows of the table."""
    cores, extraction = processors(), ExtractionOptions(*QUALITY_LEVELS[0])
    fill_database(database, photos, MAPPING_MODEL)
    finding = seconds(lambda: extract_features(database, folder / "images", photos, extraction), 1)
    with pycolmap.Database.open(database) as db:
        descriptors = [read_descriptors(db, number) for number in range(len(photos))]
    pairs = list(combinations(range(len(photos)), 2))
    matching_all = seconds(lambda: match_pairs(database, exhaustive(len(photos)), 0, STRICT_RATIO), 1)
    with ThreadPoolExecutor(cores) as pool:
        cv2.setNumThreads(1)
        blurring = seconds(lambda: list(pool.map(lambda p: blurred(folder / p.file, p, extraction), photos)), 2)
        rate = products_per_second(pool, cores)

        def match(pair: tuple[int, int]) -> None:
            match_descriptors(descriptors[pair[0]], descriptors[pair[1]], STRICT_RATIO)

        matching = seconds(lambda: list(pool.map(match, pairs)), 2)
    floor = sum(operations(descriptors[i], descriptors[j]) for i, j in pairs) / rate
    features = np.mean([len(of) for of in descriptors])
    print(f"{len(photos)} photos, {features:.0f} features each, {cores} cores, {rate / 1e9:.0f} GFLOP/s in products")
    for name, least, taken in (
        ("features", blurring / len(photos), finding / len(photos)),
        ("nearest neighbours of a pair", floor / len(pairs), matching / len(pairs)),
        ("pair, verified and written", floor / len(pairs), matching_all / len(pairs)),
    ):
        milliseconds = {"floor_ms": round(1000 * least, 1), "taken_ms": round(1000 * taken, 1)}
        record.add(work=name, **milliseconds, share=round(least / taken, 2))


def main() -> None:
    """Compare on some photos of one set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--set", default="fox")
    parser.add_argument("--photos", type=int, default=12)
    add_out(parser)
    arguments = parser.parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # as in the child in which the stage works
        parser.error("set OPENBLAS_NUM_THREADS=1: work is divided by pairs, not inside a product")
    pycolmap.logging.minloglevel = 2
    source = arguments.data / arguments.set
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "ingest")
        folder.mkdir()
        ingest.run(
            ingest.Config(photos=source / "images" if (source / "images").is_dir() else source),
            {},
            folder,
            PlainDisplay(),
        )
        photos = sorted(read_photos(folder), key=lambda photo: photo.file)
        compare(
            photos[:: max(1, len(photos) // arguments.photos)][: arguments.photos],
            folder,
            Path(scratch, "some.db"),
            Record(arguments.out),
        )


if __name__ == "__main__":
    main()
