import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.effects.decisions import Space
from stages.io.amounts import resolution_name
from stages.tradeoff.schedule import (
    ABLATIONS,
    DESCRIPTIONS,
    FEWER_RAYS,
    LEVEL_RATIO,
    LONGEST_RUN,
    MAX_RUN,
    MIN_STEPS,
    NUM_LEVELS,
    PUBLISHED,
    REDUCED,
    SCORING_STRIDE,
    TIMED,
    VARIANTS,
    WORKSPACE_FIELD,
    ReadingTime,
    Schedule,
    Speed,
    describe,
    list_runs,
    make_schedule,
    photo_sizes,
    round_to_two_digits,
    run_order,
    train_options,
)
from stages.train import Config
from stages.train.fields import hash_grid, vanilla

FAST = {name: Speed(100.0, 1e6) for name in TIMED}
SIZES = (1.0, 2.0, 4.0, 8.0)
SPACES = pytest.mark.parametrize("space", ["bounded", "contracted"])
# Two cores without a GPU: steps and rays a second, as in the studies; the published networks' steps
# by their arithmetic.
CORES = {"small grid": Speed(32.0, 200e3), "grid": Speed(27.0, 170e3), "large grid": Speed(21.0, 130e3)}
CORES |= {REDUCED: Speed(27.0, 6.9e3), PUBLISHED: Speed(0.066, 68.0), FEWER_RAYS: Speed(1.06, 68.0)}


@SPACES
def test_every_variant_is_one_that_stage_train_takes(space: Space) -> None:
    for run in make_schedule(1e4, 1, space, SIZES, FAST, 1000).runs:
        assert Config(**run.options).kind == ("grid" if "grid" in run.variant else "vanilla")


@SPACES
def test_a_study_uses_training_grid_sizes(space: Space) -> None:
    def sizes(variant: str) -> tuple[int, ...]:
        return tuple(
            train_options(variant, space)["grid"][name] for name in ("num_levels", "log2_hashmap_size", "max_res")
        )

    usual = [run for run in make_schedule(1e4, 1, space, SIZES, FAST, 1000).runs if run.variant == "grid"]
    assert {run.options["grid"]["max_res"] for run in usual} == {512 if space == "bounded" else 1024}
    chosen = [tuple(entry[1:]) for entry in hash_grid.SIZES[space][-2:]]
    assert [sizes("grid"), sizes("small grid")] == chosen
    assert sizes("grid, half the samples") == sizes("grid, twice the samples") == sizes("grid")
    assert all(larger > usual for larger, usual in zip(sizes("large grid"), sizes("grid"), strict=True))


@SPACES
def test_every_variant_is_explained_with_its_sizes(space: Space) -> None:
    assert set(DESCRIPTIONS) == {*VARIANTS, WORKSPACE_FIELD}
    for name, variant in VARIANTS.items():
        said = describe([name], space)
        if variant.family.startswith("grid"):
            assert f"{train_options(name, space)['grid']['num_levels']} grids" in said
        if variant.family == "grid":
            assert f"{train_options(name, space)['grid']['max_res']:,}³ cells" in said
    assert (
        describe([WORKSPACE_FIELD, "grid"], space)
        == f"{describe(['grid'], space)}; {WORKSPACE_FIELD}: {DESCRIPTIONS[WORKSPACE_FIELD]}"
    )
    networks = {REDUCED: vanilla.REDUCED, PUBLISHED: vanilla.PUBLISHED, FEWER_RAYS: vanilla.PUBLISHED}
    for name, usual in networks.items():
        sizes = usual["vanilla"] | VARIANTS[name].options.get("vanilla", {})
        words = "{depth} layers of {width}, {samples_coarse} + {samples_fine} samples".format(**sizes)
        assert words in DESCRIPTIONS[name] and f"{sizes['batch_rays']:,} rays a step" in DESCRIPTIONS[name]


