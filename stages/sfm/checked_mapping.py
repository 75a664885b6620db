"""From matches to a model whose poses pass the check, compared with global mapping. Runs in the worker process."""

import shutil
import time
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from stages.contract import Note
from stages.sfm import global_mapping
from stages.sfm.colmap.adjustment.bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.database.calibration import MAX_EXIF_RATIO, Told, far_apart
from stages.sfm.colmap.database.images import adopt_cameras
from stages.sfm.colmap.database.matching import best_linked
from stages.sfm.colmap.database.thinning import thin_matches
from stages.sfm.colmap.joining import Piece, join_pieces
from stages.sfm.colmap.mappers import incremental_options, map_incrementally
from stages.sfm.colmap.model_check import (
    Candidate,
    agreeing_pairs,
    better,
    check_model,
    fragments_sequence,
    reasons,
    supported_runs,
    supported_steps,
)
from stages.sfm.colmap.model_comparison import compare_models, differ_by_drift, disagree, linked_share
from stages.sfm.colmap.models import load_native
from stages.sfm.colmap.repair import copy_consistent_matches, deregister, drop_outside_main_segment, register_again
from stages.sfm.extraction_and_matching import capture_sequence, consecutive_pairs
from stages.sfm.job import JobState
from stages.sfm.retry_strategies import (
    FINAL_ADJUSTMENT_FACTOR,
    MIN_MISSING_TO_START_OVER,
    STRATEGIES,
    MappingOptions,
    Strategy,
    mapping_seconds,
)

CALIBRATING_PHOTOS = 40
MAX_STRAY_FRACTION = 0.05  # of all photos: so few outside the sequence do not say that the scene repeats itself
MIN_PHOTOS_OF_CAMERA = 10  # in a row, for their camera to be taken for that of all


class Runs(NamedTuple):
    """A model, and the runs of its images (ids) that hang together by steps its matches support, the longest first."""

    model: Any
    runs: Sequence[Sequence[int]]

    @property
    def length(self) -> int:
        """How many images hang together."""
        return len(self.runs[0])


class MappingInput(NamedTuple):
    """``database`` has all verified matches, ``matches`` those that mapping works on, the best ones where these are
    thinned. ``options`` are those of incremental mapping. Where there are ``trusted`` pairs (image ids, the lower
    first), the model hangs by them from photo to photo."""

    database: Path
    matches: Path
    options: Any
    trusted: Collection[tuple[int, int]]


class CheckedModel(NamedTuple):
    """The model with only the images that passed the check, by name why others are excluded, whether the sequence of
    photos was broken in it, and whether it fits the matches as a whole. ``candidates``: all that were checked and have
    kept their images since."""

    model: Any
    excluded: dict[str, Note]
    sequence_broken: bool
    fits: bool
    candidates: Sequence[Candidate]


class Mapped(NamedTuple):
    """All sub-models, best first; the best one as checked, which is also the first of these; how global mapping
    compares, None where it was not begun or gave the only model."""

    models: Sequence[Any]
    checked: CheckedModel
    global_mapping: dict[str, Any] | None


