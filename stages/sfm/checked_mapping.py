"""From matches to a model whose poses pass the check, compared with global mapping. Runs in the worker process."""

import shutil
from collections.abc import Collection, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from stages.contract import Note
from stages.sfm import global_mapping
from stages.sfm.colmap.database import adopt_cameras
from stages.sfm.colmap.diagnosis import compare_models, disagree
from stages.sfm.colmap.final_bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.joining import Piece, join_pieces
from stages.sfm.colmap.mappers import incremental_options, map_globally, map_incrementally
from stages.sfm.colmap.models import load_native
from stages.sfm.colmap.repair import (
    Candidate,
    agreeing_pairs,
    better,
    check_model,
    copy_consistent_matches,
    deregister,
    drop_outside_main_segment,
    fragments_sequence,
    reasons,
    register_again,
    supported_runs,
    supported_steps,
)
from stages.sfm.colmap.thinning import MAX_EXIF_RATIO, best_linked, far_apart, thin_matches
from stages.sfm.job import JobState
from stages.sfm.matching import capture_sequence, consecutive_pairs
from stages.sfm.retry_strategies import MIN_MISSING_TO_START_OVER, STRATEGIES, MappingOptions, Strategy

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


class CheckedModel(NamedTuple):
    """The model with only the images that passed the check, by name why others are excluded, whether the sequence of
    photos was broken in it, and whether it fits the matches as a whole. ``checks``: of all models that were checked and
    have kept their images since."""

    model: Any
    excluded: dict[str, Note]
    sequence_broken: bool
    fits: bool
    checks: Sequence[Candidate] = ()


def run_mapping(
    strategy: Strategy, database: Path, state: JobState
) -> tuple[list[Any], CheckedModel, dict[str, Any] | None]:
    """All sub-models of these matches, best first; the best one as checked, which also takes its place in the list;
    and how global mapping compares."""
    state.begin("mapping", done=0)
    seed, camera_is_known = state.job.seed, state.job.camera_params is not None
    models, matches = Path(state.job.folder, "models"), database
    mapping = strategy.mapping or MappingOptions()
    hold_focal = calibrated = False
    if state.thinned:
        matches = state.sibling("thinned")
        hold_focal = thin_matches(database, matches, camera_is_known=camera_is_known) and mapping.hold_focal
        if hold_focal and strategy.mapping is not None:
            calibrated = calibrate_by_few(matches, mapping, state)
    comparison = _start_global_mapping(strategy, matches, camera_is_known or calibrated, state)
    options = incremental_options(seed, mapping, camera_is_known, state.thinned, hold_focal)
    trusted = consecutive_pairs(state) if strategy.matches == "consecutive" else set[tuple[int, int]]()
    if strategy.mapping is None:
        found = map_globally(matches, state.images, models, seed, camera_is_known)
        shutil.rmtree(models)
    else:
        found = _map_incrementally(matches, options, state)
        if found and hold_focal:
            release_focal_lengths(found[0])
        if found and trusted:
            found = _most_steps(found, matches, mapping, hold_focal, state, trusted)
    checked = CheckedModel(None, {}, False, False)
    failure = global_mapping.failure(comparison) if comparison else None
    other = load_native(comparison.folder) if comparison and not failure else None
    compared = None if comparison is None else {"failed": failure}
    if found:
        before = found[0]
        if trusted:
            copy_consistent_matches(before, state.database, database, trusted)
        checked = _checked(before, other, database, matches, options, state, trusted)
        found[0] = checked.model
        if other is not None:  # where it was taken itself, it is compared with the one that it replaced
            rejected = before if found[0] is other else other
            compared = _comparison(found[0], rejected, checked.checks, database, state)
            compared["taken"] = found[0] is other
    state.end("mapping")
    return found, checked, compared


def register_missing(
    strategy: Strategy, database: Path, state: JobState
) -> tuple[list[Any], CheckedModel, dict[str, Any] | None]:
    """As :func:`run_mapping`, going on from the best model so far, whose missing photos have new matches: as many of
    them as can be are registered in it."""
    state.begin("mapping", done=0)
    best, seed, known = state.usable(), state.job.seed, state.job.camera_params is not None
    assert best is not None and strategy.mapping is not None, "only of a model are photos missing"
    model, matches = load_native(state.log.model(best.name)), database
    if state.thinned:
        matches = state.sibling("missing-thinned")
        thin_matches(database, matches, camera_is_known=True)
    options = incremental_options(seed, strategy.mapping, known, state.thinned, hold_focal=state.thinned)
    scratch = Path(state.job.folder, "again")
    model = register_again(model, check_model(model, database, seed), matches, state.images, scratch, options)
    checked = _checked(model, None, database, matches, options, state, ())
    state.end("mapping")
    return [checked.model], checked, best.global_mapping


