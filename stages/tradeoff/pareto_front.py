"""What a study found: points over seeds, their Pareto front, and the setting to recommend.

A point is on the Pareto front where no other takes at most as long and is at least as good. **The recommendation** is
the cheapest point of the front after which no doubling of the training time buys more than ``MIN_GAIN_DB`` beyond the
spread over seeds, to any later point. So a gain further on still counts after a flat stretch. Front and recommendation
are of what the study trained: the workspace's field, mostly trained for longer than a study has time for, would
otherwise be the answer for every scene. It is placed beside them.

**The spread** of a setting is pooled over the settings nearest to it in training time, of the same kind of field: as
many as give ``MIN_DEGREES_OF_FREEDOM`` degrees of freedom, but, where nearer ones tell something, none that took more
than ``MAX_TIME_RATIO`` times as long or as short. That of two seeds alone is hardly known: with n degrees of freedom a
standard deviation is uncertain by 1 / √(2n) of itself. But only similar settings may be pooled: after a hundred steps
seeds differ by 2 dB, after a thousand by 0.05 (fox).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import mean, stdev
from typing import Any

from stages.io.amounts import duration, resolution_name
from stages.tradeoff.schedule import WORKSPACE_FIELD, Run, family_of, field_name
from stages.train.config import FieldName

MIN_GAIN_DB = 0.5  # a doubling of the time that buys less is not worth it; 0.5 dB is what one sees side by side
MIN_DEGREES_OF_FREEDOM = 3
MAX_TIME_RATIO = 5.0  # times the seconds of a training: three budget levels
LONGER_RATIO = 1.2  # times the seconds of a training: those of about its time tell nothing of more time


@dataclass(frozen=True)
class Point:
    """One setting: means over its ``seeds`` trainings; ``psnr_std`` is the standard deviation of PSNR over them, None
    for one, ``ssim_std`` that of SSIM; ``spread`` that of one such training's PSNR, from settings like it, too;
    None where no setting has several seeds. ``peak_memory_mb`` is the most of any, None for the workspace's."""

    variant: str
    field: FieldName
    downscale: float
    steps: int
    seeds: int
    psnr: float
    psnr_std: float | None
    ssim: float | None
    ssim_std: float | None
    train_seconds: float
    frame_seconds: float
    peak_memory_mb: float | None
    model_mb: float
    spread: float | None = None

    @property
    def label(self) -> str:
        """``grid, half resolution``."""
        return f"{self.variant}, {resolution_name(self.downscale)}"


@dataclass(frozen=True)
class Recommendation:
    """A point, and why in words, which begin with the ``headline``; ``still_rising`` where the longest trainings were
    still worth their time: the point is the best of several on the front, and none of its kind was trained for
    ``LONGER_RATIO`` times its seconds."""

    point: Point
    headline: str
    words: str
    still_rising: bool


def points_of(results: Sequence[tuple[Run, Mapping[str, Any]]], existing: Point | None = None) -> list[Point]:
    """One point for all seeds of a setting, and that of the workspace's ``existing`` field, by training time. Failed
    runs make none."""
    groups: dict[tuple[str, float, int], list[Mapping[str, Any]]] = {}
    for run, figures in results:
        if figures["failed"] is None:
            groups.setdefault((run.variant, run.downscale, run.steps), []).append(figures)
    points = [_point(*setting, group) for setting, group in groups.items()] + ([existing] if existing else [])
    points = [replace(point, spread=pooled_spread(point, points)) for point in points]
    return sorted(points, key=lambda point: point.train_seconds)


def workspace_point(facts: Mapping[str, Any], figures: Mapping[str, Any]) -> Point:
    """The point of the workspace's field, from the facts of its training and the figures of its score."""
    taken = {name: facts[name] for name in ("downscale", "steps", "train_seconds", "field")}
    missing: dict[str, Any] = {"psnr_std": None, "ssim_std": None, "peak_memory_mb": None}
    return Point(variant=WORKSPACE_FIELD, seeds=1, **missing, **taken, **figures)


