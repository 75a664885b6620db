"""How far to search features and which pairs of photos to match, decided beforehand.

The cost is measured on a few of the photos, in a child process (COLMAP may abort): ``python -P -m
stages.sfm.pairs.quality_level`` reads a job from stdin as one line of JSON and answers with a :class:`Cost`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from stages.amounts import rough_duration
from stages.contract import Progress, StageError
from stages.hardware.device import processors
from stages.io.photos import Photo, spread
from stages.sfm.colmap.database import (
    STRICT_RATIO,
    ExtractionOptions,
    Features,
    extract_features,
    fill_database,
    match_pairs,
    read_vocabulary,
)
from stages.sfm.colmap.mapping import MAPPING_MODEL
from stages.sfm.pairs import Matcher
from stages.sfm.pairs.image_retrieval import CELLS
from stages.sfm.pairs.pair_selection import CapturePriors, capture_priors, choose, exhaustive, expected_pairs
from stages.sfm.worker_process import environment

MIN_MEASURED = 4
COMMAND = ["-P", "-m", "stages.sfm.pairs.quality_level"]
WAYS = {
    "sequential": "neighbours in time, up to {} each",
    "spatial": "neighbours by GPS position and similarity, up to {} each",
    "retrieval": "neighbours by similarity and order, up to {} each",
}


# The accuracy in docs/results.md is that of the first tier. Sets of any size are searched so: features left out cost
# more in cameras than they save in seconds. Only where a time is given that would not be enough, they give way: a step
# down has half the pixels or the same, and a quarter of the products of matching. Below 1131 pixels photos would have
# to be doubled to yield enough, which saves nothing.
SEARCHING = 0.55  # of the seconds given to structure from motion: mapping and adjusting take the rest
DENSEST = (0.5, 0.08)  # seconds of a photo and of a pair, two cores, of photos with the most features (fountain_p11)
WORTH_IT = 0.7  # of the time: small photos, or such with few features, gain nothing by a step down, and are spared it


class QualityLevel(NamedTuple):
    """How far features are searched: the longer side of photos in pixels, and how many each has at most."""

    max_image_size: int
    max_features: int


QUALITY_LEVELS = (QualityLevel(1600, 4096), QualityLevel(1131, 2048), QualityLevel(1131, 1024))


class Open(NamedTuple):
    """What the user says of the search; None is left open."""

    max_image_size: int | None
    max_features: int | None
    matcher: Matcher | None


class Chosen(NamedTuple):
    """The same, with every answer."""

    max_image_size: int
    max_features: int
    matcher: Matcher


class Cost(NamedTuple):
    """Seconds of the wall clock, all cores at work, that the features of a photo and a pair of photos take."""

    per_photo: float
    per_pair: float

    def of(self, photos: int, pairs: int) -> float:
        """Seconds for a set."""
        return photos * self.per_photo + pairs * self.per_pair


def check_matcher(matcher: Matcher | None, places: CapturePriors) -> None:
    """Raises StageError where a matcher was asked for that the photos do not allow."""
    if matcher == "spatial" and places.position_m is None:
        raise StageError(
            "sfm.no-positions",
            "cannot choose pairs of photos by place",
            "not all photos tell by EXIF where they were taken",
            "Leave out --sfm.matcher, or try --sfm.matcher retrieval.",
        )


def chosen(
    left_open: Open,
    photos: Sequence[Photo],
    images: Path,
    neighbours: int,
    progress: Progress,
    seconds_given: float | None,
) -> Chosen:
    """What is left open: the pairs by how many photos there are, and features in full, unless ``seconds_given`` to all
    of structure from motion would not be enough for them. Then some photos are timed on this machine, which is said.
    """
    count, tiers = len(photos), quality_levels(left_open)
    matcher = left_open.matcher or choose(count, neighbours, capture_priors(photos))
    pairs = expected_pairs(matcher, count, neighbours)
    if matcher != "exhaustive":
        everything = expected_pairs("exhaustive", count, neighbours)
        progress.note(f"{count} photos have {everything:,} pairs: {WAYS[matcher].format(neighbours)}, about {pairs:,}")
    if seconds_given is None or len(tiers) == 1 or _at_most(count, pairs) <= SEARCHING * seconds_given:
        return Chosen(*tiers[0], matcher)
    progress.update("measuring what features and matches of a few photos take")
    tier, full = tiers[0], _measured(photos, images, tiers[0], matcher).of(count, pairs)
    seconds = full
    for less in tiers[1:]:
        if seconds <= SEARCHING * seconds_given:
            break
        if (shorter := _measured(photos, images, less, matcher).of(count, pairs)) <= WORTH_IT * seconds:
            tier, seconds = less, shorter
    progress.note(_search_in_words(count, tiers[0], tier, full, seconds))
    return Chosen(*tier, matcher)


def _at_most(count: int, pairs: int) -> float:
    """Seconds that features and pairs take at most, before any is measured."""
    return Cost(*DENSEST).of(count, pairs) * max(1.0, 2 / processors())


def quality_levels(left_open: Open) -> list[QualityLevel]:
    """The tiers to choose from, what is given in all of them."""
    size, features = left_open.max_image_size, left_open.max_features
    return list(
        dict.fromkeys(
            QualityLevel(size or tier.max_image_size, features or tier.max_features) for tier in QUALITY_LEVELS
        )
    )


def _search_in_words(count: int, full: QualityLevel, tier: QualityLevel, seconds_full: float, seconds: float) -> str:
    if tier == full:
        return f"{count} photos searched at {_in_words(tier)} and matched: about {rough_duration(seconds)}"
    instead = f"at {_in_words(tier)} instead, about {rough_duration(seconds)}"
    return (
        f"{count} photos searched at {_in_words(full)} and matched take about {rough_duration(seconds_full)}: {instead}"
    )


def _in_words(tier: QualityLevel) -> str:
    return f"{tier.max_image_size} pixels for {tier.max_features} features"


def _measured(photos: Sequence[Photo], images: Path, tier: QualityLevel, matcher: Matcher) -> Cost:
    """Measured in a child process, all cores at work. Raises StageError where it does not end well."""
    some = [asdict(photo) for photo in _sample(photos, processors())]
    indexed = matcher != "exhaustive"
    job = json.dumps({"images": str(images.absolute()), "photos": some, "indexed": indexed, **tier._asdict()})
    answer = subprocess.run(
        [sys.executable, *COMMAND], input=job.encode(), capture_output=True, env=environment(), start_new_session=True
    )
    if answer.returncode:
        lines = answer.stderr.decode("utf-8", "replace").strip().splitlines()
        why = lines[-1] if lines else f"COLMAP ended with {answer.returncode}"
        every = f"--sfm.matcher exhaustive --sfm.max-image-size {tier.max_image_size}"
        hint = f"Say how, and nothing is measured: {every} --sfm.max-features {tier.max_features}."
        raise StageError("sfm.not-measured", "could not measure what features and matches take", why, hint)
    return Cost(**json.loads(answer.stdout))


def _sample(photos: Sequence[Photo], cores: int) -> list[Photo]:
    """Two neighbours each from all over the list, at least four photos and enough for all cores.

    Neighbours in the list see much the same, those of different parts often nothing: both kinds of pairs are timed.
    """
    first = spread(len(photos), max(MIN_MEASURED, cores) // 2)
    return [
        photos[index] for index in sorted({one for index in first for one in (index, index + 1)}) if index < len(photos)
    ]


# --- in the child


def main() -> None:
    """Read the job from stdin, do it, print the answer."""
    job = json.loads(sys.stdin.buffer.readline())
    channel = os.dup(1)
    os.dup2(2, 1)  # nothing else may print there
    os.write(channel, json.dumps(measure(**job)._asdict()).encode())


def measure(images: str, photos: list[dict[str, Any]], max_image_size: int, max_features: int, indexed: bool) -> Cost:
    """What these photos take."""
    some = [Photo(**photo) for photo in photos]
    pairs = exhaustive(len(some))
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch, "some.db")
        fill_database(database, some, MAPPING_MODEL)
        started = time.monotonic()
        extract_features(database, Path(images), some, ExtractionOptions(max_image_size, max_features))
        extracted = time.monotonic()
        words = read_vocabulary(database, len(some), 0, CELLS) if indexed else None
        match_pairs(database, pairs, 0, STRICT_RATIO, features=Features(words))
        return Cost((extracted - started) / len(some), (time.monotonic() - extracted) / len(pairs))


if __name__ == "__main__":
    main()