def calibrate_by_few(matches: Path, mapping: MappingOptions, state: JobState) -> bool:
    """Give the cameras that the best linked photos share the intrinsics of a model of these alone. Returns whether
    these are the cameras of all photos.

    All pairs together know nothing of distortion. Where the camera looks across its path, photo by photo, mapping with
    a focal length that is a little off bends a straight path, in the end to a circle, and no adjustment of hundreds of
    photos straightens it. A few photos hardly bend. Focal lengths far from what all pairs tell are not believed.
    """
    few = best_linked(matches, CALIBRATING_PHOTOS)
    options = incremental_options(state.job.seed, mapping, False, state.thinned, True)
    options.image_names = few
    found = _map_incrementally(matches, options, state)
    if not found or 2 * found[0].num_reg_images() < len(few):
        return False
    told = {camera.camera_id: camera.mean_focal_length() for camera in found[0].cameras.values()}
    release_focal_lengths(found[0])
    known = [
        image_id
        for image_id in sorted(found[0].reg_image_ids())
        if not far_apart(
            told[camera := found[0].image(image_id).camera_id],
            found[0].camera(camera).mean_focal_length(),
            MAX_EXIF_RATIO,
        )
    ]
    adopted = adopt_cameras(matches, found[0], known)
    return len(adopted) == len({photo.camera_group for photo in state.photos})


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
        held = adopt_cameras(matches, model, longest)
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


def _comparison(model: Any, other: Any, checks: Sequence[Candidate], database: Path, state: JobState) -> dict[str, Any]:
    """How the models of incremental and global mapping compare, the one that was taken first; and where they differ,
    how many verified pairs agree with either."""
    compared = compare_models(model, other) | {"failed": None, "agreeing": None, "agreeing_other": None}
    if compared["different"]:
        known = {id(one): checked for one, checked in checks}
        taken, rejected = (
            (one, known.get(id(one)) or check_model(one, database, state.job.seed)) for one in (model, other)
        )
        compared["agreeing"], compared["agreeing_other"] = agreeing_pairs(taken, rejected, compared["different"])
    return compared


def _start_global_mapping(
    strategy: Strategy, matches: Path, cameras_are_known: bool, state: JobState
) -> "global_mapping.Started | None":
    """Global mapping begun beside the first strategy, of the same matches; None where it would tell nothing. It adjusts
    cameras that are not known more freely than incremental mapping, and bends a straight path by it."""
    if strategy.name != STRATEGIES[0].name or len(state.photos) < global_mapping.MIN_PHOTOS:
        return None
    thinned, folder = state.sibling("global"), state.log.folder / "global"
    return global_mapping.start(matches, thinned, state.images, folder, state.job.seed, cameras_are_known)


def _checked(
    model: Any,
    other: Any,
    database: Path,
    matches: Path,
    options: Any,
    state: JobState,
    trusted: Collection[tuple[int, int]],
) -> CheckedModel:
    """The model without the images that fail the check. These are registered again first, in the model of global
    mapping where that fits the verified matches better. Of a model that hangs by ``trusted`` pairs from photo to photo
    each of these has to agree."""
    best, sequence = (model, check_model(model, database, state.job.seed)), capture_sequence(database, state)
    checks = [best]
    if not fragments_sequence(best[1], sequence):
        if other is not None and (_has_nearly_all(other, model, state) or best[1].failed() or disagree(model, other)):
            checks.append((other, check_model(other, database, state.job.seed)))
            best = better(*checks)
            if best[0] is other:
                state.send(
                    note=Note(
                        "sfm.global-mapping",
                        "global mapping is used: it agrees better with the verified matches than incremental mapping",
                    )
                )
        if failed := best[1].failed():
            misplaced = best[1].check.misplaced.any()
            what = "contradict their verified matches" if misplaced else "are not linked to the others"
            state.send(
                note=Note(
                    "sfm.registered-again",
                    f"{len(failed)} of {len(best[1].ids)} registered photos {what}: registering them again",
                )
            )
            again = register_again(*best, matches, state.images, Path(state.job.folder, "again"), options)
            checks.append((again, check_model(again, database, state.job.seed)))
            best = max(best, checks[-1], key=_passing)
    model, checked = best
    why = reasons(model, checked)
    deregister(model, checked.failed())
    supported = supported_steps(model, state.database, trusted) if trusted else None
    outside = drop_outside_main_segment(model, checked, sequence, supported)
    excluded = why | outside
    broken = len(outside) > MAX_STRAY_FRACTION * len(state.photos)
    return CheckedModel(
        model, excluded, broken, checked.fits, [one for one in checks if not (excluded and one is best)]
    )


def _has_nearly_all(other: Any, model: Any, state: JobState) -> bool:
    """Whether it has more images than the model and lacks only a few: of a model that lacks many, all that these lack
    is looked for again."""
    missing = len(state.photos) - other.num_reg_images()
    return other.num_reg_images() > model.num_reg_images() and missing < MIN_MISSING_TO_START_OVER * len(state.photos)


def _passing(candidate: Candidate) -> int:
    return int(candidate[1].check.passed.sum())