def _point(variant: str, downscale: float, steps: int, group: Sequence[Mapping[str, Any]]) -> Point:
    scores = [figures["psnr"] for figures in group]
    similarities = [figures["ssim"] for figures in group if figures["ssim"] is not None]
    return Point(
        variant=variant,
        field=field_name(variant),
        downscale=downscale,
        steps=steps,
        seeds=len(group),
        psnr=mean(scores),
        psnr_std=stdev(scores) if len(scores) > 1 else None,
        ssim=mean(similarities) if similarities else None,
        ssim_std=stdev(similarities) if len(similarities) > 1 else None,
        train_seconds=mean(figures["train_seconds"] for figures in group),
        frame_seconds=mean(figures["frame_seconds"] for figures in group),
        peak_memory_mb=max(figures["peak_memory_mb"] for figures in group),
        model_mb=group[0]["model_mb"],
    )


def pooled_spread(point: Point, points: Sequence[Point]) -> float | None:
    """Standard deviation over seeds of the PSNR of one training at ``point``, by the rule of this module; from other
    kinds of fields where its own has no setting with several seeds, None where none has."""
    several = [other for other in points if other.psnr_std is not None]
    similar = [other for other in several if other.field == point.field] or several
    squares, freedom = 0.0, 0

    def distance(other: Point) -> float:
        return abs(math.log(other.train_seconds / point.train_seconds))

    for other in sorted(similar, key=distance):
        if freedom == 0 or (freedom < MIN_DEGREES_OF_FREEDOM and distance(other) <= math.log(MAX_TIME_RATIO)):
            squares += (other.seeds - 1) * (other.psnr_std or 0.0) ** 2
            freedom += other.seeds - 1
    return math.sqrt(squares / freedom) if freedom else None


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """The points that no other dominates in training time and PSNR, the fastest first."""
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point.train_seconds, -point.psnr)):
        if not front or point.psnr > front[-1].psnr:
            front.append(point)
    return front


def recommended_index(front: Sequence[Point]) -> int:
    """The index of the point to recommend, by the rule of this module; the last one where every doubling pays.

    Raises ValueError for no points.
    """
    for index, point in enumerate(front):
        if not any(_pays(point, later) for later in front[index + 1 :]):
            return index
    raise ValueError("a recommendation needs at least one point")


def _gain(point: Point, later: Point) -> float:
    return later.psnr - point.psnr


def _standard_error(*points: Point) -> float:
    """One standard error, in dB, of a point's mean or of the difference of two."""
    return math.sqrt(sum((point.spread or 0.0) ** 2 / point.seeds for point in points))


def _pays(point: Point, later: Point) -> bool:
    """Whether ``later`` gains enough for its time."""
    required = MIN_GAIN_DB * math.log2(later.train_seconds / point.train_seconds)
    return _gain(point, later) - _standard_error(point, later) > required


def trained_here(points: Sequence[Point]) -> list[Point]:
    """Those that the study trained: all but the workspace's field."""
    return [point for point in points if point.variant != WORKSPACE_FIELD]


def recommend(points: Sequence[Point]) -> Recommendation:
    """The point of the front to recommend and its neighbours, in words; the workspace's field is compared with it.
    Raises ValueError where the study trained nothing."""
    tried = trained_here(points)
    front = pareto_front(tried)
    point, best = front[recommended_index(front)], front[-1]
    headline = f"For this scene: {duration(point.train_seconds)} of training, {point.label}: {_decibel(point)}."
    words, rising = headline, point is best and _still_rising(front, tried)
    words += f" {_best_sentence(point, tried, rising) if point is best else _comparison(point, best)}."
    cheaper = [other for other in front if other.train_seconds <= point.train_seconds / 2]
    if cheaper:
        lost, share = point.psnr - cheaper[-1].psnr, cheaper[-1].train_seconds / point.train_seconds
        words += f" With {share:.0%} of the time ({cheaper[-1].label}) it is {lost:.1f} dB less."
    for existing in (other for other in points if other.variant == WORKSPACE_FIELD):
        words += f" {_workspace_sentence(existing, point, front)}."
    return Recommendation(point, headline, words, rising)


