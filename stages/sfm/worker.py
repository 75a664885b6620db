"""The worker process of stage sfm: all of structure-from-motion, away from the program that the user talks to.

COLMAP is native code that may abort or hang; here that ends one process and nothing else. The parent writes one line
of JSON (a :class:`Job`) to stdin and keeps stdin open: its end means that the parent is gone, and so this process
goes too. Messages to the parent are lines of JSON on stdout; whatever COLMAP prints goes to stderr, the log.
"""

import json
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.contract import Note, StageError
from stages.hardware import cluster
from stages.io.amounts import rough_duration
from stages.io.files import make_durable
from stages.sfm.checked_mapping import register_missing, run_mapping
from stages.sfm.colmap.adjustment.final_bundle_adjustment import final_bundle_adjustment
from stages.sfm.colmap.database.matching import matched_pairs
from stages.sfm.colmap.model_check import check_model, facts, reasons
from stages.sfm.colmap.model_comparison import find_conflict
from stages.sfm.colmap.models import load_native, turned_upright, write_native
from stages.sfm.colmap.repair import deregister
from stages.sfm.colmap.unregistered_images import links, supports
from stages.sfm.extraction_and_matching import capture_sequence, enlargement, match_photos, relaxed_pairs
from stages.sfm.job import Job, JobState, Send, end_with_parent, worker_lock
from stages.sfm.retry_strategies import (
    INDEXED_COST,
    MIN_LONG_FOCAL,
    STRATEGIES,
    TIME_GIVEN,
    Outcome,
    Situation,
    Skip,
    Strategy,
    exceeds_time,
    expected_seconds,
    reason_against,
)

MIN_SECONDS_SAID = 30.0  # that a strategy takes, to be worth a word


