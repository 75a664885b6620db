import shlex
from dataclasses import replace
from math import log2
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cli.arguments import StageArguments, parse, with_flags
from pipeline.cli.options import with_effects
from pipeline.engine.settings import Settings
from stages.effects.decisions import Space
from stages.tradeoff.pareto_front import (
    MIN_GAIN_DB,
    Point,
    pareto_front,
    points_of,
    pooled_spread,
    recommend,
    recommended_index,
    table,
)
from stages.tradeoff.schedule import PUBLISHED, REDUCED, VARIANTS, WORKSPACE_FIELD, Run, field_name, train_command
from stages.train import Config


def point(seconds: float, psnr: float, **others: Any) -> Point:
    """A made-up result."""
    usual: dict[str, Any] = {"variant": "grid", "downscale": 2.0, "seeds": 1, "psnr_std": None, "ssim": 0.9}
    usual |= {"frame_seconds": 1.0, "peak_memory_mb": 500, "model_mb": 10.0, "steps": round(10 * seconds)}
    variant = others.get("variant", "grid")
    usual |= {"ssim_std": None, "field": "grid" if variant == WORKSPACE_FIELD else field_name(variant)}
    return Point(psnr=psnr, train_seconds=seconds, **(usual | others))


def doublings(gains: list[float], **others: Any) -> list[Point]:
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
def test_the_recommended_run_is_on_the_front(found: list[tuple[float, float]], spread: float) -> None:
    front = pareto_front([point(*place, spread=spread) for place in found])
    index = recommended_index(front)
    chosen = front[index]
    for later in front[index + 1 :]:
        gain = later.psnr - chosen.psnr - spread * 2**0.5
        assert gain <= MIN_GAIN_DB * log2(later.train_seconds / chosen.train_seconds) + 1e-9


def test_the_cheapest_point_after_which_no_doubling_pays() -> None:
    gains = [3.0, 2.0, 0.9, 0.4, 0.2]
    assert recommended_index(doublings(gains)) == 3
    assert recommended_index(doublings(gains, spread=1.0)) == 2, "0.9 dB of which 1.4 may be chance is no gain"


def test_a_flat_stretch_does_not_end_the_search() -> None:
    """A later point may pay for the doublings before it."""
    assert recommended_index(doublings([2.0, 0.1, 2.0, 0.1])) == 3


def test_nothing_can_be_recommended_of_nothing() -> None:
    with pytest.raises(ValueError, match="at least one"):
        recommended_index([])


def test_the_words_follow_the_scene() -> None:
    """Two made-up scenes: one is done early, the other is not done at all."""
    early = [*doublings([3.0, 0.2, 0.1]), point(80, 23.9, downscale=1.0)]
    said = recommend(early)
    assert said.point.train_seconds == 20 and not said.still_rising
    assert said.words == (
        "For this scene: 20 s of training, grid, half resolution: 23.0 dB (one seed each: the spread is unknown). "
        "Full resolution gains 0.9 dB for 4.0 × the time. With 50% of the time (grid, half resolution) "
        "it is 3.0 dB less."
    )
    late = recommend(doublings([1.0, 1.0, 1.0, 1.0]))
    assert late.point.train_seconds == 160 and late.still_rising
    assert "took 2 min 40 s; a larger --budget" in late.words


def test_a_gain_within_the_spread_is_called_that() -> None:
    points = [point(10, 20, seeds=2, spread=0.5), point(20, 25, seeds=2, spread=0.5)]
    points.append(point(40, 25.3, seeds=2, spread=0.5))
    said = recommend(points).words
    assert "25.0 ± 0.4 dB" in said
    assert "Training longer gains 0.3 dB for 2.0 × the time, which is within the spread." in said
    assert "within the spread" not in recommend([*points[:2], point(40, 25.9)]).words


