"""Models checked by the verified matches of a database, and compared by what these say.

stages/sfm/pose_check.py decides what agrees with a pose and what contradicts it. Call it in a worker process.
"""

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from stages.contract import Note
from stages.sfm.colmap.database.correspondences import read_pair_matches
from stages.sfm.pairs.match_graph import connected
from stages.sfm.pose_check import (
    PairMatches,
    PoseCheck,
    check_poses,
    fits_as_a_whole,
    is_fragmented,
    sequence_breaks,
    supported_pairs,
    weak_links,
)

CLEARLY_FEWER = 0.9  # of the pairs that agree with another model


class ModelCheck(NamedTuple):
    """What the verified matches of a database say of a model's poses; photos in order of ``ids``."""

    ids: list[int]
    matches: PairMatches
    check: PoseCheck

    @property
    def fits(self) -> bool:
        """Whether the poses as a whole fit the matches as exactly as these allow."""
        return fits_as_a_whole(self.matches, self.check)

    def failed(self) -> list[int]:
        """The image ids of photos whose poses fail the check."""
        return [image_id for image_id, passed in zip(self.ids, self.check.passed, strict=True) if not passed]

    def numbers(self, sequence: Sequence[int]) -> Int[np.ndarray, "photos"]:
        """The images of a ``sequence`` (ids) that the model has, by their numbers in the check."""
        number_of = {image_id: number for number, image_id in enumerate(self.ids)}
        return np.array([number_of[image_id] for image_id in sequence if image_id in number_of], int)


def check_model(model: pycolmap.Reconstruction, database: Path, seed: int) -> ModelCheck:
    """Check every registered photo by all verified matches, those that mapping did not use or rejected as well."""
    with pycolmap.Database.open(database) as db:
        ids, matches = read_pair_matches(db, model, seed)
    return ModelCheck(ids, matches, check_poses(matches, camera_poses(model)))


def camera_poses(model: pycolmap.Reconstruction) -> Float[np.ndarray, "photos 3 4"]:
    """World from camera of every registered photo, in order of image id."""
    poses = [model.image(i).cam_from_world().inverse().matrix() for i in sorted(model.reg_image_ids())]
    return np.array(poses).reshape(-1, 3, 4)


def reasons(model: pycolmap.Reconstruction, checked: ModelCheck) -> dict[str, Note]:
    """By name, why each photo that failed cannot stay."""
    check, found = checked.check, {}
    groups = int(check.misplaced.sum())
    for image_id, misplaced, unlinked, agree, against in zip(
        checked.ids, check.misplaced, check.unlinked, check.votes_for, check.votes_against, strict=True
    ):
        if misplaced:
            matches = (
                f"{against:,.0f} of its {agree + against:,.0f} verified matches with other photos contradict its pose"
            )
            together = f"; {groups - 1} more failed the same check" if groups > 1 else ""
            found[model.image(image_id).name] = Note("sfm.unregistered-misplaced", f"{matches}{together}")
        elif unlinked:
            found[model.image(image_id).name] = Note(
                "sfm.unregistered-unlinked", "no verified match links it to the other photos"
            )
    return found


def facts(model: pycolmap.Reconstruction, checked: ModelCheck, sequence: Sequence[int] = ()) -> dict[str, Any]:
    """What registration.json says of a check, as plain JSON; of each image under "images", by name.

    ``sequence``: image ids in the order in which photos were taken, where that is known.
    """
    names, check = [model.image(i).name for i in checked.ids], checked.check
    votes = check.votes_for + check.votes_against
    return {
        "pairs": int(check.agrees.sum() + check.contradicts.sum()),
        "agreeing": int(check.agrees.sum()),
        "error_px": check.median_px,
        "tolerance_px": check.tolerance_px,
        "noise_px": None if np.isnan(checked.matches.noise_px) else checked.matches.noise_px,
        "fits": checked.fits,
        "doubtful": [name for name, misplaced in zip(names, check.misplaced, strict=True) if misplaced],
        "weak_links": [
            {"photos": [names[i] for i in link.photos], "pairs": link.pairs, "matches": link.matches}
            for link in weak_links(checked.matches, check)
        ],
        "sequence_breaks": [
            [names[i] for i in step] for step in sequence_breaks(checked.numbers(sequence), checked.matches, check)
        ],
        "images": {
            name: {"agreement": agree / of if of else None, "transfer_px": float(px) if np.isfinite(px) else None}
            for name, agree, of, px in zip(names, check.votes_for, votes, check.photo_error_px, strict=True)
        },
    }


