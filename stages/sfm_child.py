"""The child process of stage sfm: all of structure-from-motion, away from the program that the user talks to.

COLMAP is native code that may abort or hang; here that ends one process and nothing else. The parent writes one line
of JSON (a :class:`Job`) to stdin and keeps stdin open: its end means that the parent is gone, and so this process
goes too. Messages to the parent are lines of JSON on stdout; whatever COLMAP prints goes to stderr, the log.
"""

import json
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from stages import sfm_global
from stages.amounts import rough_duration
from stages.colmap.diagnosis import compare_models, find_conflict, links, supports
from stages.colmap.mapping import MAPPING_MODEL, incremental_options, map_globally, map_incrementally
from stages.colmap.matching import (
    LOOSE_RATIO,
    STRICT_RATIO,
    Search,
    copy_as_fisheye,
    copy_without_matches_of,
    extract_features,
    fill_database,
    hold_open,
    look_alike,
    match_pairs,
    matched_pairs,
    read_vocabulary,
    verified_matches,
)
from stages.colmap.models import load_native, write_native
from stages.colmap.refinement import finish
from stages.colmap.repair import Checked, check_model, deregister, facts, reasons, register_again
from stages.colmap.thinning import thin_matches
from stages.files import make_durable
from stages.masks import write_feature_masks
from stages.match_graph import (
    MIN_INLIERS,
    MIN_YIELD,
    ORDER_OVERLAP,
    ROUNDS,
    in_order,
    inlier_matrix,
    natural_order,
    next_pairs,
    order_tells,
)
from stages.pairing import (
    MAX_EXHAUSTIVE,
    Likeness,
    Pairs,
    exhaustive,
    expected_pairs,
    places_of,
    second_look,
    start_pairs,
    union,
)
from stages.photos import Photo
from stages.registration import FEWEST_POINTS, FEWEST_REGISTERED
from stages.retrieval import CELLS, Words
from stages.sfm import Matcher
from stages.sfm_attempts import (
    ATTEMPTS,
    GIVEN,
    GIVEN_UP,
    NO_TIME,
    Attempt,
    Effort,
    Journal,
    Situation,
    Tried,
    expected_seconds,
    reason_against,
    time_against,
)
from stages.sfm_clock import NAME as CLOCK
from stages.sfm_clock import Clock

Say = Callable[..., None]


@dataclass(frozen=True)
class Job:
    """What the parent asks for; ``photos`` are Photos as dicts in order of ``file``. ``folder`` gets ``sparse/``.

    ``camera_model`` None: SIMPLE_RADIAL for mapping, and in the end what held-out observations speak for.
    """

    folder: str
    images: str
    database: str
    photos: list[dict[str, Any]]
    seed: int
    max_image_size: int
    max_features: int
    camera_model: str | None
    camera_params: list[float] | None
    matcher: Matcher
    neighbours: int
    attempts: int
    seconds: float | None
    max_seconds: float


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


def end_with_parent() -> None:
    """End this process when stdin does: the parent is gone."""
    while os.read(0, 1):
        pass
    os._exit(1)


