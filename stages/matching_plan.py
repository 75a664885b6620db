"""Which pairs of photos to match, decided before the work starts by what a pair costs on this machine.

The cost is measured on a few of the photos, in a child process (COLMAP may abort): ``python -m stages.matching_plan``
reads a job from stdin as one line of JSON and answers with the seconds a pair takes.
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
from typing import TYPE_CHECKING, Any

from stages.contract import Progress, StageError
from stages.live_line import duration

if TYPE_CHECKING:
    from stages.pairing import Places
    from stages.photos import Photo
    from stages.sfm import Matcher

# Neighbours in the list see much the same, those of different parts often nothing: both kinds of pairs are timed.
MEASURED = (1 / 4, 3 / 4)  # where in the list of photos two neighbours are taken from
CHILD = ["-m", "stages.matching_plan"]
WAYS = {
    "sequential": "neighbours in time, {} each",
    "spatial": "the {} nearest places of each",
    "retrieval": "retrieval of {} neighbours each",
}


def places_of(photos: "Sequence[Photo]") -> "Places":
    """When and where the photos were taken, as far as all of them tell."""
    import numpy as np

    from stages.pairing import Places, cartesian

    times = [photo.time_s for photo in photos]
    places = [(photo.latitude, photo.longitude) for photo in photos]
    altitudes = [photo.altitude_m for photo in photos]
    time_s = None if None in times else np.array(times, float)
    position_m = None
    if all(None not in place for place in places):
        latitude, longitude = np.array(places, float).T
        position_m = cartesian(latitude, longitude, None if None in altitudes else np.array(altitudes, float))
    return Places(time_s, position_m)


def check_matcher(matcher: "Matcher | None", places: "Places") -> None:
    """Raises StageError where a matcher was asked for that the photos do not allow."""
    if matcher == "spatial" and places.position_m is None:
        raise StageError(
            "cannot choose pairs of photos by place",
            "not all photos tell by EXIF where they were taken",
            "Leave out --sfm.matcher, or try --sfm.matcher retrieval.",
        )


def chosen_matcher(
    photos: "Sequence[Photo]", images: Path, neighbours: int, features: dict[str, int], progress: Progress
) -> "Matcher":
    """The way of choosing pairs that fits the photos and this machine; says so where it is not all of them.

    ``features``: ``max_image_size`` and ``max_features``. Nothing is measured where it could change nothing.
    """
    from stages.pairing import can_save, choose, expected_pairs

    count = len(photos)
    if not can_save(count, neighbours):
        return "exhaustive"
    progress.update("measuring what matching two photos takes")
    seconds = _seconds_per_pair(photos, images, features)
    matcher = choose(count, neighbours, seconds, places_of(photos))
    if matcher != "exhaustive":
        everything, pairs = (expected_pairs(one, count, neighbours) for one in ("exhaustive", matcher))
        progress.note(
            f"{count} photos have {everything:,} pairs, about {about(everything * seconds)}: "
            f"{WAYS[matcher].format(neighbours)}, about {about(pairs * seconds)}"
        )
    return matcher


def about(seconds: float) -> str:
    """``40 s``, ``7 min``, ``3 h``: a time as one says it beforehand."""
    return duration(max(1, round(seconds)) if seconds < 60 else 60 * round(seconds / 60))


def _seconds_per_pair(photos: "Sequence[Photo]", images: Path, features: dict[str, int]) -> float:
    """Measured in a child process, all cores at work. Raises StageError where it does not end well."""
    first = {int(share * len(photos)) for share in MEASURED}
    some = [asdict(photos[index]) for index in sorted(first | {index + 1 for index in first})]
    job = json.dumps({"images": str(images.absolute()), "photos": some, **features})
    answer = subprocess.run(
        [sys.executable, *CHILD], input=job.encode(), capture_output=True, env=environment(), start_new_session=True
    )
    if answer.returncode:
        lines = answer.stderr.decode("utf-8", "replace").strip().splitlines()
        why = lines[-1] if lines else f"COLMAP ended with {answer.returncode}"
        hint = "Name the pairs to match, and nothing is measured: --sfm.matcher exhaustive."
        raise StageError("could not measure what matching two photos takes", why, hint)
    return json.loads(answer.stdout)["seconds_per_pair"]


def environment() -> dict[str, str]:
    """Of a child process in which COLMAP runs."""
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    # Work is divided by photos and pairs; threads inside linear algebra would let roundings depend on the number of
    # cores and on what else the machine does.
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


# --- in the child


def main() -> None:
    """Read the job from stdin, do it, print the answer."""
    job = json.loads(sys.stdin.buffer.readline())
    channel = os.dup(1)
    os.dup2(2, 1)  # nothing else may print there
    os.write(channel, json.dumps({"seconds_per_pair": measure(**job)}).encode())


def measure(images: str, photos: list[dict[str, Any]], max_image_size: int, max_features: int) -> float:
    """Seconds of the wall clock that matching any two of these photos takes, on all cores."""
    from stages.colmap.mapping import MAPPING_MODEL
    from stages.colmap.matching import STRICT_RATIO, Search, extract_features, fill_database, match_pairs
    from stages.pairing import exhaustive
    from stages.photos import Photo

    some = [Photo(**photo) for photo in photos]
    pairs = exhaustive(len(some))
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch, "some.db")
        fill_database(database, some, MAPPING_MODEL)
        extract_features(database, Path(images), some, Search(max_image_size, max_features))
        started = time.monotonic()
        match_pairs(database, pairs, 0, STRICT_RATIO)
        return (time.monotonic() - started) / len(pairs)


if __name__ == "__main__":
    main()
