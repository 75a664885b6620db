"""The child process of stage sfm: all of structure-from-motion, away from the program that the user talks to.

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

from stages.io.amounts import rough_duration
from stages.io.files import make_durable
from stages.sfm.colmap.diagnosis import find_conflict, links, supports
from stages.sfm.colmap.models import load_native, write_native
from stages.sfm.colmap.refinement import finish
from stages.sfm.colmap.repair import check_model, deregister, facts, reasons
from stages.sfm.mapping import mapped
from stages.sfm.matching import matched, row_of
from stages.sfm.retry_strategies import (
    ATTEMPTS,
    NO_TIME,
    Attempt,
    Situation,
    Tried,
    expected_seconds,
    reason_against,
    time_against,
)
from stages.sfm.work import Job, Say, Work, end_with_parent


def main() -> None:
    """Read the job from stdin, do it, say the result."""
    job = Job(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=end_with_parent, daemon=True).start()
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # nothing else may write on the channel

    def say(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")

    try:
        say(result=reconstruct(job, say))
    except Exception as fault:  # the log, where Python will write it, may lie on the disk that is full
        say(fault=f"{type(fault).__name__}: {fault}".splitlines()[0])
        raise


def reconstruct(job: Job, say: Say) -> dict[str, Any]:
    """Run structure-from-motion and write the best sub-model to ``sparse/``; nothing if none came out that is usable.

    Returns the ``database`` that was used in the end, the files in each sub-model, best first (``models``), the
    ``attempts`` that were made or passed over, and of the best model: the ``conflict`` with another one, ``points``,
    mean ``reprojection_px``, ``camera_model``, the comparison of ``camera_models``, by file ``observations``,
    ``uncertainty_px`` and, where a camera cannot be used, why (``left_out``), and for every photo without a place how
    many of its features are points of it and how many of them agree (``supports``).
    """
    work = Work(job, say)
    work.clock.keep_always()
    _try_all(work)
    tried = work.journal.account()
    best = work.usable()
    if best is None:
        poor = work.journal.best()
        models, points = (poor.groups, poor.points) if poor else ([], 0)
        return {"database": str(work.latest()), "models": models, "points": points, "attempts": tried}
    say(phase="refining")
    database = work.latest()
    best_model = load_native(
        work.journal.model(best.name)
    )  # from disk also where it is at hand: then resuming is no other
    known = job.camera_params is not None
    finished = finish(best_model, database, job.seed, job.camera_model, known, work.thinned)
    for note in finished.notes:
        say(note=note)
    model = finished.model
    checked, left_out = _last_check(model, database, work)
    checked["doubtful"] = sorted({*checked["doubtful"], *best.excluded, *left_out} - {*_files(model)})
    if work.thinned:  # points that mapping did not have are black until then
        model.extract_colors_for_all_images(work.images)
    left_out = best.excluded | finished.left_out | left_out
    registered = [model.image(i) for i in sorted(model.reg_image_ids())]
    sparse = Path(job.folder, "sparse")
    write_native(sparse, model)
    return {
        "database": str(database),
        "attempts": tried,
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
        "second_opinion": best.second_opinion,
    }


def _last_check(model: Any, database: Path, work: Work) -> tuple[dict[str, Any], dict[str, str]]:
    """What the check says of the finished model, for registration.json, and by name why photos that fail leave it."""
    checked = check_model(model, database, work.job.seed)
    failed, left_out = checked.failed(), {}
    if 0 < 2 * len(failed) < len(checked.ids):
        left_out = reasons(model, checked)
        deregister(model, failed)
        checked = check_model(model, database, work.job.seed)
    return facts(model, checked, row_of(database, work)), left_out


def _try_all(work: Work) -> None:
    """Make the attempts that are left while photos have no place, and say which were passed over, and why."""
    journal, unsaid = work.journal, {}
    for attempt in journal.left():
        journal.passed.pop(attempt.name, None)  # of an interrupted run that had less time
        if attempt not in ATTEMPTS[: work.job.attempts] or not (missing := work.missing()):
            continue
        if attempt.matches == "row" and not _folded(work):
            continue
        if attempt.name == ATTEMPTS[0].name:
            _make(attempt, missing, work)
        elif why := _no_use(attempt, missing, work):
            journal.passed[attempt.name] = why
            unsaid.setdefault(why, []).append(attempt.words)
        elif why := _no_way(attempt, missing, work):
            journal.passed[attempt.name] = why
        else:
            have = "has" if len(missing) == 1 else "have"
            work.say(note=f"{len(missing)} of {len(work.photos)} photos {have} no place yet: {attempt.words}")
            _make(attempt, missing, work)
    for why, words in unsaid.items():
        work.say(note=f"passed over, for {why}: {'; '.join(words)}")


def _no_use(attempt: Attempt, missing: list[int], work: Work) -> str | None:
    """Why the attempt cannot help, None if it can."""
    groups = best.groups if (best := work.usable()) else [[]]
    linked, flat = links(work.latest(), set(groups[0]))
    alone = {work.files[number] for number in missing}.difference(*groups)
    count, lens_is_given = len(work.photos), work.job.camera_model is not None
    flat &= len(missing) == count
    now = Situation(len(missing), len(alone), count, linked, flat, lens_is_given, _folded(work))
    return reason_against(attempt, now)


def _folded(work: Work) -> bool:
    """Whether the row of photos fell apart in the model of an attempt."""
    return any(tried.folded for tried in work.journal.tried)


def _no_way(attempt: Attempt, missing: list[int], work: Work) -> str | None:
    """Why the attempt might help and is not made all the same, said; None if it is."""
    if became := work.journal.abandoned.get(attempt.name):
        work.say(note=f"left out, for it {became} last time: {attempt.words}")
        return f"it {became}"
    tried, (left, limit), chosen_pairs = work.journal.tried, work.left(), work.job.matcher != "exhaustive"
    expected = expected_seconds(attempt, tried, len(missing) / len(work.photos), chosen_pairs)
    if not time_against(expected, tried, left):
        return None
    rest = f"of {limit} {rough_duration(max(0.0, left))} are left"
    times = f"about {rough_duration(expected)} and the last adjustment, {rest}"
    work.say(note=f"left out, for it would take {times}: {attempt.words}")
    return f"{NO_TIME} {limit}"


def _make(attempt: Attempt, missing: list[int], work: Work) -> None:
    """Make an attempt and note what came of it."""
    work.say(attempt=attempt.name)
    work.attempt, work.seconds = attempt.name, {}
    database, match_graph = matched(attempt, missing, work)
    models, standing, opinion = mapped(attempt, database, work)
    tried = Tried(attempt.name, database.name, seconds=work.seconds, match_graph=match_graph)
    if models:
        folder = work.journal.model(attempt.name)
        write_native(folder, models[0])
        make_durable(folder)
        tried = replace(
            tried,
            groups=[_files(model) for model in models],
            points=models[0].num_points3D(),
            reprojection_px=models[0].compute_mean_reprojection_error(),
            conflict=find_conflict(models),
            excluded=standing.excluded,
            folded=standing.folded,
            second_opinion=opinion,
        )
    work.journal.add(tried)


def _files(model: Any) -> list[str]:
    return sorted(model.image(i).name for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