class _Work:
    """What the attempts share: the photos (numbered from 0, in order of ``file``), their pairs, the journal."""

    def __init__(self, job: Job, say: Say) -> None:
        self.job, self.say = job, say
        self.photos = [Photo(**photo) for photo in job.photos]
        self.files = [photo.image_name for photo in self.photos]
        self.database, self.images = Path(job.database), Path(job.images)
        self.journal = Journal(Path(job.folder, "attempts"))
        self.held = hold_open(self.database)  # the parent reads in it how far we are
        self.clock, self.started = Clock(self.journal.folder / CLOCK), time.monotonic()
        self.attempt = ATTEMPTS[0].name
        self.seconds: dict[str, float] = {}  # of this attempt's phases
        # Where pairs were chosen there are matches in plenty: mapping works on the best of them.
        self.thinned = len(self.photos) > MAX_EXHAUSTIVE

    def begin(self, phase: str, **more: Any) -> None:
        """Say that a phase begins. Of an interrupted run features and matches are kept, while mapping starts again."""
        if database := more.get("database"):
            self.held = hold_open(Path(database))
        self.clock.begin(f"{self.attempt}: {phase}", anew=phase == "mapping")
        self.say(phase=phase, **more)

    def end(self, phase: str) -> None:
        """Note what the phase took, in earlier runs too."""
        self.seconds[phase] = self.clock.end()

    def left(self) -> tuple[float, str]:
        """Seconds that further attempts may take, and which limit says so: the time it is given, which is for all runs
        together, or when it is given up, which is counted in each anew."""
        limits = {GIVEN: (self.job.seconds or math.inf) - self.clock.earlier, GIVEN_UP: self.job.max_seconds}
        limit = min(limits, key=limits.__getitem__)
        return self.started + limits[limit] - time.monotonic(), limit

    @cached_property
    def words(self) -> Words:
        """The vocabulary that features are matched by, of those that the first attempt found."""
        return read_vocabulary(self.database, len(self.photos), self.job.seed, CELLS)

    @cached_property
    def similarity(self) -> Likeness:
        """How much any two photos look alike."""
        return look_alike(self.database, len(self.photos), self.job.seed)

    def missing(self) -> list[int]:
        """The photos that have no place in the best model so far."""
        best = self.usable()
        placed = set(best.groups[0]) if best else set()
        return [number for number, file in enumerate(self.files) if file not in placed]

    def beside(self, name: str) -> Path:
        """Another database, beside the first."""
        return self.database.with_name(f"{self.database.stem}-{name}.db")

    def usable(self) -> Tried | None:
        """The best attempt, if its model is good enough to go on with."""
        best = self.journal.best()
        good = best and len(best.groups[0]) >= FEWEST_REGISTERED and best.points >= FEWEST_POINTS
        return best if good else None

    def latest(self) -> Path:
        """The database of the best attempt; as long as there is no model, the latest with the lens as it was."""
        plain = [tried for tried in self.journal.tried if tried.name != "fisheye"]
        return self.database.with_name((self.usable() or plain[-1]).database)


def reconstruct(job: Job, say: Say) -> dict[str, Any]:
    """Run structure-from-motion and write the best sub-model to ``sparse/``; nothing if none came out that is usable.

    Returns the ``database`` that was used in the end, the files in each sub-model, best first (``models``), the
    ``attempts`` that were made or passed over, and of the best model: the ``conflict`` with another one, ``points``,
    mean ``reprojection_px``, ``camera_model``, the comparison of ``camera_models``, by file ``observations``,
    ``uncertainty_px`` and, where a camera cannot be used, why (``left_out``), and for every photo without a place how
    many of its features are points of it and how many of them agree (``supports``).
    """
    work = _Work(job, say)
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
    mapped = load_native(work.journal.model(best.name))  # from disk also where it is at hand: then resuming is no other
    known = job.camera_params is not None
    finished = finish(mapped, database, job.seed, job.camera_model, known, work.thinned)
    for note in finished.notes:
        say(note=note)
    model = finished.model
    checked, left_out = _last_check(model, database, work)
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


def _last_check(model: Any, database: Path, work: _Work) -> tuple[dict[str, Any], dict[str, str]]:
    """What the check says of the finished model, for registration.json, and by name why photos that fail leave it."""
    checked = check_model(model, database, work.job.seed)
    failed, left_out = checked.failed(), {}
    if 0 < 2 * len(failed) < len(checked.ids):
        left_out = reasons(model, checked)
        deregister(model, failed)
        checked = check_model(model, database, work.job.seed)
    return facts(model, checked), left_out