@pytest.mark.parametrize("space", ["bounded", "contracted"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_command_of_a_setting_asks_for_what_it_was(variant: str, space: Space) -> None:
    words = shlex.split(train_command(variant, 48.6, 4.0, space, "my fox.nerf"))
    assert words[:3] == ["pipeline", "train", "my fox.nerf"]
    given = parse(StageArguments, "train", words[2:])
    asked = Config(**Run(variant, space, 4.0, 1, 0, 0.0).options).model_copy(update={"steps": None, "seconds": 49.0})
    view_dependence = with_effects(given.settings, given.effect).effects.force.get("view_dependence")
    assert view_dependence == {None: None, True: "on", False: "off"}[asked.view_dependence]
    assert given.settings.train.kind == asked.kind
    usual = {"view_dependence": None, "preset": asked.preset or "standard"}
    assert given.settings.train == asked.model_copy(update=usual)


@pytest.mark.parametrize(
    "remembered", [{"preset": "paper", "vanilla": {"width": 64}}, {"grid": {"num_levels": 3}, "steps": 9}]
)
@pytest.mark.parametrize("variant", ["grid", REDUCED, PUBLISHED])
def test_the_command_is_taken_whatever_field_a_workspace_remembers(variant: str, remembered: dict[str, Any]) -> None:
    words = shlex.split(train_command(variant, 48.6, 2.0, "contracted", "fox.nerf"))[2:]
    parsed = parse(StageArguments, "train", words).settings
    train = with_flags(Settings(train=Config(**remembered)), parsed, "train", words).train
    assert (train.kind, train.steps, train.seconds) == (field_name(variant), None, 49)
    assert train.preset == VARIANTS[variant].options.get("preset", "standard")


def test_the_command_names_a_workspace_whose_name_is_not_unicode() -> None:
    words = train_command("grid", 48.6, 2.0, "bounded", "caf\udce9's.nerf")
    assert words.startswith(r"pipeline train $'caf\xe9\'s.nerf' --train.")
    words.encode()


# Settings of the study of fox: seconds, dB, deviation over two seeds.
FOX_GRID = [(2.1, 14.09, 0.86), (3.8, 15.99, 1.69), (6.6, 18.61, 1.73), (10.8, 21.67, 0.51), (18.3, 24.83, 0.22)]
FOX_GRID += [(30.4, 27.72, 0.03), (48.9, 29.26, 0.05)]
FOX_VANILLA = [(26.8, 18.79, 0.84), (27.3, 18.91, 0.88)]


def test_short_trainings_spread_is_no_noise_of_long_ones() -> None:
    points = [point(s, psnr, seeds=2, psnr_std=d, downscale=4.0) for s, psnr, d in FOX_GRID]
    points += [point(s, psnr, seeds=2, psnr_std=d, variant="vanilla, reduced") for s, psnr, d in FOX_VANILLA]
    points.append(point(83.7, 30.48, downscale=4.0))
    points = [replace(p, spread=pooled_spread(p, points)) for p in points]
    assert points[-1].spread == pytest.approx(((0.05**2 + 0.03**2 + 0.22**2) / 3) ** 0.5)
    assert points[0].spread == pytest.approx(((0.86**2 + 1.69**2 + 1.73**2) / 3) ** 0.5)
    said = recommend(points)
    assert said.point is points[-1], "1.2 dB for 1.7 times the time, of which 0.2 may be chance"
    assert "30.5 ± 0.1 dB" in said.words and "within the spread" not in said.words


def test_one_fields_spread_is_not_anothers() -> None:
    grid, vanilla = (
        point(10, 20, seeds=4, psnr_std=0.1),
        point(10, 15, seeds=4, psnr_std=1.0, variant="vanilla, reduced"),
    )
    ablated = point(11, 15, variant="no view dependence")
    assert pooled_spread(point(12, 20), [grid, vanilla]) == pytest.approx(0.1)
    assert pooled_spread(ablated, [grid, vanilla]) == pytest.approx(1.0)
    assert pooled_spread(ablated, [grid, ablated]) == pytest.approx(0.1)


def test_the_ends_of_a_ladder_keep_their_own_spread() -> None:
    """Where the time was too short for second seeds in between."""
    ends = [point(4, 14, seeds=2, psnr_std=1.7), *(point(s, 30, seeds=2, psnr_std=0.05) for s in (60, 61))]
    between = [point(s, 20) for s in (7, 12, 20, 35)]
    points = [*ends, *between]
    assert [pooled_spread(p, points) for p in ends] == [pytest.approx(d) for d in (1.7, 0.05, 0.05)]
    assert [pooled_spread(p, points) for p in between[::3]] == [pytest.approx(d) for d in (1.7, 0.05)]


def test_a_small_spread_has_its_digits() -> None:
    assert "23.00 ± 0.02 dB" in recommend(doublings([3.0, 0.1], seeds=4, spread=0.04)).words


def test_seeds_of_a_setting_make_one_point() -> None:
    figures = {"failed": None, "frame_seconds": 1.0, "peak_memory_mb": 5, "model_mb": 1.0}
    results = [
        (
            Run("grid", "bounded", 2.0, 100, seed, 0.0),
            {**figures, "psnr": 20.0 + seed, "ssim": 0.8 + 0.01 * seed, "train_seconds": 10.0 + seed},
        )
        for seed in range(3)
    ]
    results += [
        (Run("grid", "bounded", 4.0, 100, 0, 0.0), {**figures, "psnr": 18.0, "train_seconds": 4.0, "ssim": None})
    ]
    results += [(Run("small grid", "bounded", 4.0, 100, 0, 0.0), {"failed": "it diverged"})]
    alone, three = points_of(results)
    assert (three.psnr, three.psnr_std, three.seeds, three.train_seconds) == (21.0, 1.0, 3, 11.0)
    assert (three.ssim, three.ssim_std) == (pytest.approx(0.81), pytest.approx(0.01))
    assert (alone.psnr, alone.psnr_std, alone.seeds) == (18.0, None, 1) and alone.ssim is alone.ssim_std is None
    assert alone.spread == three.spread == 1.0 and points_of(results[3:])[0].spread is None
    own = point(180.0, 22.0, variant=WORKSPACE_FIELD)
    assert points_of(results, own)[-1] == replace(own, spread=1.0)


def test_the_workspaces_own_field_is_placed_and_never_the_answer() -> None:
    tried = [*doublings([3.0, 0.2]), point(5, 10, variant="small grid")]
    without = recommend(tried)

    def placed(seconds: float, psnr: float) -> str:
        said = recommend([*tried, point(seconds, psnr, variant=WORKSPACE_FIELD, downscale=1.0)])
        assert (said.point, said.still_rising) == (without.point, without.still_rising)
        assert said.words.startswith(without.words)
        return said.words.removeprefix(without.words)

    own = " This workspace's field (2 min 40 s, "
    assert placed(160, 24.2) == f"{own}24.2 dB) gains 1.2 dB over the one recommended for 8.0 × the time."
    assert placed(160, 22.5) == f"{own}22.5 dB) is beaten by grid, half resolution: 23.0 dB after 20 s."
    assert placed(8, 19.0).endswith("(8 s, 19.0 dB) is 4.0 dB below the one recommended for 0.4 × the time.")
    rows = table([*tried, point(160, 30.0, variant=WORKSPACE_FIELD)])
    assert [row["pareto_front"] for row in rows if row["variant"] == WORKSPACE_FIELD] == [False]
    assert sum(row["pareto_front"] for row in rows) == sum(row["pareto_front"] for row in table(tried)) == 4


def test_the_recommendation_changes_with_the_scene_whatever_the_workspace_has() -> None:
    """Of both published studies the longest training is half as long as that of the workspace."""
    own = point(180.0, 30.0, variant=WORKSPACE_FIELD)
    early, late = (recommend([*doublings(gains), own]) for gains in ([3.0, 0.2, 0.1], [1.0, 1.0, 1.0]))
    assert (early.point.train_seconds, late.point.train_seconds) == (20, 80)
    assert not early.still_rising and late.still_rising
    assert "took 1 min 20 s; a larger --budget" in late.words


def test_more_time_is_not_advised_without_gain() -> None:
    worse = recommend([*doublings([3.0]), point(90, 22.5)])
    assert worse.point.train_seconds == 20 and not worse.still_rising
    assert "longer trainings were no better" in worse.words and "--budget" not in worse.words
    alone = recommend([point(20, 23.0)])
    assert not alone.still_rising and alone.words.endswith(". Only one setting was tried.")
    first = recommend([point(20, 23.0), point(22, 21.0)])
    assert not first.still_rising and first.words.endswith(". No setting tried is better.")
    about_as_long = recommend([*doublings([3.0]), point(23, 22.5)])
    assert about_as_long.still_rising and "took 23 s; a larger --budget" in about_as_long.words
    other_kind = recommend([*doublings([3.0]), point(90, 15.0, variant="vanilla, reduced")])
    assert other_kind.still_rising, "what a vanilla NeRF does tells nothing of a grid"


def test_the_fastest_point_of_the_front_is_marked() -> None:
    points = [point(10, 20, frame_seconds=3.0), point(15, 19, frame_seconds=0.5), point(20, 23, frame_seconds=1.0)]
    rows = table(points)
    assert [row["fastest_to_render"] for row in rows] == [False, False, True], "the fastest of all is beaten"


def test_the_spread_weighs_settings_by_seeds() -> None:
    points = [point(1, 20, seeds=2, psnr_std=1.0), point(2, 20, seeds=4, psnr_std=0.5)]
    assert pooled_spread(points[0], points) == pytest.approx(((1 * 1 + 3 * 0.25) / 4) ** 0.5)
    assert pooled_spread(points[1], points) == pytest.approx(0.5), "three degrees of freedom of its own"
