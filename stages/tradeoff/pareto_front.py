"""What a study found: its points over seeds, those that nothing beats, and the one to recommend.

A point is beaten where another takes no longer and is better. **The rule of the recommendation**: the cheapest point
that nothing beats after which no doubling of the training time buys more than ``WORTH_DB`` beyond the spread over
seeds. So whatever is still worth its time is worth it from there on to any later point, not to the next one only.
Front and recommendation are of what the study trained: the workspace's own field, mostly trained for longer than a
study has time for, would else be the answer for every scene. It is placed beside them.

**The rule of the spread**: a setting's is pooled over the settings nearest to it in training time, of the same kind of
field, as many as give ``LEAST_FREEDOM`` degrees of freedom, but, where nearer ones tell something, none that took more
than ``ALIKE`` times as long or as short. One from two seeds alone is hardly known: of n degrees of freedom a standard
deviation is uncertain by 1 / √(2n) of itself. But only alike ones may be pooled: after a hundred steps seeds differ by
2 dB, after a thousand by 0.05 (fox, docs/results.md).
"""

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import mean, stdev
from typing import Any, Literal

from stages.effects.decisions import Space
from stages.io.amounts import duration
from stages.tradeoff.runs import OWN, Arm, field_of, options_of, resolution_words

WORTH_DB = 0.5  # a doubling of the time that buys less is not worth it; 0.5 dB is what one sees side by side
LEAST_FREEDOM = 3
ALIKE = 5.0  # times the seconds of a training: three rungs of the ladder
MUCH_LONGER = 1.2  # times the seconds of a training: those of about its time tell nothing of more time


@dataclass(frozen=True)
class Point:
    """One setting: means over its ``seeds`` trainings; ``deviation`` is the standard deviation of PSNR over them, None
    for one, ``ssim_deviation`` that of SSIM; ``spread`` that of one such training's PSNR, from settings like it, too;
    None where no setting has several seeds. ``peak_memory_mb`` is the most of any, None of what was not trained
    here."""

    variant: str
    field: Literal["grid", "paper"]
    downscale: float
    steps: int
    seeds: int
    psnr: float
    deviation: float | None
    ssim: float | None
    ssim_deviation: float | None
    train_seconds: float
    frame_seconds: float
    peak_memory_mb: float | None
    model_mb: float
    spread: float | None = None

    @property
    def label(self) -> str:
        """``grid, half resolution``."""
        return f"{self.variant}, {resolution_words(self.downscale)}"


@dataclass(frozen=True)
class Recommendation:
    """A point, and why in words, which begin with the ``headline``; ``still_rising`` where the longest trainings were
    still worth their time: the point is the best of several on the front, and none of its kind was trained for
    ``MUCH_LONGER`` times its seconds."""

    point: Point
    headline: str
    words: str
    still_rising: bool


def points_of(arms: Sequence[tuple[Arm, Mapping[str, Any]]], own: Point | None = None) -> list[Point]:
    """One point for all seeds of a setting, and that of the workspace's ``own`` field, by training time. Arms that
    failed make none."""
    groups: dict[tuple[str, float, int], list[Mapping[str, Any]]] = {}
    for arm, figures in arms:
        if figures["failed"] is None:
            groups.setdefault((arm.variant, arm.downscale, arm.steps), []).append(figures)
    points = [_point(*setting, group) for setting, group in groups.items()] + ([] if own is None else [own])
    points = [replace(point, spread=spread_at(point, points)) for point in points]
    return sorted(points, key=lambda point: point.train_seconds)


def _point(variant: str, downscale: float, steps: int, group: Sequence[Mapping[str, Any]]) -> Point:
    scores = [figures["psnr"] for figures in group]
    similarities = [figures["ssim"] for figures in group if figures["ssim"] is not None]
    return Point(
        variant=variant,
        field=field_of(variant),
        downscale=downscale,
        steps=steps,
        seeds=len(group),
        psnr=mean(scores),
        deviation=stdev(scores) if len(scores) > 1 else None,
        ssim=mean(similarities) if similarities else None,
        ssim_deviation=stdev(similarities) if len(similarities) > 1 else None,
        train_seconds=mean(figures["train_seconds"] for figures in group),
        frame_seconds=mean(figures["frame_seconds"] for figures in group),
        peak_memory_mb=max(figures["peak_memory_mb"] for figures in group),
        model_mb=group[0]["model_mb"],
    )