def _longer(point: Point, tried: Sequence[Point]) -> bool:
    """Whether a field of its kind had clearly more time."""
    return any(p.train_seconds > LONGER_RATIO * point.train_seconds for p in tried if p.field == point.field)


def _still_rising(front: Sequence[Point], tried: Sequence[Point]) -> bool:
    """Whether the last point of the front may be there for want of time only."""
    return len(front) > 1 and not _longer(front[-1], tried)


def _best_sentence(point: Point, tried: Sequence[Point], rising: bool) -> str:
    """Why nothing is recommended beyond ``point``, the best one."""
    if rising:
        longest = max(other.train_seconds for other in tried if other.field == point.field)
        return (
            "No setting tried is better, and every doubling of the training time paid off. The longest training of "
            f"this field took {duration(longest)}; a larger --budget tries longer ones"
        )
    if len(tried) == 1:
        return "Only one setting was tried"
    return "No setting tried is better" + (": longer trainings were no better" if _longer(point, tried) else "")


def _workspace_sentence(existing: Point, point: Point, front: Sequence[Point]) -> str:
    """What the workspace's field has more or less than the ``point`` recommended, or what is better."""
    what = f"{WORKSPACE_FIELD.capitalize()} ({duration(existing.train_seconds)}, {existing.psnr:.1f} dB)"
    for better in front:
        if better.train_seconds <= existing.train_seconds and better.psnr >= existing.psnr:
            near = _within_spread(_gain(existing, better), existing, better)
            after = f"{better.psnr:.1f} dB after {duration(better.train_seconds)}"
            return f"{what} is beaten by {better.label}: {after}{near}"
    gain, times = _gain(point, existing), f"for {existing.train_seconds / point.train_seconds:.1f} × the time"
    near = _within_spread(abs(gain), point, existing)
    if gain < 0:
        return f"{what} is {-gain:.1f} dB below the one recommended {times}{near}"
    return f"{what} gains {gain:.1f} dB over the one recommended {times}{near}"


def _within_spread(gain: float, *points: Point) -> str:
    return ", which is within the spread" if gain <= _standard_error(*points) else ""


def _decibel(point: Point) -> str:
    """With the spread of a mean over as many seeds."""
    if point.spread is None:
        return f"{point.psnr:.1f} dB (one seed each: the spread is unknown)"
    noise = _standard_error(point)
    return f"{point.psnr:.1f} ± {noise:.1f} dB" if noise >= 0.05 else f"{point.psnr:.2f} ± {noise:.2f} dB"


def _comparison(point: Point, best: Point) -> str:
    """What the best point does better, and for how much more time."""
    if best.variant != point.variant:
        what = f"The best tried ({best.label})"
    elif best.downscale != point.downscale:
        what = resolution_name(best.downscale).capitalize()
    else:
        what = "Training longer"
    gain = f"gains {_gain(point, best):.1f} dB for {best.train_seconds / point.train_seconds:.1f} × the time"
    return f"{what} {gain}{_within_spread(_gain(point, best), point, best)}"


def table(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Rows for the plot and the tables, by training time: a point's figures, its ``number`` and ``family``, whether it
    is on the ``pareto_front`` of what the study trained, and whether it is the ``fastest_to_render`` of that."""
    front = pareto_front(trained_here(points))
    fastest = min(front, key=lambda point: point.frame_seconds)
    return [
        {**asdict(point), "number": number, "label": point.label, "family": family_of(point.variant)}
        | {"pareto_front": point in front, "fastest_to_render": point is fastest}
        for number, point in enumerate(points, 1)
    ]