def _try_all(work: _Work) -> None:
    """Make the attempts that are left while photos have no place, and say which were passed over, and why."""
    journal, unsaid = work.journal, {}
    for attempt in journal.left():
        journal.passed.pop(attempt.name, None)  # of an interrupted run that had less time
        if attempt not in ATTEMPTS[: work.job.attempts] or not (missing := work.missing()):
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


def _no_use(attempt: Attempt, missing: list[int], work: _Work) -> str | None:
    """Why the attempt cannot help, None if it can."""
    groups = best.groups if (best := work.usable()) else [[]]
    linked, flat = links(work.latest(), set(groups[0]))
    alone = {work.files[number] for number in missing}.difference(*groups)
    count, lens_is_given = len(work.photos), work.job.camera_model is not None
    now = Situation(len(missing), len(alone), count, linked, flat and len(missing) == count, lens_is_given)
    return reason_against(attempt, now)


def _no_way(attempt: Attempt, missing: list[int], work: _Work) -> str | None:
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


def _make(attempt: Attempt, missing: list[int], work: _Work) -> None:
    """Make an attempt and note what came of it."""
    work.say(attempt=attempt.name)
    work.attempt, work.seconds = attempt.name, {}
    database, match_graph = _matched(attempt, missing, work)
    models, excluded, opinion = _mapped(attempt, database, work)
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
            excluded=excluded,
            second_opinion=opinion,
        )
    work.journal.add(tried)


def _matched(attempt: Attempt, missing: list[int], work: _Work) -> tuple[Path, dict[str, Any] | None]:
    """The database with the matches that the attempt works on, and what is known of their graph where it was grown."""
    job, database, graph = work.job, work.database, None
    if attempt.matches == "same":
        best = work.usable()
        return work.latest(), best.match_graph if best else None
    if attempt.matches == "strict":
        _find_features(database, Search(job.max_image_size, job.max_features), work)
        graph = _match_all(database, work)
    elif attempt.matches == "loose":
        database = work.beside("loose")
        before = matched_pairs(work.latest())
        copy_without_matches_of({work.files[number] for number in missing}, work.latest(), database)
        _match(database, second_look(before, missing, job.neighbours, lambda: work.similarity), LOOSE_RATIO, work)
    elif attempt.matches == "fisheye":
        latest, database = work.latest(), work.beside("fisheye")
        copy_as_fisheye(latest, database, job.seed)
    else:
        database = work.beside("rich")
        twice = Search(2 * job.max_image_size, 2 * job.max_features, doubled_up_to=job.max_image_size)
        _find_features(database, twice, work)
        graph = _match_all(database, work)
    return database, graph


def _find_features(database: Path, search: Search, work: _Work) -> None:
    work.begin("features", database=str(database))
    fill_database(database, work.photos, work.job.camera_model or MAPPING_MODEL, work.job.camera_params)
    masks = Path(work.job.folder, "masks")
    if write_feature_masks(work.images.parent, work.photos, masks):
        search = search._replace(masks=masks)
    extract_features(database, work.images, work.photos, search)
    shutil.rmtree(masks, ignore_errors=True)
    work.end("features")


def _match_all(database: Path, work: _Work) -> dict[str, Any] | None:
    """Match every pair, or grow the match graph: round by round, where verification says that it pays.

    Returns how many pairs were tried and verified, and whether the order of names or times helped to choose them.
    """
    job, count, places = work.job, len(work.photos), places_of(work.photos)
    if job.matcher == "exhaustive":
        _match(database, exhaustive(count), STRICT_RATIO, work)
        return None
    names = [photo.name for photo in work.photos]
    order = natural_order(names) if places.time_s is None else np.argsort(places.time_s, kind="stable")
    pairs = union(
        start_pairs(job.matcher, job.neighbours, count, places, lambda: work.similarity), in_order(order, 1, 2)
    )

    def tried() -> np.ndarray:
        _match(database, pairs, STRICT_RATIO, work)
        return inlier_matrix(count, pairs, verified_matches(database, pairs))

    inliers = tried()
    if tells := order_tells(order, inliers):
        pairs = union(pairs, in_order(order, 3, ORDER_OVERLAP))
        inliers = tried()
    for _ in range(ROUNDS):
        more = next_pairs(inliers, work.similarity, job.neighbours)
        if not len(more):
            break
        pairs = union(pairs, more)
        inliers = tried()
        if (inliers[more[:, 0], more[:, 1]] >= MIN_INLIERS).mean() < MIN_YIELD:
            break
    verified = int((verified_matches(database, pairs) >= MIN_INLIERS).sum())
    helped = "photos next to each other by name or time are among them" if tells else "their order says nothing"
    work.say(note=f"{verified:,} of {len(pairs):,} tried pairs of photos verified; {helped}")
    return {"tried": len(pairs), "verified": verified, "order": tells}


