"""Which trainings a study of cost and quality is made of, the most informative first, and which of them fit its time.

An *arm* is one training: a variant of a field, a photo size, a number of steps, a seed. The longest rung of the ladder
of training times takes ``LONGEST`` of the study's time, each further one ``RUNG`` times less.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

LONGEST = 1 / 16
RUNG = 1.7
RUNGS = 8
FEWEST_STEPS = 30  # a training of fewer says nothing of its field
OVERHEAD = 1.2  # wall time of a training over its training seconds: the probes, the files, photos read before
DRAWING = {"grid": 0.7, "paper": 3.0}
"""Rays drawn a second over rays trained, about: drawing does less, but a grid field of few steps is fog all over."""
SPENT_ELSEWHERE = 0.03  # of the study's time: measuring speeds before it, drawing plots after it


class Variant(NamedTuple):
    """A field as stage train is asked for it. ``family`` groups variants in the plot; ``speed`` names the variant whose
    number of steps this one takes, so that the two differ in nothing else."""

    family: str
    options: Mapping[str, Any]
    speed: str


REDUCED, PUBLISHED = "paper, reduced", "paper, published"
VARIANTS: dict[str, Variant] = {
    "small grid": Variant("grid", {"levels": 4, "log2_rows": 17, "finest": 256}, "small grid"),
    "grid": Variant("grid", {"levels": 5, "log2_rows": 18, "finest": 512}, "grid"),
    "large grid": Variant("grid", {"levels": 6, "log2_rows": 19, "finest": 1024}, "large grid"),
    "grid, half the samples": Variant(
        "grid samples", {"levels": 5, "log2_rows": 18, "finest": 512, "ray_samples": 0.5}, "grid"
    ),
    "grid, twice the samples": Variant(
        "grid samples", {"levels": 5, "log2_rows": 18, "finest": 512, "ray_samples": 2.0}, "grid"
    ),
    REDUCED: Variant("paper", {"view_dependence": True}, REDUCED),
    "no hierarchical sampling": Variant("ablation", {"view_dependence": True, "hierarchical": False}, REDUCED),
    "no positional encoding": Variant("ablation", {"view_dependence": True, "positional_encoding": False}, REDUCED),
    "no view dependence": Variant("ablation", {"view_dependence": False}, REDUCED),
    PUBLISHED: Variant("published", {"view_dependence": True, "preset": "paper"}, PUBLISHED),
}
MEANINGS = {
    "small grid": "4 grids of features, the finest of 256³ cells",
    "grid": "5 grids of features, the finest of 512³ cells",
    "large grid": "6 grids of features, the finest of 1,024³ cells",
    "grid, half the samples": "the same 5 grids, looked at in half as many places along a ray",
    "grid, twice the samples": "the same 5 grids, looked at in twice as many places along a ray",
    REDUCED: "the paper's two networks made small: 4 layers of 64, 32 + 32 samples along a ray",
    "no hierarchical sampling": "one such network with as many samples, none of them placed by another",
    "no positional encoding": "two such networks that are given bare coordinates",
    "no view dependence": "two such networks without the direction of the ray",
    PUBLISHED: "the paper's two networks: 8 layers of 256, 64 + 128 samples along a ray",
}
"""What the variants are, for whoever reads a table of them."""
ABLATIONS = tuple(name for name, variant in VARIANTS.items() if variant.family == "ablation")
TIMED = tuple(dict.fromkeys(variant.speed for variant in VARIANTS.values()))

# Groups of trainings: (variant, which of the study's photo sizes, which rungs of the ladder of training times). Sizes
# count from the finest, rungs from the longest.
FINE, MIDDLE, COARSE = 0, 1, 2
LADDER = [("grid", MIDDLE, range(RUNGS))]
SIZES = [("grid", FINE, range(4)), ("grid", COARSE, range(4, RUNGS))]
METHOD = [(name, COARSE, [2]) for name in (REDUCED, *ABLATIONS)]
GRIDS = [("small grid", MIDDLE, [3, 5, 7]), ("large grid", FINE, [2, 1])]
SAMPLES = [(name, MIDDLE, [2]) for name, variant in VARIANTS.items() if variant.family == "grid samples"]
PAPER = [(REDUCED, COARSE, [4, 1]), (PUBLISHED, COARSE, [0])]


class Speed(NamedTuple):
    """Steps and rays a second of training, measured of a variant on this machine."""

    steps: float
    rays: float


class Reading(NamedTuple):
    """Seconds that photos take: all of them before the first training at a size, and those of the windows scored on."""

    photos: float = 0.0
    windows: float = 0.0


AT_ONCE = Reading()


class Arm(NamedTuple):
    """One training of a study. ``seconds`` is what it is expected to take in all."""

    variant: str
    downscale: float
    steps: int
    seed: int
    seconds: float

    @property
    def name(self) -> str:
        """A file name of its own."""
        words = self.variant.replace(",", "").replace(" ", "-")
        return f"{words}_{self.downscale:g}_{self.steps}_{self.seed}"

    @property
    def words(self) -> str:
        """``grid, half resolution, 590 steps, seed 0``."""
        return f"{self.variant}, {resolution_words(self.downscale)}, {self.steps:,} steps, seed {self.seed}"

    @property
    def options(self) -> dict[str, Any]:
        """What stage train is asked for."""
        variant = VARIANTS[self.variant]
        given = {"steps": self.steps, "downscale": self.downscale, "seed": self.seed}
        return {"field": field_of(self.variant), **variant.options, **given}


class Selection(NamedTuple):
    """The arms to train, in order, and what the time does not allow, in words."""

    arms: tuple[Arm, ...]
    left_out: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """What they are expected to take in all."""
        return sum(arm.seconds for arm in self.arms)


def drawn_per_second(variant: str, speed: Speed) -> float:
    """Rays of pictures a second, expected of a variant that trains at ``speed``."""
    return speed.rays * DRAWING[field_of(variant)]


def field_of(variant: str) -> str:
    """The kind of field of a variant, as stage train calls it."""
    return "grid" if VARIANTS[variant].family.startswith("grid") else "paper"


def wanted(seeds: int) -> Iterator[tuple[str, int, int, int]]:
    """(variant, photo size, rung, seed) of all arms, the most informative first: the grid's ladder; photo sizes; the
    ablation; second seeds of the ladder; sizes and samples of grids; the paper's networks; every other seed."""
    once = [*LADDER, *SIZES, *METHOD]
    spread, rest = [("grid", MIDDLE, range(2, RUNGS))], [*GRIDS, *SAMPLES, *PAPER]
    rounds = [(once, 0), *([(spread, 1)] if seeds > 1 else []), (rest, 0)]
    rounds += [([*METHOD, *once, *rest], seed) for seed in range(1, seeds)]
    said = set()
    for entries, seed in rounds:
        for variant, size, rungs in entries:
            for rung in rungs:
                if (key := (variant, size, rung, seed)) not in said:
                    said.add(key)
                    yield key


