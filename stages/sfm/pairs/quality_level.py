"""How features are extracted and which pairs of photos are matched, decided beforehand.

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

from stages.contract import Progress, StageError
from stages.hardware.device import processors
from stages.io.amounts import rough_duration
from stages.io.photos import Photo, spread
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.features import Features, read_vocabulary
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import STRICT_RATIO, match_pairs
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


# The accuracy in docs/results.md is that of the first level. Sets of any size have it: features left out cost more in
# cameras than they save in seconds. Only where a time is given that would not be enough is it lowered: the next level
# has half the pixels or the same, and a quarter of the comparisons in matching. Below 1131 pixels photos would have to
# be doubled to yield enough, which saves nothing.
MATCHING_FRACTION = 0.55  # of the seconds given to structure from motion, for features too; mapping takes the rest
MAX_COST = (0.5, 0.08)  # seconds of a photo and of a pair, two cores, of photos with the most features (fountain_p11)
MAX_TIME_RATIO = (
    0.7  # of a level to the one above: small photos, or such with few features, gain nothing by a lower one
)


class QualityLevel(NamedTuple):
    """How features are extracted: the longer side of photos in pixels, and how many each has at most."""

    max_image_size: int
    max_features: int


QUALITY_LEVELS = (QualityLevel(1600, 4096), QualityLevel(1131, 2048), QualityLevel(1131, 1024))


class GivenOptions(NamedTuple):
    """The user's options for extraction and matching; None is left open."""

    max_image_size: int | None
    max_features: int | None
    matcher: Matcher | None


class ChosenOptions(NamedTuple):
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


def check_matcher(matcher: Matcher | None, priors: CapturePriors) -> None:
    """Raises StageError where a matcher was asked for that the photos do not allow."""
    if matcher == "spatial" and priors.position_m is None:
        raise StageError(
            "sfm.no-positions",
            "cannot select pairs of photos by GPS position",
            "not all photos have a GPS position in their EXIF data",
            "Leave out --sfm.matcher, or try --sfm.matcher retrieval.",
        )


def chosen(
    given: GivenOptions,
    photos: Sequence[Photo],
    images: Path,
    neighbours: int,
    progress: Progress,
    seconds_given: float | None,
) -> ChosenOptions:
    """What is left open: the pairs by how many photos there are, and features in full, unless ``seconds_given`` to all
    of structure from motion would not be enough for them. Then some photos are timed on this machine, which is said.
    """
    count, levels = len(photos), quality_levels(given)
    matcher = given.matcher or choose(count, neighbours, capture_priors(photos))
    pairs = expected_pairs(matcher, count, neighbours)
    if matcher != "exhaustive":
        everything = expected_pairs("exhaustive", count, neighbours)
        progress.note(
            "sfm.pair-selection",
            f"matching about {pairs:,} of {everything:,} pairs of photos: {WAYS[matcher].format(neighbours)}",
        )
    if seconds_given is None or len(levels) == 1 or _max_seconds(count, pairs) <= MATCHING_FRACTION * seconds_given:
        return ChosenOptions(*levels[0], matcher)
    progress.update("timing features and matches of a few photos")
    level, full = levels[0], _measured(photos, images, levels[0], matcher).of(count, pairs)
    seconds = full
    for less in levels[1:]:
        if seconds <= MATCHING_FRACTION * seconds_given:
            break
        if (shorter := _measured(photos, images, less, matcher).of(count, pairs)) <= MAX_TIME_RATIO * seconds:
            level, seconds = less, shorter
    progress.note("sfm.quality-level", _level_message(count, levels[0], level, full, seconds))
    return ChosenOptions(*level, matcher)


def _max_seconds(count: int, pairs: int) -> float:
    """Seconds that features and pairs take at most, before any is measured."""
    return Cost(*MAX_COST).of(count, pairs) * max(1.0, 2 / processors())


def quality_levels(given: GivenOptions) -> list[QualityLevel]:
    """The levels to choose from; what is given holds in all of them."""
    size, features = given.max_image_size, given.max_features
    return list(
        dict.fromkeys(
            QualityLevel(size or level.max_image_size, features or level.max_features) for level in QUALITY_LEVELS
        )
    )


def _level_message(count: int, full: QualityLevel, level: QualityLevel, seconds_full: float, seconds: float) -> str:
    said = f"features and matches of {count} photos take about {rough_duration(seconds_full)} with {_describe(full)}"
    if level == full:
        return said
    return f"{said}; {_describe(level)} are used instead, which takes about {rough_duration(seconds)}"


def _describe(level: QualityLevel) -> str:
    return f"{level.max_features} features a photo at {level.max_image_size} pixels"


def _measured(photos: Sequence[Photo], images: Path, level: QualityLevel, matcher: Matcher) -> Cost:
    """Measured in a child process, all cores at work. Raises StageError where it does not end well."""
    some = [asdict(photo) for photo in _sample(photos, processors())]
    indexed = matcher != "exhaustive"
    job = json.dumps({"images": str(images.absolute()), "photos": some, "indexed": indexed, **level._asdict()})
    answer = subprocess.run(
        [sys.executable, *COMMAND], input=job.encode(), capture_output=True, env=environment(), start_new_session=True
    )
    if answer.returncode:
        lines = answer.stderr.decode("utf-8", "replace").strip().splitlines()
        why = lines[-1] if lines else f"COLMAP ended with {answer.returncode}"
        every = f"--sfm.matcher exhaustive --sfm.max-image-size {level.max_image_size}"
        hint = f"Choose the options yourself: {every} --sfm.max-features {level.max_features}."
        raise StageError("sfm.not-measured", "could not measure how long features and matches take", why, hint)
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
        seconds = extract_features(database, Path(images), some, ExtractionOptions(max_image_size, max_features))
        extracted = time.monotonic()
        words = read_vocabulary(database, len(some), 0, CELLS) if indexed else None
        match_pairs(database, pairs, 0, STRICT_RATIO, features=Features(words))
        return Cost(seconds / len(some), (time.monotonic() - extracted) / len(pairs))


if __name__ == "__main__":
    main()