def test_with_time_enough_every_run_is_there_once() -> None:
    plenty = {name: Speed(1e4, 1e8) for name in TIMED}
    runs, left_out = make_schedule(1e4, 1, "bounded", SIZES, plenty, 0)
    assert not left_out
    assert {run.variant for run in runs} == set(VARIANTS) - {FEWER_RAYS}, "nobody needs fewer rays a step"
    assert len({run.name for run in runs}) == len(runs) > 3 * NUM_LEVELS
    keys = list(run_order(3))
    assert len(set(keys)) == len(keys) == 3 * (len(runs) + 1)


@given(st.floats(10, 1e5), st.integers(1, 4), st.floats(0.01, 1e3), st.floats(0, 1e5))
def test_a_plan_keeps_to_its_time(seconds: float, seeds: int, steps: float, drawn: float) -> None:
    speeds = {name: Speed(steps, 100 * steps) for name in TIMED}
    made = make_schedule(seconds, seeds, "bounded", SIZES, speeds, drawn)
    assert made.seconds <= seconds
    for run in made.runs:
        assert run.steps >= MIN_STEPS and run.seconds <= MAX_RUN * seconds
    variants = {run.variant for run in made.runs}
    for name in VARIANTS:
        left_out = any(run.variant == name for run in made.left_out)
        assert name in variants or left_out or (name == FEWER_RAYS and PUBLISHED in variants)


def planned(seconds: float, sizes: tuple[float, ...], reading: float, drawn: float = 16 * 64**2 + 5e4) -> Schedule:
    """A study on two cores."""
    return make_schedule(seconds, 3, "bounded", sizes, CORES, drawn, ReadingTime(reading, reading))


@pytest.mark.parametrize(
    "sizes, reading",
    [((1.0, 2.0, 4.0), 0.2), ((2.0, 4.0, 7.0, 15.0), 1.5), ((2.0, 4.0, 7.0, 15.0), 15.0), ((1.0, 1.0), 0.1)],
    ids=["lego", "fox", "500 photos", "tiny photos"],
)
@pytest.mark.parametrize("seconds", [600.0, 1320.0, 1800.0, 7200.0])
def test_a_study_on_two_cores_is_complete(seconds: float, sizes: tuple[float, ...], reading: float) -> None:
    made = planned(seconds, sizes, reading)
    assert 0.8 * seconds < made.seconds <= seconds
    seeds: dict[tuple[str, float, int], int] = {}
    for run in made.runs:
        setting = (run.variant, run.downscale, run.steps)
        seeds[setting] = seeds.get(setting, 0) + 1
    assert len(seeds) >= 15
    for variant in (REDUCED, *ABLATIONS):
        assert max(seeds[s] for s in seeds if s[0] == variant) >= 2, "differences have a spread"
    longest = round_to_two_digits(LONGEST_RUN * seconds * CORES["grid"].steps)
    ends = [count for (variant, _, steps), count in seeds.items() if variant == "grid" and steps == longest]
    assert len(ends) == len({*sizes[:2]}) and min(ends) >= 2, "so has the end of the front"
    for variant in ("grid, half the samples", "grid, twice the samples"):
        assert sum(s[0] == variant for s in seeds) >= (2 if reading < 10 else 1), "sample counts on two levels"
    if seconds > 1000 and reading < 10:
        assert any(s[0] == FEWER_RAYS for s in seeds)


def test_vanilla_trainings_are_the_longer_ones() -> None:
    runs = planned(1320.0, (1.0, 2.0, 4.0), 0.2).runs
    steps = {run.variant: run.steps for run in runs if run.variant in (REDUCED, *ABLATIONS)}
    assert set(steps.values()) == {round_to_two_digits(1320 * LONGEST_RUN / LEVEL_RATIO * CORES[REDUCED].steps)}
    assert min(run.steps / CORES["grid"].steps for run in runs if run.variant == "grid") > 4, "seconds"


def test_slow_fields_are_scored_on_fewer_pixels() -> None:
    (run,) = [run for run in planned(1320.0, (1.0, 2.0, 4.0), 0.2).runs if run.variant == FEWER_RAYS]
    assert run.stride == SCORING_STRIDE and run.steps >= MIN_STEPS and run.seconds < 1320 / 6
    assert {a.stride for a in planned(1320.0, (1.0, 2.0, 4.0), 0.2).runs if a.variant != FEWER_RAYS} == {1}