def main() -> None:
    """Read the job from stdin, do it, send the result."""
    job = Job(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=end_with_parent, daemon=True).start()
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # nothing else may write on the channel

    def send(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")

    try:
        with worker_lock(Path(job.folder)), cluster.joined(job.cluster):
            send(result=reconstruct(job, send))
    except StageError as error:
        send(error=[error.code, error.what, error.why, error.hint])
    except Exception as fault:  # the log, where Python will write it, may lie on the disk that is full
        send(fault=f"{type(fault).__name__}: {fault}".splitlines()[0])
        raise


def reconstruct(job: Job, send: Send) -> dict[str, Any]:
    """Run structure-from-motion and write the best sub-model to ``sparse/``; nothing if none came out that is usable.

    Returns the ``database`` that was used in the end, the files in each sub-model, best first (``models``), the
    ``strategies`` that were tried or skipped, how many of these for want of time (``skipped_for_time``), and of the
    best model: the ``conflict`` with another one, ``points``, mean ``reprojection_px``, ``camera_model``, the
    comparison of ``camera_models``, by file ``observations``, ``uncertainty_px`` and, where a camera cannot be used,
    why (``left_out``), and for every unregistered image how many of its features are points of the model and how many
    of them agree on a pose (``supports``).
    """
    state = JobState(job, send)
    state.timer.save_regularly()
    _try_strategies(state)
    tried = {"strategies": state.log.report(), "skipped_for_time": state.log.skipped_for_time()}
    best = state.usable()
    if best is None:
        poor = state.log.best()
        models, points = (poor.groups, poor.points) if poor else ([], 0)
        return {"database": str(state.latest()), "models": models, "points": points, **tried}
    send(phase="refining")
    database = state.latest()
    # From disk also where it is at hand: then a resumed run is no other.
    mapped = load_native(state.log.model(best.name))
    known = job.camera_params is not None
    finished = final_bundle_adjustment(mapped, database, job.seed, job.camera_model, known, state.thinned)
    for note in finished.notes:
        send(note=note)
    model = finished.model
    checked, left_out = _last_check(model, database, state)
    checked["doubtful"] = sorted({*checked["doubtful"], *({*best.excluded, *left_out} - {*_files(model)})})
    upright = turned_upright(model, state.turns) if state.turns else model
    upright.extract_colors_for_all_images(state.images)  # mapping leaves colours out
    left_out = best.excluded | finished.left_out | left_out
    registered = [model.image(i) for i in sorted(model.reg_image_ids())]
    write_native(Path(job.folder, "sparse"), upright)
    return {
        "database": str(database),
        **tried,
        "models": [_files(model), *best.groups[1:]],
        "observations": {image.name: image.num_points3D for image in registered},
        "uncertainty_px": finished.uncertainty_px,
        "left_out": {name: why for name, why in left_out.items() if name not in _files(model)},
        "points": model.num_points3D(),
        "reprojection_px": model.compute_mean_reprojection_error(),
        "camera_model": "/".join(sorted({model.camera(image.camera_id).model_name for image in registered})),
        "camera_models": finished.camera_models,
        "conflict": best.conflict,
        "supports": supports(model, database, job.seed),
        "match_graph": best.match_graph,
        "check": checked,
        "global_mapping": best.global_mapping,
    }


def _last_check(model: Any, database: Path, state: JobState) -> tuple[dict[str, Any], dict[str, Note]]:
    """What the check finds in the finished model, for registration.json, and by name why images that fail leave it."""
    checked = check_model(model, database, state.job.seed)
    failed, left_out = checked.failed(), {}
    if 0 < 2 * len(failed) < len(checked.ids):
        left_out = reasons(model, checked)
        deregister(model, failed)
        checked = check_model(model, database, state.job.seed)
    return facts(model, checked, capture_sequence(database, state)), left_out


def _try_strategies(state: JobState) -> None:
    """Try the strategies that are left while images are unregistered, and say which were skipped, and why."""
    log, unsaid = state.log, {}
    for strategy in log.left():
        log.skipped.pop(strategy.name, None)  # of an interrupted run that had less time
        if strategy not in STRATEGIES[: state.job.max_strategies] or not (missing := state.missing()):
            continue
        if strategy.matches == "consecutive" and not state.log.sequence_broken():
            continue
        if strategy.name == STRATEGIES[0].name:
            _try(strategy, missing, state)
        elif why := _why_useless(strategy, missing, state):
            log.skipped[strategy.name] = Skip(why)
            unsaid.setdefault(why, []).append(strategy.description)
        elif why := _why_infeasible(strategy, takes := _expected(strategy, missing, state), state):
            log.skipped[strategy.name] = why
        else:
            are = "is" if len(missing) == 1 else "are"
            why = f"{len(missing)} of {len(state.photos)} photos {are} unregistered"
            if _is_misfit(state):
                why = "the cameras do not fit the verified matches"
            more = " more" if state.job.seconds is None else ""  # than was expected of the run; else they are given
            duration = f" (about {rough_duration(takes)}{more})" if takes >= MIN_SECONDS_SAID else ""
            state.send(note=Note("sfm.strategy", f"{why}: {strategy.description}{duration}"))
            _try(strategy, missing, state)
    for why, descriptions in unsaid.items():
        state.send(note=Note("sfm.strategy-useless", f"not tried, because {why}: {'; '.join(descriptions)}"))


def _why_useless(strategy: Strategy, missing: list[int], state: JobState) -> str | None:
    """Why the strategy cannot help, None if it can."""
    misfit = _is_misfit(state)
    groups = best.groups if (best := state.usable()) and not misfit else [[]]
    alone = {state.files[number] for number in missing}.difference(*groups)
    count, given = len(state.photos), state.job.camera_model is not None
    long_lenses = all(
        photo.focal_px is not None and photo.focal_px > MIN_LONG_FOCAL * max(photo.width, photo.height)
        for photo in state.photos
    )
    broken = state.log.sequence_broken()
    now = Situation(len(missing), len(alone), count, True, False, given, broken, misfit, long_lenses)
    # First as if no matches spoke against it: there are many of them to read.
    if len(missing) < count and (why := reason_against(strategy, now)):
        return why
    linked, planar = links(state.latest(), set(groups[0]))
    return reason_against(strategy, now._replace(linked=linked, planar=planar and len(missing) == count))


def _is_misfit(state: JobState) -> bool:
    """Whether even the best model does not fit its verified matches."""
    best = state.usable()
    return best is not None and not best.fits


def _why_infeasible(strategy: Strategy, expected: float, state: JobState) -> Skip | None:
    """Why the strategy, of so many ``expected`` seconds, might help and is skipped all the same, which is said; None if
    it is tried."""
    if ended := state.log.abandoned.get(strategy.name):
        state.send(
            note=Note("sfm.strategy-failed-before", f"not tried, because {ended.why} last time: {strategy.description}")
        )
        return ended
    outcomes, (left, limit) = state.log.outcomes, state.left()
    if not exceeds_time(expected, outcomes, left):
        return None
    rest = f"{rough_duration(max(0.0, left))} of {limit} are left"
    if limit == TIME_GIVEN and state.usable() is None and not exceeds_time(expected, outcomes, state.left_at_most()):
        why = f"the other stages need cameras, so this takes longer than the given time: {rest}"
        state.send(note=Note("sfm.takes-longer", why))
        return None
    times = f"about {rough_duration(expected)} and the final bundle adjustment, and only {rest}"
    state.send(note=Note("sfm.strategy-too-slow", f"not tried, because it takes {times}: {strategy.description}"))
    return Skip(f"too little was left of {limit}", for_time=True)


def _expected(strategy: Strategy, missing: list[int], state: JobState) -> float:
    """How many seconds the strategy will take."""
    rematched, enlarged = 0.0, 1.0
    if strategy.matches in ("missing", "relaxed"):
        matched = len(matched_pairs(state.database))
        rematched = relaxed_pairs(strategy, len(missing), matched, state) / max(1, matched)
    elif strategy.matches == "more features":
        rematched = INDEXED_COST if state.job.matcher == "exhaustive" else 1.0
        enlarged = enlargement(state)
    return expected_seconds(strategy, state.log.outcomes, rematched, enlarged)


def _try(strategy: Strategy, missing: list[int], state: JobState) -> None:
    """Try a strategy and note its outcome."""
    state.send(strategy=strategy.name)
    state.strategy, state.seconds = strategy.name, {}
    database, match_graph = match_photos(strategy, missing, state)
    adding, before = strategy.matches == "missing", state.usable()
    mapped = (register_missing if adding else run_mapping)(strategy, database, state)
    outcome = Outcome(strategy.name, database.name, seconds=state.seconds, match_graph=match_graph)
    if mapped:
        folder, best = state.log.model(strategy.name), mapped.models[0]
        write_native(folder, best)
        make_durable(folder)
        outcome = replace(
            outcome,
            groups=[_files(model) for model in mapped.models],
            points=best.num_points3D(),
            reprojection_px=best.compute_mean_reprojection_error(),
            conflict=find_conflict(mapped.models),
            excluded=mapped.checked.excluded,
            sequence_broken=mapped.checked.sequence_broken,
            fits=mapped.checked.fits,
            global_mapping=mapped.global_mapping,
        )
        if adding and before:
            outcome = _added_to(before, outcome)
    state.log.add(outcome)


def _added_to(before: Outcome, after: Outcome) -> Outcome:
    """The outcome of adding photos to a model, whose other sub-models are as they were. Without a photo more it is no
    better than before."""
    registered = after.groups[0]
    conflict = before.conflict
    if conflict is not None:
        others = [file for file in conflict["others"] if file not in registered]
        conflict = {**conflict, "others": others} if others else None
    found = replace(
        after,
        groups=[registered, *before.groups[1:]],
        match_graph=before.match_graph,
        conflict=conflict,
        excluded={file: why for file, why in before.excluded.items() if file not in registered} | after.excluded,
    )
    if len(registered) > len(before.groups[0]):
        return found
    return replace(found, points=min(found.points, before.points), reprojection_px=before.reprojection_px)


def _files(model: Any) -> list[str]:
    return sorted(model.image(i).name for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
