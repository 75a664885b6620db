"""What a study found: its points over seeds, those that nothing beats, and the one to recommend.

A point is beaten where another takes no longer and is better. **The rule of the recommendation**: the cheapest point
that nothing beats after which no doubling of the training time buys more than ``WORTH_DB`` beyond the spread over
seeds. So whatever is still worth its time is worth it from there on to any later point, not to the next one only.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import mean, stdev
from typing import Any

from stages.amounts import duration
from stages.tradeoff_arms import VARIANTS, Arm, resolution_words

WORTH_DB = 0.5  # a doubling of the time that buys less is not worth it; 0.5 dB is what one sees side by side


@dataclass(frozen=True)
class Point:
    """One setting: means over its ``seeds`` trainings; ``deviation`` is the standard deviation of PSNR over them, None
    for one. ``peak_memory_mb`` is the most of any."""

    variant: str
    downscale: float
    steps: int
    seeds: int
    psnr: float
    deviation: float | None
    ssim: float | None
    train_seconds: float
    frame_seconds: float
    peak_memory_mb: float
    model_mb: float

    @property
    def label(self) -> str:
        """``grid, half resolution``."""
        return f"{self.variant}, {resolution_words(self.downscale)}"

    @property
    def family(self) -> str:
        """Of variants that belong together."""
        return VARIANTS[self.variant].family


@dataclass(frozen=True)
class Recommendation:
    """A point, and why in words, which begin with the ``headline``; ``still_rising`` where the longest trainings were
    still worth their time."""

    point: Point
    headline: str
    words: str
    still_rising: bool


def points_of(arms: Sequence[tuple[Arm, Mapping[str, Any]]]) -> list[Point]:
    """One point for all seeds of a setting, by training time. Arms that failed make none."""
    groups: dict[tuple[str, float, int], list[Mapping[str, Any]]] = {}
    for arm, figures in arms:
        if figures["failed"] is None:
            groups.setdefault((arm.variant, arm.downscale, arm.steps), []).append(figures)
    points = [_point(*setting, group) for setting, group in groups.items()]
    return sorted(points, key=lambda point: point.train_seconds)


def _point(variant: str, downscale: float, steps: int, group: Sequence[Mapping[str, Any]]) -> Point:
    scores = [figures["psnr"] for figures in group]
    similarities = [figures["ssim"] for figures in group if figures["ssim"] is not None]
    return Point(
        variant=variant,
        downscale=downscale,
        steps=steps,
        seeds=len(group),
        psnr=mean(scores),
        deviation=stdev(scores) if len(scores) > 1 else None,
        ssim=mean(similarities) if similarities else None,
        train_seconds=mean(figures["train_seconds"] for figures in group),
        frame_seconds=mean(figures["frame_seconds"] for figures in group),
        peak_memory_mb=max(figures["peak_memory_mb"] for figures in group),
        model_mb=group[0]["model_mb"],
    )


def pooled_deviation(points: Sequence[Point]) -> float | None:
    """Standard deviation of one training's PSNR over seeds, from all points with several; None where none has."""
    several = [point for point in points if point.deviation is not None]
    if not several:
        return None
    freedom = sum(point.seeds - 1 for point in several)
    return math.sqrt(sum((point.seeds - 1) * (point.deviation or 0.0) ** 2 for point in several) / freedom)


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """The points that no other beats in training time and PSNR, the fastest first."""
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point.train_seconds, -point.psnr)):
        if not front or point.psnr > front[-1].psnr:
            front.append(point)
    return front


def knee(front: Sequence[Point], deviation: float) -> int:
    """The index of the point to recommend, by the rule of this module; the last one where every doubling pays.

    Raises ValueError for no points.
    """
    for index, point in enumerate(front):
        if all(_beyond_spread(point, later, deviation) <= _worth(point, later) for later in front[index + 1 :]):
            return index
    raise ValueError("a recommendation needs at least one point")


def _beyond_spread(point: Point, later: Point, deviation: float) -> float:
    """What ``later`` gains in dB, less one standard error of the difference."""
    return later.psnr - point.psnr - deviation * math.sqrt(1 / point.seeds + 1 / later.seeds)


def _worth(point: Point, later: Point) -> float:
    """What ``later`` would have to gain for its time."""
    return WORTH_DB * math.log2(later.train_seconds / point.train_seconds)


def recommend(points: Sequence[Point]) -> Recommendation:
    """The knee of the front and what stands around it, in words. Raises ValueError for no points."""
    front, deviation = pareto_front(points), pooled_deviation(points)
    index = knee(front, deviation or 0.0)
    point, best = front[index], front[-1]
    headline = (
        f"For this scene: {duration(point.train_seconds)} of training, {point.label}: {_decibel(point, deviation)}."
    )
    words = headline
    if point is best:
        words += f" Nothing tried is better, and up to there every doubling of the time paid: {_more(points)}."
    else:
        words += f" {_compared(point, best, deviation)}."
    cheaper = [other for other in front if other.train_seconds <= point.train_seconds / 2]
    if cheaper:
        lost, share = point.psnr - cheaper[-1].psnr, cheaper[-1].train_seconds / point.train_seconds
        words += f" With {share:.0%} of the time ({cheaper[-1].label}) it is {lost:.1f} dB less."
    return Recommendation(point, headline, words, point is best)


def _decibel(point: Point, deviation: float | None) -> str:
    """With the spread of a mean over as many seeds."""
    if deviation is None:
        return f"{point.psnr:.1f} dB (one seed each: the spread is unknown)"
    return f"{point.psnr:.1f} ± {deviation / math.sqrt(point.seeds):.1f} dB"


def _compared(point: Point, best: Point, deviation: float | None) -> str:
    """What the best point does better, and for how much more time."""
    if best.variant != point.variant:
        what = f"The best tried ({best.label})"
    elif best.downscale != point.downscale:
        what = resolution_words(best.downscale).capitalize()
    else:
        what = "Training longer"
    gain = f"gains {best.psnr - point.psnr:.1f} dB for {best.train_seconds / point.train_seconds:.1f} × the time"
    noise = (deviation or 0.0) * math.sqrt(1 / point.seeds + 1 / best.seeds)
    return f"{what} {gain}" + (", which is within the spread" if best.psnr - point.psnr <= noise else "")


def _more(points: Sequence[Point]) -> str:
    longest = max(point.train_seconds for point in points)
    return f"no training here was longer than {duration(longest)}, a larger --budget tries longer ones"


def table(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Rows for the report and the page, by training time: a point's figures, its ``number``, whether it is on the
    ``front``."""
    front = pareto_front(points)
    return [
        {**asdict(point), "number": number, "label": point.label, "front": point in front}
        for number, point in enumerate(points, 1)
    ]
