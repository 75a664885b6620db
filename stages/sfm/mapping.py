"""From matches to a model in which every pose stands, and a second opinion. Runs in the child process of stage sfm."""

import shutil
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from stages.sfm import global_mapping
from stages.sfm.colmap.diagnosis import compare_models
from stages.sfm.colmap.mapping import incremental_options, map_globally, map_incrementally
from stages.sfm.colmap.models import load_native
from stages.sfm.colmap.repair import (
    Checked,
    check_model,
    copy_believed,
    deregister,
    drop_cut_off,
    reasons,
    register_again,
    tears,
)
from stages.sfm.colmap.thinning import thin_matches
from stages.sfm.matching import row_of, steps_of_row
from stages.sfm.retry_strategies import ATTEMPTS, Attempt, Effort
from stages.sfm.work import Work


class Standing(NamedTuple):
    """The model with only photos whose poses stand, by name why others are excluded, and whether they are since the row
    in which photos were taken falls apart."""

    model: Any
    excluded: dict[str, str]
    folded: bool


def mapped(attempt: Attempt, database: Path, work: Work) -> tuple[list[Any], Standing, dict[str, Any] | None]:
    """All sub-models that come of these matches, best first; what stands of the best one, which is its place there; and
    how a second opinion compares."""
    work.begin("mapping", done=0)
    seed, lens_is_known = work.job.seed, work.job.camera_params is not None
    models, matches = Path(work.job.folder, "models"), database
    opinion = _second_opinion(attempt, database, work)
    if work.thinned:
        matches = work.beside("thinned")
        thin_matches(database, matches)
    effort = attempt.effort or Effort()
    options = incremental_options(seed, effort, lens_is_known, work.thinned)
    if attempt.effort is None:
        found = map_globally(matches, work.images, models, seed, lens_is_known)
    else:
        placed = count(1)
        found = map_incrementally(
            matches, work.images, models, options, lambda: work.say(phase="mapping", done=next(placed))
        )
    shutil.rmtree(models)
    standing = Standing(None, {}, False)
    failure = global_mapping.failure(opinion) if opinion else None
    other = load_native(opinion.folder) if opinion and not failure else None
    compared = None if opinion is None else {"failed": failure}
    if found:
        before = found[0]
        if attempt.matches == "row":
            copy_believed(before, work.database, database, steps_of_row(work))
        standing = _standing(before, other, database, matches, options, work)
        found[0] = standing.model
        if other is not None:  # where it was taken itself, it is compared with the one that it replaced
            compared = compare_models(before if found[0] is other else found[0], other) | {"failed": None}
    work.end("mapping")
    return found, standing, compared


def _second_opinion(attempt: Attempt, database: Path, work: Work) -> "global_mapping.Started | None":
    """Global mapping begun beside the first attempt; None where it would say nothing."""
    if attempt.name != ATTEMPTS[0].name or len(work.photos) < global_mapping.MIN_PHOTOS:
        return None
    known, folder = work.job.camera_params is not None, work.journal.folder / "global"
    return global_mapping.start(database, work.beside("global"), work.images, folder, work.job.seed, known)


def _standing(model: Any, other: Any, database: Path, matches: Path, options: Any, work: Work) -> Standing:
    """What stands of the model. Photos that fail are freed and registered again, in the model of the second opinion
    where more photos pass in it."""
    best, row = (model, check_model(model, database, work.job.seed)), row_of(database, work)
    if (failed := best[1].failed()) and not tears(best[1], row):
        what = "contradict their verified matches" if best[1].check.misplaced.any() else "are not linked to the others"
        work.say(note=f"{len(failed)} of {len(best[1].ids)} registered photos {what}: registering them again")
        if other is not None:
            best = max(best, (other, check_model(other, database, work.job.seed)), key=_passing)
        if best[1].failed():
            again = register_again(*best, matches, work.images, Path(work.job.folder, "again"), options)
            best = max(best, (again, check_model(again, database, work.job.seed)), key=_passing)
    model, checked = best
    why = reasons(model, checked)
    deregister(model, checked.failed())
    cut_off = drop_cut_off(model, checked, row)
    return Standing(model, why | cut_off, bool(cut_off))


def _passing(candidate: tuple[Any, Checked]) -> int:
    return int(candidate[1].check.passed.sum())
