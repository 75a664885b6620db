from math import log2
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.tradeoff_arms import Arm
from stages.tradeoff_front import WORTH_DB, Point, knee, pareto_front, points_of, pooled_deviation, recommend


def point(seconds: float, psnr: float, **others: Any) -> Point:
    """A made-up result."""
    usual: dict[str, Any] = {"variant": "grid", "downscale": 2.0, "seeds": 1, "deviation": None, "ssim": 0.9}
    usual |= {"frame_seconds": 1.0, "peak_memory_mb": 500, "model_mb": 10.0, "steps": round(10 * seconds)}
    return Point(psnr=psnr, train_seconds=seconds, **(usual | others))


def ladder(gains: list[float], **others: Any) -> list[Point]:
    """Doublings of the time from 10 s and 20 dB on, each worth so many dB."""
    scores = [20.0]
    for gain in gains:
        scores.append(scores[-1] + gain)
    return [point(10 * 2**i, score, **others) for i, score in enumerate(scores)]


places = st.lists(st.tuples(st.floats(0.1, 1e4), st.floats(5, 40)), min_size=1, max_size=30)


@given(places)
def test_nothing_on_the_front_is_beaten_and_all_else_is(found: list[tuple[float, float]]) -> None:
    points = [point(*place) for place in found]
    front = pareto_front(points)
    assert front == sorted(front, key=lambda p: p.train_seconds)
    for p in points:
        beaten = any(
            o.train_seconds <= p.train_seconds
            and o.psnr >= p.psnr
            and (o.train_seconds, o.psnr) != (p.train_seconds, p.psnr)
            for o in points
        )
        assert (p in front) != beaten


@given(places, st.floats(0, 1))
def test_what_is_recommended_is_on_the_front_and_nothing_later_pays(
    found: list[tuple[float, float]], deviation: float
) -> None:
    front = pareto_front([point(*place) for place in found])
    index = knee(front, deviation)
    chosen = front[index]
    for later in front[index + 1 :]:
        gain = later.psnr - chosen.psnr - deviation * 2**0.5
        assert gain <= WORTH_DB * log2(later.train_seconds / chosen.train_seconds) + 1e-9


def test_the_cheapest_point_after_which_no_doubling_pays() -> None:
    front = ladder([3.0, 2.0, 0.9, 0.4, 0.2])
    assert knee(front, 0.0) == 3
    assert knee(front, 1.0) == 2, "0.9 dB of which 1.4 may be chance is no gain"


def test_a_flat_stretch_before_a_gain_does_not_end_the_search() -> None:
    """A later point may pay for the doublings before it."""
    assert knee(ladder([2.0, 0.1, 2.0, 0.1]), 0.0) == 3


def test_nothing_can_be_recommended_of_nothing() -> None:
    with pytest.raises(ValueError, match="at least one"):
        knee([], 0.0)


def test_the_words_follow_the_scene() -> None:
    """Two made-up scenes: one is done early, the other is not done at all."""
    early = [*ladder([3.0, 0.2, 0.1]), point(80, 23.9, downscale=1.0)]
    said = recommend(early)
    assert said.point.train_seconds == 20 and not said.still_rising
    assert said.words == (
        "For this scene: 20 s of training, grid, half resolution: 23.0 dB (one seed each: the spread is unknown). "
        "Full resolution gains 0.9 dB for 4.0 × the time. With 50% of the time (grid, half resolution) "
        "it is 3.0 dB less."
    )
    late = recommend(ladder([1.0, 1.0, 1.0, 1.0]))
    assert late.point.train_seconds == 160 and late.still_rising
    assert "every doubling of the time paid: no training here was longer than 2 min 40 s" in late.words


def test_a_gain_within_the_spread_is_called_that() -> None:
    points = [point(10, 20, seeds=2, deviation=0.5), point(20, 25, seeds=2, deviation=0.5)]
    points.append(point(40, 25.3, seeds=2, deviation=0.5))
    said = recommend(points).words
    assert "25.0 ± 0.4 dB" in said
    assert "Training longer gains 0.3 dB for 2.0 × the time, which is within the spread." in said
    assert "within the spread" not in recommend([*points[:2], point(40, 25.9)]).words


def test_seeds_of_a_setting_make_one_point() -> None:
    figures = {"failed": None, "ssim": 0.8, "frame_seconds": 1.0, "peak_memory_mb": 5, "model_mb": 1.0}
    trials = [
        (Arm("grid", 2.0, 100, seed, 0.0), {**figures, "psnr": 20.0 + seed, "train_seconds": 10.0 + seed})
        for seed in range(3)
    ]
    trials += [(Arm("grid", 4.0, 100, 0, 0.0), {**figures, "psnr": 18.0, "train_seconds": 4.0, "ssim": None})]
    trials += [(Arm("small grid", 4.0, 100, 0, 0.0), {"failed": "it diverged"})]
    alone, three = points_of(trials)
    assert (three.psnr, three.deviation, three.seeds, three.train_seconds) == (21.0, 1.0, 3, 11.0)
    assert (alone.psnr, alone.deviation, alone.seeds, alone.ssim) == (18.0, None, 1, None)
    assert pooled_deviation([alone, three]) == 1.0 and pooled_deviation([alone]) is None


def test_the_pooled_spread_weighs_points_by_their_seeds() -> None:
    points = [point(1, 20, seeds=2, deviation=1.0), point(2, 20, seeds=4, deviation=0.5)]
    assert pooled_deviation(points) == pytest.approx(((1 * 1 + 3 * 0.25) / 4) ** 0.5)