def spread_at(point: Point, points: Sequence[Point]) -> float | None:
    """Standard deviation over seeds of the PSNR of one training at ``point``, by the rule of this module; from other
    kinds of fields where its own has no setting with several seeds, None where none has."""
    several = [other for other in points if other.deviation is not None]
    alike = [other for other in several if other.field == point.field] or several
    squares, freedom = 0.0, 0

    def distance(other: Point) -> float:
        return abs(math.log(other.train_seconds / point.train_seconds))

    for other in sorted(alike, key=distance):
        if freedom == 0 or (freedom < LEAST_FREEDOM and distance(other) <= math.log(ALIKE)):
            squares += (other.seeds - 1) * (other.deviation or 0.0) ** 2
            freedom += other.seeds - 1
    return math.sqrt(squares / freedom) if freedom else None


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """The points that no other beats in training time and PSNR, the fastest first."""
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point.train_seconds, -point.psnr)):
        if not front or point.psnr > front[-1].psnr:
            front.append(point)
    return front


def knee(front: Sequence[Point]) -> int:
    """The index of the point to recommend, by the rule of this module; the last one where every doubling pays.

    Raises ValueError for no points.
    """
    for index, point in enumerate(front):
        if all(_gain(point, later) - _noise(point, later) <= _worth(point, later) for later in front[index + 1 :]):
            return index
    raise ValueError("a recommendation needs at least one point")


def _gain(point: Point, later: Point) -> float:
    return later.psnr - point.psnr


def _noise(*points: Point) -> float:
    """One standard error, in dB, of a point's mean or of the difference of two."""
    return math.sqrt(sum((point.spread or 0.0) ** 2 / point.seeds for point in points))


def _worth(point: Point, later: Point) -> float:
    """What ``later`` would have to gain for its time."""
    return WORTH_DB * math.log2(later.train_seconds / point.train_seconds)


def trained(points: Sequence[Point]) -> list[Point]:
    """Those that the study trained: all but the workspace's own field."""
    return [point for point in points if point.variant != OWN]


def recommend(points: Sequence[Point]) -> Recommendation:
    """The knee of the front and what stands around it, in words; the workspace's own field is placed beside it. Raises
    ValueError where the study trained nothing."""
    tried = trained(points)
    front = pareto_front(tried)
    point, best = front[knee(front)], front[-1]
    headline = f"For this scene: {duration(point.train_seconds)} of training, {point.label}: {_decibel(point)}."
    words, rising = headline, point is best and _still_rising(front, tried)
    words += f" {_ended(point, tried, rising) if point is best else _compared(point, best)}."
    cheaper = [other for other in front if other.train_seconds <= point.train_seconds / 2]
    if cheaper:
        lost, share = point.psnr - cheaper[-1].psnr, cheaper[-1].train_seconds / point.train_seconds
        words += f" With {share:.0%} of the time ({cheaper[-1].label}) it is {lost:.1f} dB less."
    for own in (other for other in points if other.variant == OWN):
        words += f" {_placed(own, point, front)}."
    return Recommendation(point, headline, words, rising)


def _longer(point: Point, tried: Sequence[Point]) -> bool:
    """Whether a field of its kind had clearly more time."""
    return any(p.train_seconds > MUCH_LONGER * point.train_seconds for p in tried if p.field == point.field)


def _still_rising(front: Sequence[Point], tried: Sequence[Point]) -> bool:
    """Whether the last point of the front may be there for want of time only."""
    return len(front) > 1 and not _longer(front[-1], tried)