def run_mapping(strategy: Strategy, database: Path, state: JobState) -> Mapped | None:
    """Map these matches, and check the best model; None if there is none."""
    state.begin("mapping", done=0)
    seed, camera_is_known = state.job.seed, state.job.camera_params is not None
    matches, mapping, hold_focal, held = database, strategy.mapping or MappingOptions(), False, set[int]()
    if state.thinned:
        matches = state.sibling("thinned")
        told = thin_matches(database, matches, camera_is_known=camera_is_known)
        hold_focal = told.all and mapping.hold_focal
        if told.cameras and mapping.hold_focal and strategy.mapping is not None:
            held = calibrate_by_few(matches, mapping, told, state)
    calibrated = len(held) == len({photo.camera_group for photo in state.photos})
    global_run = _start_global_mapping(strategy, matches, camera_is_known or calibrated, state)
    # Where some cameras are not told, what COLMAP holds of the others is all of them.
    held = set() if hold_focal else held
    options = incremental_options(seed, mapping, camera_is_known, state.thinned, hold_focal, held)
    trusted = consecutive_pairs(state) if strategy.matches == "consecutive" else set[tuple[int, int]]()
    if strategy.mapping is None:
        found = _map_globally(matches, camera_is_known, state)
    else:
        found = _map_incrementally(matches, options, state)
        if found and (hold_focal or held):
            release_focal_lengths(found[0])
        if found and trusted:
            found = _most_steps(found, matches, mapping, hold_focal, state, trusted)
    failure = _not_compared(global_run, state) if global_run else None
    others = global_mapping.found_models(global_run) if global_run and not failure else []
    if not found and others:
        text = "global mapping is used: incremental mapping found no model"
        state.send(note=Note("sfm.global-mapping-alone", text))
        found, others = others, []
    mapped = None
    if found:
        if trusted:
            copy_consistent_matches(found[0], state.database, database, trusted)
        other = others[0] if others else None
        checked = _checked(found[0], other, MappingInput(database, matches, options, trusted), state)
        if other is None:
            compared = {"failed": failure} if failure else None
        else:
            compared = _comparison(checked, found[0], other, database, state)
        mapped = Mapped([checked.model, *found[1:]], checked, compared)
    state.end("mapping")
    return mapped


def register_missing(strategy: Strategy, database: Path, state: JobState) -> Mapped:
    """As :func:`run_mapping`, going on from the best model so far, whose missing photos have new matches: as many of
    them as can be are registered in it."""
    best, seed, known = state.usable(), state.job.seed, state.job.camera_params is not None
    assert best is not None and strategy.mapping is not None, "only of a model are photos missing"
    state.begin("mapping", done=len(best.groups[0]) - 1)
    model, matches, hold_focal = load_native(state.log.model(best.name)), database, False
    if state.thinned:
        matches = state.sibling("missing-thinned")
        hold_focal = thin_matches(database, matches, camera_is_known=known).all and strategy.mapping.hold_focal
    options = incremental_options(seed, strategy.mapping, known, state.thinned, hold_focal)
    scratch = Path(state.job.folder, "again")
    model = register_again(model, check_model(model, database, seed), matches, state.images, scratch, options)
    checked = _checked(model, None, MappingInput(database, matches, options, set()), state)
    state.end("mapping")
    return Mapped([checked.model], checked, best.global_mapping)


def calibrate_by_few(matches: Path, mapping: MappingOptions, told: Told, state: JobState) -> set[int]:
    """Give the cameras that the best linked photos share, of those whose focal lengths are ``told``, the intrinsics of
    a model of these photos alone. Returns these cameras (ids); where some are not told only those of several photos.

    All pairs together know nothing of distortion. Where the camera looks across its path, photo by photo, mapping with
    a focal length that is a little off bends a straight path, in the end to a circle, and no adjustment of hundreds of
    photos straightens it. A few photos hardly bend. Focal lengths far from what all pairs tell are not believed.
    """
    few = best_linked(matches, CALIBRATING_PHOTOS, told.cameras)
    options = incremental_options(state.job.seed, mapping, False, state.thinned, True)
    options.image_names = few
    found = _map_incrementally(matches, options, state)
    if not found or 2 * found[0].num_reg_images() < len(few):
        return set()
    before = {camera.camera_id: camera.mean_focal_length() for camera in found[0].cameras.values()}
    release_focal_lengths(found[0])
    photos = Counter(found[0].image(image_id).camera_id for image_id in found[0].reg_image_ids())
    known = {
        camera
        for camera, count in photos.items()
        if (told.all or count >= MIN_PHOTOS_OF_CAMERA)
        and not far_apart(before[camera], found[0].camera(camera).mean_focal_length(), MAX_EXIF_RATIO)
    }
    adopt_cameras(matches, found[0], known)
    return known


