import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.tradeoff_arms import (
    FEWEST_STEPS,
    MEANINGS,
    PUBLISHED,
    REDUCED,
    RUNGS,
    TIMED,
    VARIANTS,
    Reading,
    Speed,
    photo_sizes,
    resolution_words,
    round_to_two_digits,
    select,
    wanted,
)
from stages.train import PAPER_SIZES, Config

FAST = {name: Speed(100.0, 1e6) for name in TIMED}
SIZES = (1.0, 2.0, 4.0)


def test_every_variant_is_one_that_stage_train_takes() -> None:
    for arm in select(1e4, 1, SIZES, FAST, 1000).arms:
        assert Config(**arm.options).kind == ("grid" if "grid" in arm.variant else "paper")


def test_every_variant_is_explained_with_its_sizes() -> None:
    assert set(MEANINGS) == set(VARIANTS)
    for name, variant in VARIANTS.items():
        if variant.family.startswith("grid"):
            assert f"{variant.options['levels']} grids" in MEANINGS[name]
        if variant.family == "grid":
            assert f"{variant.options['finest']:,}³ cells" in MEANINGS[name]
    for name, sizes in ((REDUCED, PAPER_SIZES["small"]), (PUBLISHED, PAPER_SIZES["published"])):
        words = "{depth} layers of {width}, {samples_coarse} + {samples_fine} samples".format(**sizes)
        assert words in MEANINGS[name]


def test_with_time_enough_nothing_is_left_out_and_each_arm_is_there_once() -> None:
    plenty = {name: Speed(1e4, 1e8) for name in TIMED}
    arms, left_out = select(600, 1, SIZES, plenty, 0)
    assert not left_out
    assert {arm.variant for arm in arms} == set(VARIANTS)
    assert len({arm.name for arm in arms}) == len(arms) > 2 * RUNGS
    keys = list(wanted(3))
    assert len(set(keys)) == len(keys) == 3 * len(arms)


@given(st.floats(10, 1e5), st.integers(1, 4), st.floats(0.01, 1e3), st.floats(0, 1e5))
def test_a_plan_keeps_to_its_time(seconds: float, seeds: int, steps: float, drawn: float) -> None:
    speeds = {name: Speed(steps, 100 * steps) for name in TIMED}
    selection = select(seconds, seeds, SIZES, speeds, drawn)
    assert selection.seconds <= seconds
    assert all(arm.steps >= FEWEST_STEPS for arm in selection.arms)
    for name in VARIANTS:
        assert any(arm.variant == name for arm in selection.arms) or any(w.startswith(name) for w in selection.left_out)


def test_the_first_training_at_a_size_reads_the_photos_and_the_study_those_of_its_windows() -> None:
    arms = select(600, 1, SIZES, FAST, 1000).arms
    told = select(600, 1, SIZES, FAST, 1000, Reading(photos=5.0, windows=7.0)).arms
    more = {arm.name: arm.seconds for arm in told}
    slower = [arm.downscale for arm in arms if arm.name in more and more[arm.name] == pytest.approx(arm.seconds + 5)]
    assert sorted(slower) == list(SIZES)
    free = select(600, 1, SIZES, FAST, 1000).seconds
    assert sum(more.values()) <= min(free + 15, 600 - 7)
    assert not select(600, 1, SIZES, FAST, 1000, Reading(photos=600.0)).arms


def test_the_method_and_its_ablations_take_the_same_steps() -> None:
    arms = select(1e4, 1, SIZES, FAST, 1000).arms
    of = {name: {(a.downscale, a.steps) for a in arms if a.variant == name} for name in VARIANTS}
    for name in VARIANTS:
        if VARIANTS[name].family == "ablation":
            assert of[name] and of[name] <= of[REDUCED]


def test_what_is_too_slow_is_named() -> None:
    speeds = FAST | {"paper, published": Speed(0.01, 10.0)}
    selection = select(1800, 1, SIZES, speeds, 1000)
    assert "paper, published" not in {arm.variant for arm in selection.arms}
    assert any(words.startswith("paper, published at a quarter") for words in selection.left_out)


def test_seeds_come_first_where_the_spread_is_judged() -> None:
    keys = list(wanted(2))
    second_of_ladder = keys.index(("grid", 1, RUNGS - 1, 1))
    assert keys.index(("grid", 1, 0, 0)) < second_of_ladder < keys.index(("paper, published", 2, 0, 0))


@pytest.mark.parametrize(
    "chosen, largest, sizes",
    [(8.0, 12.8, (4.0, 8.0, 12.0)), (2.6, 2.6, (1.0, 2.0)), (1.0, 1.0, (1.0,)), (1.0, 2.0, (1.0, 2.0))],
)
def test_photo_sizes_are_distinct_and_not_tiny(chosen: float, largest: float, sizes: tuple[float, ...]) -> None:
    assert photo_sizes(chosen, largest) == sizes


def test_steps_are_round_numbers() -> None:
    assert [round_to_two_digits(value) for value in (0.4, 9.6, 12.34, 1234.0, 98765.0)] == [0, 10, 12, 1200, 99000]


def test_resolutions_in_words() -> None:
    assert [resolution_words(size) for size in (1.0, 2.0, 2.6)] == [
        "full resolution",
        "half resolution",
        "1/2.6 of the resolution",
    ]