def _ended(point: Point, tried: Sequence[Point], rising: bool) -> str:
    """Why nothing is recommended beyond ``point``, the best one."""
    if rising:
        longest = max(other.train_seconds for other in tried if other.field == point.field)
        return (
            "Nothing tried is better, and up to there every doubling of the time paid: no field of its kind was "
            f"trained for longer than {duration(longest)}, a larger --budget tries longer ones"
        )
    if len(tried) == 1:
        return "Only one setting was tried"
    return "Nothing tried is better" + (": longer trainings were no better" if _longer(point, tried) else "")


def _placed(own: Point, point: Point, front: Sequence[Point]) -> str:
    """What the workspace's field has more or less than the ``point`` recommended, or what beats it."""
    what = f"{OWN.capitalize()} ({duration(own.train_seconds)}, {own.psnr:.1f} dB)"
    better = next((p for p in front if p.train_seconds <= own.train_seconds and p.psnr >= own.psnr), None)
    if better is not None:
        near = ", which is within the spread" if _gain(own, better) <= _noise(own, better) else ""
        return f"{what} is beaten by {better.label}: {better.psnr:.1f} dB after {duration(better.train_seconds)}{near}"
    gain, times = _gain(point, own), f"for {own.train_seconds / point.train_seconds:.1f} × the time"
    near = ", which is within the spread" if abs(gain) <= _noise(point, own) else ""
    if gain < 0:
        return f"{what} is {-gain:.1f} dB below the one recommended {times}{near}"
    return f"{what} gains {gain:.1f} dB over the one recommended {times}{near}"


def command(point: Point, space: Space, workspace: str) -> str:
    """What trains the setting of ``point`` for as long in a workspace. Field and preset are given, for it may remember
    others, and the field's sizes, for those that would be chosen follow from a timing."""
    given = {"seconds": max(1, round(point.train_seconds)), "downscale": point.downscale, "preset": "standard"}
    flags = [_flag(name, value) for name, value in (given | options_of(point.variant, space)).items()]
    return " ".join(["pipeline train", quoted(workspace), *flags])


def quoted(name: str) -> str:
    """As a shell takes it; the bytes of a name that is not Unicode, which no text holds, as in ``$'caf\\xe9'``."""
    escaped = name.replace("\\", r"\\").replace("'", r"\'")
    text = os.fsencode(escaped).decode("utf-8", "backslashreplace")
    return shlex.quote(name) if text == escaped else f"$'{text}'"


def _flag(name: str, value: Any) -> str:
    if name == "view_dependence":  # an option of stage effects
        return f"--effect view_dependence={'on' if value else 'off'}"
    flag = name.replace("_", "-")
    if value is False:
        return f"--train.no-{flag}"
    return f"--train.{flag} {value if isinstance(value, str) else format(value, 'g')}"


def _decibel(point: Point) -> str:
    """With the spread of a mean over as many seeds."""
    if point.spread is None:
        return f"{point.psnr:.1f} dB (one seed each: the spread is unknown)"
    noise = _noise(point)
    return f"{point.psnr:.1f} ± {noise:.1f} dB" if noise >= 0.05 else f"{point.psnr:.2f} ± {noise:.2f} dB"


def _compared(point: Point, best: Point) -> str:
    """What the best point does better, and for how much more time."""
    if best.variant != point.variant:
        what = f"The best tried ({best.label})"
    elif best.downscale != point.downscale:
        what = resolution_words(best.downscale).capitalize()
    else:
        what = "Training longer"
    gain = f"gains {_gain(point, best):.1f} dB for {best.train_seconds / point.train_seconds:.1f} × the time"
    return f"{what} {gain}" + (", which is within the spread" if _gain(point, best) <= _noise(point, best) else "")


def table(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Rows for the report and the page, by training time: a point's figures, its ``number``, whether it is on the
    ``front`` of the study's own trainings, and whether it is the one of the front that is ``cheapest_drawn``."""
    front = pareto_front(trained(points))
    drawn = min(front, key=lambda point: point.frame_seconds)
    return [
        {**asdict(point), "number": number, "label": point.label}
        | {"front": point in front, "cheapest_drawn": point is drawn}
        for number, point in enumerate(points, 1)
    ]