def _map_incrementally(matches: Path, options: Any, state: JobState) -> list[Any]:
    models, registered = Path(state.job.folder, "models"), count(1)
    found = map_incrementally(
        matches, state.images, models, options, lambda: state.send(phase="mapping", done=next(registered))
    )
    shutil.rmtree(models)
    return found


def _most_steps(
    found: list[Any],
    matches: Path,
    mapping: MappingOptions,
    hold_focal: bool,
    state: JobState,
    trusted: Collection[tuple[int, int]],
) -> list[Any]:
    """The sub-models by how many photos hang together in them by ``trusted`` pairs, the longest pieces joined.

    They are mapped once more with the cameras of the longest piece held: where a photo sees one plane, a pair alone
    tells neither its pose nor its camera (docs/experiments/match_graph.md). Cameras that this piece does not have, of
    photos that do not share theirs, are as free as before: it says nothing about them.
    """
    known = state.job.camera_params is not None

    def by_length(models: list[Any]) -> list[Runs]:
        runs = [Runs(model, supported_runs(model, state.database, trusted)) for model in models]
        return sorted(runs, key=lambda one: one.length, reverse=True)

    ranked = by_length(found)
    model, (longest, *_) = ranked[0]
    if not known and len(longest) >= MIN_PHOTOS_OF_CAMERA:
        held = {model.image(image_id).camera_id for image_id in longest}
        adopt_cameras(matches, model, held)
        options = incremental_options(state.job.seed, mapping, known, state.thinned, hold_focal, held)
        again = by_length(_map_incrementally(matches, options, state))
        ranked = max(ranked, again, key=lambda models: models[0].length if models else 0)
    return _with_pieces_joined(ranked, state, trusted)


def _with_pieces_joined(ranked: Sequence[Runs], state: JobState, trusted: Collection[tuple[int, int]]) -> list[Any]:
    """The models, the one with the longest run first; before them a model of joined pieces if its steps hold more
    photos together. It takes the place of models that have no other photos."""
    found = [one.model for one in ranked]
    pieces = [Piece(one.model, run) for one in ranked for run in one.runs]
    joined = join_pieces(pieces, camera_is_known=state.job.camera_params is not None)
    if joined is None or len(supported_runs(joined, state.database, trusted)[0]) <= ranked[0].length:
        return found
    have = {*joined.reg_image_ids()}
    return [joined, *(model for model in found if not have.issuperset(model.reg_image_ids()))]


def _comparison(checked: CheckedModel, incremental: Any, other: Any, database: Path, state: JobState) -> dict[str, Any]:
    """How the models of ``incremental`` and global mapping (``other``) compare, the one that was taken first; and where
    they differ, how many verified pairs agree with either."""
    taken, rejected = checked.model, incremental if checked.model is other else other
    compared = compare_models(taken, rejected) | {"failed": None, "drift": False}
    compared |= dict.fromkeys(("agreeing", "agreeing_other", "linked", "linked_other"))
    if compared["different"]:
        known = {id(one.model): one for one in checked.candidates}
        first, second = (known.get(id(one)) or _candidate(one, database, state) for one in (taken, rejected))
        pairs, shared = agreeing_pairs(first, second), {*taken.reg_image_ids()} & {*rejected.reg_image_ids()}
        names = {*compared["different"]}
        different = {image_id for image_id in shared if taken.image(image_id).name in names}
        counts = [sum(not different.isdisjoint(pair) for pair in of) for of in pairs]
        compared["agreeing"], compared["agreeing_other"] = counts
        compared["linked"], compared["linked_other"] = (linked_share(shared, of) for of in pairs)
        compared["drift"] = differ_by_drift(taken, rejected, pairs[0] & pairs[1])
    return compared | {"taken": taken is other}


def _candidate(model: Any, database: Path, state: JobState) -> Candidate:
    return Candidate(model, check_model(model, database, state.job.seed))