def fragments_sequence(checked: ModelCheck, sequence: Sequence[int]) -> bool:
    """Whether the poses fragment the capture ``sequence`` (image ids): no single photo is at fault then."""
    return is_fragmented(checked.numbers(sequence), checked.matches, checked.check)


def supported_steps(
    model: pycolmap.Reconstruction, database: Path, trusted: Container[tuple[int, int]]
) -> set[tuple[int, int]]:
    """The ``trusted`` pairs (image ids, the lower first) of registered images whose verified matches agree with their
    poses: all those of a ``database`` before :func:`copy_consistent_matches`, which leaves only those that do."""
    with pycolmap.Database.open(database) as db:
        ids, matches = read_pair_matches(db, model, 0, most=None)
    pairs = np.array(ids)[matches.pairs].tolist()
    steps = np.array([(i, j) in trusted for i, j in pairs], bool)
    supported = supported_pairs(matches, camera_poses(model), steps)
    return {(i, j) for (i, j), agrees in zip(pairs, supported, strict=True) if agrees}


def supported_runs(
    model: pycolmap.Reconstruction, database: Path, trusted: Container[tuple[int, int]]
) -> list[list[int]]:
    """The images (ids, sorted) of a model by which of them hang together by :func:`supported_steps`, most images
    first."""
    ids = np.array(sorted(model.reg_image_ids()), int)
    steps = np.searchsorted(ids, np.array([*supported_steps(model, database, trusted)], int).reshape(-1, 2))
    linked = np.zeros((len(ids), len(ids)), bool)
    linked[steps[:, 0], steps[:, 1]] = True
    group = connected(linked)
    return sorted((ids[group == number].tolist() for number in np.unique(group)), key=len, reverse=True)


class Candidate(NamedTuple):
    """A model and its check."""

    model: pycolmap.Reconstruction
    checked: ModelCheck


def better(first: Candidate, second: Candidate) -> Candidate:
    """The model that clearly more verified pairs agree with, else the one of which more photos pass, else the first."""
    strict = [_under_smallest_tolerance(one, (first, second)) for one in (first, second)]
    pairs, photos = ([int(getattr(check, name).sum()) for check in strict] for name in ("agrees", "passed"))
    if min(pairs) >= CLEARLY_FEWER * max(pairs):
        return second if photos[1] > photos[0] else first
    return second if pairs[1] > pairs[0] else first


def agreeing_pairs(first: Candidate, second: Candidate) -> tuple[set[tuple[int, int]], ...]:
    """The verified pairs (image ids) that agree with the poses of either model."""

    def agreeing(candidate: Candidate) -> set[tuple[int, int]]:
        ids, check = np.array(candidate.checked.ids), _under_smallest_tolerance(candidate, (first, second))
        return {(int(i), int(j)) for i, j in np.sort(ids[candidate.checked.matches.pairs[check.agrees]], axis=1)}

    return agreeing(first), agreeing(second)


def _under_smallest_tolerance(candidate: Candidate, candidates: Sequence[Candidate]) -> PoseCheck:
    """The check with one tolerance for all: a model that is wrong as a whole has large errors everywhere, and so a
    large tolerance of its own."""
    tolerance = min(one.checked.check.tolerance_px for one in candidates)
    return check_poses(candidate.checked.matches, camera_poses(candidate.model), tolerance)