def select(
    seconds: float,
    seeds: int,
    downscales: Sequence[float],
    speeds: Mapping[str, Speed],
    drawn_rays: float,
    reading: Reading = AT_ONCE,
) -> Selection:
    """The arms that fit into ``seconds``, in the order of :func:`wanted`; one that does not fit gives way to cheaper
    ones behind it. ``drawn_rays`` are drawn to score each, and the first of a photo size has to read the photos. Photo
    sizes that are the same make one arm."""
    left, arms, left_out = seconds * (1 - SPENT_ELSEWHERE) - reading.windows, dict[str, Arm](), dict[str, Arm]()
    for variant, size, rung, seed in wanted(seeds):
        arm = _arm(variant, downscales[min(size, len(downscales) - 1)], rung, seed, seconds, speeds, drawn_rays)
        if arm.name in arms:
            continue
        if all(arm.downscale != other.downscale for other in arms.values()):
            arm = arm._replace(seconds=arm.seconds + reading.photos)
        if arm.steps < FEWEST_STEPS or arm.seconds > left:
            left_out[arm.name] = arm
        else:
            arms[arm.name] = arm
            left -= arm.seconds
    return Selection(tuple(arms.values()), in_words(tuple(left_out.values())))


def _arm(
    variant: str,
    downscale: float,
    rung: int,
    seed: int,
    seconds: float,
    speeds: Mapping[str, Speed],
    drawn_rays: float,
) -> Arm:
    speed, trained = speeds[VARIANTS[variant].speed], seconds * LONGEST / RUNG**rung
    steps = max(1, round_to_two_digits(trained * speed.steps))
    scoring = drawn_rays / drawn_per_second(variant, speed)
    return Arm(variant, downscale, steps, seed, OVERHEAD * steps / speed.steps + scoring)


def round_to_two_digits(value: float) -> int:
    """The nearest whole number with two digits that are not zero."""
    return int(float(f"{value:.1e}")) if value >= 10 else round(value)


def in_words(arms: Sequence[Arm]) -> tuple[str, ...]:
    """``grid at half resolution: 26, 15 steps (fewer than 30)``, and how many further seeds."""
    groups: dict[tuple[str, float, bool], list[int]] = {}
    for arm in (arm for arm in arms if arm.seed == 0):
        groups.setdefault((arm.variant, arm.downscale, arm.steps < FEWEST_STEPS), []).append(arm.steps)
    words = [
        f"{variant} at {resolution_words(downscale)}: {', '.join(f'{count:,}' for count in steps)} steps"
        + f" (fewer than {FEWEST_STEPS})" * few
        for (variant, downscale, few), steps in groups.items()
    ]
    seeds = sum(arm.seed > 0 for arm in arms)
    return (*words, *([f"{seeds} trainings with further seeds"] if seeds else []))


def resolution_words(downscale: float) -> str:
    """``full resolution``, ``half resolution``, ``a quarter of the resolution``, ``1/2.7 of the resolution``."""
    names = {1.0: "full resolution", 2.0: "half resolution", 3.0: "a third of the resolution"}
    names[4.0] = "a quarter of the resolution"
    return names.get(downscale, f"1/{downscale:g} of the resolution")


def photo_sizes(chosen: float, largest: float) -> tuple[float, ...]:
    """The downscales of a study, the finest first: half of the one ``chosen`` for its longest training, so that finer
    photos have their chance, twice and four times that, whole numbers; none beyond ``largest``, none nearly another."""
    most = max(1, int(largest))
    sizes = [float(min(max(1, round(chosen / 2)) * factor, most)) for factor in (1, 2, 4)]
    return tuple(size for index, size in enumerate(sizes) if index == 0 or size > 1.25 * sizes[index - 1])