def _start_global_mapping(
    strategy: Strategy, matches: Path, cameras_are_known: bool, state: JobState
) -> "global_mapping.Started | None":
    """Global mapping begun beside the first strategy, of the same matches; None where it would tell nothing. It adjusts
    cameras that are not known more freely than incremental mapping, and bends a straight path by it."""
    if strategy.name != STRATEGIES[0].name or len(state.photos) < global_mapping.MIN_PHOTOS:
        return None
    thinned, folder = state.sibling("global"), state.log.folder / "global"
    return global_mapping.start(matches, thinned, state.images, folder, state.job.seed, cameras_are_known)


def _not_compared(started: "global_mapping.Started", state: JobState) -> str | None:
    """Why there is no model of global mapping to compare with, which is said; None if there is one."""
    if failure := _global_failure(started, time.monotonic() - started.began, state):
        state.send(note=Note("sfm.not-compared", f"global mapping gave no model to compare with: {failure}"))
    return failure


def _map_globally(matches: Path, camera_is_known: bool, state: JobState) -> list[Any]:
    """All sub-models of global mapping, best first; none, which is said, where it does not end in time."""
    folder, seed = state.log.folder / "global", state.job.seed
    started = global_mapping.start(matches, None, state.images, folder, seed, camera_is_known)
    if failure := _global_failure(started, mapping_seconds(state.log.outcomes), state):
        state.send(note=Note("sfm.no-global-model", f"global mapping gave no model: {failure}"))
        return []
    return global_mapping.found_models(started)


def _global_failure(started: "global_mapping.Started", mapped_for: float, state: JobState) -> str | None:
    """Why there is no model of global mapping, None if there is one, where incremental mapping took so many seconds. It
    may not take the time in which the best model has to be adjusted."""
    for_adjustment = FINAL_ADJUSTMENT_FACTOR * mapped_for
    seconds = min(global_mapping.patience(started, mapped_for), state.left_at_most() - for_adjustment)
    return global_mapping.failure(started, seconds)


def _checked(model: Any, other: Any, given: MappingInput, state: JobState) -> CheckedModel:
    """The model without the images that fail the check. These are registered again first, in the model of global
    mapping where that fits the verified matches better. Of a model that hangs by trusted pairs from photo to photo each
    of these has to agree."""
    best, sequence = _candidate(model, given.database, state), capture_sequence(given.database, state)
    candidates = [best]
    if not fragments_sequence(best.checked, sequence):
        failed = best.checked.failed()
        if other is not None and (_has_nearly_all(other, model, state) or failed or disagree(model, other)):
            candidates.append(_candidate(other, given.database, state))
            best = better(*candidates)
            if best.model is other:
                state.send(
                    note=Note(
                        "sfm.global-mapping",
                        "global mapping is used: it agrees better with the verified matches than incremental mapping",
                    )
                )
        if failed := best.checked.failed():
            misplaced = best.checked.check.misplaced.any()
            what = "contradict their verified matches" if misplaced else "are not linked to the others"
            state.send(
                note=Note(
                    "sfm.registered-again",
                    f"{len(failed)} of {len(best.checked.ids)} registered photos {what}: registering them again",
                )
            )
            scratch = Path(state.job.folder, "again")
            again = register_again(*best, given.matches, state.images, scratch, given.options)
            candidates.append(_candidate(again, given.database, state))
            best = max(best, candidates[-1], key=lambda one: int(one.checked.check.passed.sum()))
    why = reasons(*best)
    deregister(best.model, best.checked.failed())
    supported = supported_steps(best.model, state.database, given.trusted) if given.trusted else None
    outside = drop_outside_main_segment(*best, sequence, supported)
    excluded = why | outside
    kept = [one for one in candidates if not (excluded and one is best)]
    broken = len(outside) > MAX_STRAY_FRACTION * len(state.photos)
    return CheckedModel(best.model, excluded, broken, best.checked.fits, kept)


def _has_nearly_all(other: Any, model: Any, state: JobState) -> bool:
    """Whether it has more images than the model and lacks only a few: of a model that lacks many, all that these lack
    is looked for again."""
    missing = len(state.photos) - other.num_reg_images()
    return other.num_reg_images() > model.num_reg_images() and missing < MIN_MISSING_TO_START_OVER * len(state.photos)