def _match(database: Path, pairs: Pairs, max_ratio: float, work: _Work) -> None:
    def expect(left: int, seconds: float) -> None:
        if work.job.matcher == "exhaustive":
            work.say(note=f"matching {left:,} pairs of photos: about {rough_duration(seconds)}")

    expected = expected_pairs(work.job.matcher, len(work.photos), work.job.neighbours)
    work.begin("matching", database=str(database), pairs=max(len(pairs), expected))
    exact = work.job.matcher == "exhaustive" or max_ratio != STRICT_RATIO
    match_pairs(database, pairs, work.job.seed, max_ratio, expect, None if exact else work.words)
    work.end("matching")


def _mapped(attempt: Attempt, database: Path, work: _Work) -> tuple[list[Any], dict[str, str], dict[str, Any] | None]:
    """All sub-models that come of these matches, best first; of the best one only photos whose poses stand, by name why
    others were excluded, and how a second opinion compares."""
    work.begin("mapping", done=0)
    seed, lens_is_known = work.job.seed, work.job.camera_params is not None
    models, matches = Path(work.job.folder, "models"), database
    if work.thinned:
        matches = work.beside("thinned")
        thin_matches(database, matches)
    opinion = _second_opinion(attempt, database, work)
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
    compared, excluded = None, {}
    if found:
        other, compared = _compared(found[0], opinion)
        found[0], excluded = _standing(found[0], other, database, matches, options, work)
    work.end("mapping")
    return found, excluded, compared


def _second_opinion(attempt: Attempt, database: Path, work: _Work) -> "sfm_global.Started | None":
    """Global mapping begun beside the first attempt; None where it would say nothing."""
    if attempt.name != ATTEMPTS[0].name or len(work.photos) < sfm_global.MIN_PHOTOS:
        return None
    matches, known = work.beside("global"), work.job.camera_params is not None
    thin_matches(database, matches, sfm_global.TRACKS_PER_PHOTO)
    return sfm_global.start(matches, work.images, work.journal.folder / "global", work.job.seed, known)


def _compared(model: Any, opinion: "sfm_global.Started | None") -> tuple[Any, dict[str, Any] | None]:
    """The model of the second opinion, None without one, and how far both agree."""
    if opinion is None:
        return None, None
    if failure := sfm_global.failure(opinion):
        return None, {"failed": failure}
    other = load_native(opinion.folder)
    return other, compare_models(model, other) | {"failed": None}


def _standing(
    model: Any, other: Any, database: Path, matches: Path, options: Any, work: _Work
) -> tuple[Any, dict[str, str]]:
    """The model with only photos whose poses stand, and by name why others are excluded.

    Photos that fail are freed and registered again, in the model of the second opinion where more photos pass in it.
    """
    best = model, check_model(model, database, work.job.seed)
    if not (failed := best[1].failed()):
        return model, {}
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
    return model, why


def _passing(candidate: tuple[Any, Checked]) -> int:
    return int(candidate[1].check.passed.sum())


def _files(model: Any) -> list[str]:
    return sorted(model.image(i).name for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