def test_published_networks_have_their_rays_given_time() -> None:
    gpu = CORES | {PUBLISHED: Speed(20.0, 20e3), FEWER_RAYS: Speed(60.0, 4e3)}
    variants = {run.variant for run in make_schedule(1320.0, 3, "bounded", SIZES, gpu, 1e5).runs}
    assert PUBLISHED in variants and FEWER_RAYS not in variants


def test_a_first_training_at_a_size_reads_photos() -> None:
    runs = make_schedule(600, 1, "bounded", SIZES, FAST, 1000).runs
    told = make_schedule(600, 1, "bounded", SIZES, FAST, 1000, ReadingTime(photos=5.0, scored=7.0)).runs
    more = {run.name: run.seconds for run in told}
    slower = [run.downscale for run in runs if run.name in more and more[run.name] == pytest.approx(run.seconds + 5)]
    assert sorted(slower) == list(SIZES)
    free = make_schedule(600, 1, "bounded", SIZES, FAST, 1000).seconds
    assert sum(more.values()) <= min(free + 20, 600 - 7)
    assert not make_schedule(600, 1, "bounded", SIZES, FAST, 1000, ReadingTime(photos=600.0)).runs


def test_the_method_and_its_ablations_take_the_same_steps() -> None:
    runs = make_schedule(1e4, 1, "bounded", SIZES, FAST, 1000).runs
    of = {name: {(a.downscale, a.steps) for a in runs if a.variant == name} for name in VARIANTS}
    for name in ABLATIONS:
        assert of[name] and of[name] <= of[REDUCED]
        assert {size for size, _ in of[name]} == {8.0}, "the small photos"


def test_what_is_too_slow_is_named() -> None:
    speeds = FAST | {PUBLISHED: Speed(0.01, 10.0)}
    made = make_schedule(1800, 1, "bounded", SIZES, speeds, 1000)
    assert PUBLISHED not in {run.variant for run in made.runs}
    assert "vanilla, published at 1/8 of the resolution: 1 step (fewer than 300)" in list_runs(made.left_out)


def test_seeds_come_first_where_the_spread_is_judged() -> None:
    keys = list(run_order(2))
    last_of_front, ablation = keys.index(("grid", 0, 0, 1)), keys.index((REDUCED, -1, 1, 1))
    assert keys.index((REDUCED, -1, 1, 0)) < last_of_front < ablation
    assert keys.index(("grid", 1, NUM_LEVELS - 1, 1)) < ablation, "short trainings are the least alike"
    assert ablation < keys.index(("grid, half the samples", 1, 2, 0)) < keys.index(("grid", 1, NUM_LEVELS - 2, 1))


@pytest.mark.parametrize(
    "chosen, largest, longer_side, sizes",
    [
        (8.0, 12.8, 1920, (4.0, 8.0, 12.0, 15.0)),
        (2.6, 2.6, 400, (1.0, 2.0, 4.0)),
        (1.0, 1.0, 100, (1.0, 1.0)),
        (1.0, 2.0, 256, (1.0, 2.0, 2.0)),
    ],
)
def test_photo_sizes_are_distinct_and_not_tiny(
    chosen: float, largest: float, longer_side: float, sizes: tuple[float, ...]
) -> None:
    assert photo_sizes(chosen, largest, longer_side) == sizes


def test_half_and_twice_the_samples_keep_steps() -> None:
    runs = {run.variant: run for run in make_schedule(1e4, 1, "bounded", SIZES, FAST, 0).runs}
    half, twice = runs["vanilla, half the samples"], runs["vanilla, twice the samples"]
    assert half.steps == twice.steps
    assert twice.seconds == pytest.approx(4 * half.seconds, rel=0.01)


def test_steps_are_round_numbers() -> None:
    assert [round_to_two_digits(value) for value in (0.4, 9.6, 12.34, 1234.0, 98765.0)] == [0, 10, 12, 1200, 99000]


def test_resolutions_in_words() -> None:
    assert [resolution_name(size) for size in (1.0, 2.0, 2.6)] == [
        "full resolution",
        "half resolution",
        "1/2.6 of the resolution",
    ]
