"""Which trainings a study of cost and quality is made of, the most informative first, and which of them fit its time.

An *arm* is one training: a variant of a field, a photo size, a number of steps, a seed. The longest rung of the ladder
of training times takes ``LONGEST`` of the study's time, each further one ``RUNG`` times less.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from stages.effects.decisions import Space

LONGEST = 1 / 20
RUNG = 1.7
RUNGS = 6
FEWEST_STEPS = 30  # a training of fewer says nothing of its field
SMALL_SIDE = 128  # pixels: of photos for the paper's networks, which learn nothing finer in so little time
OVERHEAD = 1.2  # wall time of a training over its training seconds: the probes, the files, photos read before
PROBED_RAYS = 6144  # drawn at the end of a training, which takes long only where a field is drawn slowly
MOST_SCORING = 0.03  # of the study's time, for one score: where it would take more, only one pixel of
THINNED = 4  # along both axes of the windows is drawn
MOST_SHARE = 1 / 6  # of the study's time, for one training
DRAWING = {"grid": 0.7, "paper": 3.0}
"""Rays drawn a second over rays trained, about: drawing does less, but a grid field of few steps is fog all over."""
SPENT_ELSEWHERE = 0.03  # of the study's time: measuring speeds before it, drawing plots after it

Grids = Literal["small", "usual", "large"]


class Variant(NamedTuple):
    """A field as stage train is asked for it. ``family`` groups variants in the plot; ``speed`` names the variant whose
    number of steps this one takes, so that the two differ in nothing else, and ``cost`` is what a ray of this one takes
    beside a ray of that; with less than ``fewest`` steps it is not trained. ``grids``: see :func:`grid_sizes`."""

    family: str
    options: Mapping[str, Any]
    speed: str
    cost: float = 1.0
    fewest: int = FEWEST_STEPS
    grids: Grids | None = None


REDUCED, PUBLISHED, FEWER_RAYS = "paper, reduced", "paper, published", "paper, published, 64 rays a step"
OWN = "this workspace's field"  # no variant that a study trains: it is there, and is scored like the others
WHOLE: Mapping[str, Any] = {"view_dependence": True, "batch_rays": 256}
"""The reduced method with all its parts. Half the rays that stage train would give it, for twice the steps."""
FULL: Mapping[str, Any] = {"view_dependence": True, "preset": "paper"}
VARIANTS: dict[str, Variant] = {
    "small grid": Variant("grid", {}, "small grid", grids="small"),
    "grid": Variant("grid", {}, "grid", grids="usual"),
    "large grid": Variant("grid", {}, "large grid", grids="large"),
    "grid, half the samples": Variant("grid samples", {"ray_samples": 0.5}, "grid", grids="usual"),
    "grid, twice the samples": Variant("grid samples", {"ray_samples": 2.0}, "grid", grids="usual"),
    REDUCED: Variant("paper", WHOLE, REDUCED),
    "paper, half the samples": Variant("paper", {**WHOLE, "samples_coarse": 16, "samples_fine": 16}, REDUCED, 0.5),
    "paper, twice the samples": Variant("paper", {**WHOLE, "samples_coarse": 64, "samples_fine": 64}, REDUCED, 2.0),
    "no hierarchical sampling": Variant("ablation", {**WHOLE, "hierarchical": False}, REDUCED),
    "no positional encoding": Variant("ablation", {**WHOLE, "positional_encoding": False}, REDUCED),
    "no view dependence": Variant("ablation", {**WHOLE, "view_dependence": False}, REDUCED),
    PUBLISHED: Variant("published", FULL, PUBLISHED, fewest=300),
    FEWER_RAYS: Variant("published", {**FULL, "batch_rays": 64}, FEWER_RAYS),
}
OF_GRIDS = "{levels} grids of features, the finest of {finest:,}³ cells"
MEANINGS = {
    "small grid": OF_GRIDS,
    "grid": OF_GRIDS,
    "large grid": OF_GRIDS,
    "grid, half the samples": "the same {levels} grids, looked at in half as many places along a ray",
    "grid, twice the samples": "the same {levels} grids, looked at in twice as many places along a ray",
    REDUCED: "the paper's two networks made small: 4 layers of 64, 32 + 32 samples along a ray, 256 rays a step",
    "paper, half the samples": "two such networks with 16 + 16 samples along a ray, for as many steps",
    "paper, twice the samples": "two such networks with 64 + 64 samples along a ray, for as many steps",
    "no hierarchical sampling": "one such network with as many samples, none of them placed by another",
    "no positional encoding": "two such networks that are given bare coordinates",
    "no view dependence": "two such networks without the direction of the ray",
    PUBLISHED: "the paper's two networks: 8 layers of 256, 64 + 128 samples along a ray, 1,024 rays a step",
    FEWER_RAYS: "the same, 8 layers of 256, 64 + 128 samples along a ray, but 64 rays a step instead of 1,024",
    OWN: "what the workspace had when the study was made, with the seconds of its own training",
}
"""What the variants are, for whoever reads a table of them, with places for the sizes of grids: :func:`meanings`."""
ABLATIONS = tuple(name for name, variant in VARIANTS.items() if variant.family == "ablation")
TIMED = tuple(dict.fromkeys(variant.speed for variant in VARIANTS.values()))

# Groups of trainings: (variant, which of the study's photo sizes, which rungs of the ladder of training times). Sizes
# count from the finest, rungs from the longest; SMALL is the size for the paper's networks.
FINE, MIDDLE, COARSE, SMALL = 0, 1, 2, -1
Groups = Sequence[tuple[str, int, Sequence[int]]]
LADDER: Groups = [("grid", MIDDLE, range(RUNGS)), ("grid", FINE, [0, 1]), ("grid", COARSE, range(3, RUNGS))]
METHOD: Groups = [(name, SMALL, [1]) for name in (REDUCED, *ABLATIONS)]
SMALLER: Groups = [("small grid", MIDDLE, [2])]
ENDS: Groups = [("grid", MIDDLE, [0, RUNGS - 1]), ("grid", FINE, [0])]
SAMPLES: Groups = [(name, MIDDLE, [2, 3]) for name, v in VARIANTS.items() if v.family == "grid samples"]
PAPER: Groups = [(PUBLISHED, SMALL, [1]), (FEWER_RAYS, SMALL, [1]), ("paper, half the samples", SMALL, [1])]
SPREAD: Groups = [("grid", MIDDLE, range(1, RUNGS - 1))]
SIZES: Groups = [("small grid", MIDDLE, [3, 1]), ("large grid", FINE, [1, 0]), ("grid", FINE, [2])]
LONGER: Groups = [("paper, twice the samples", SMALL, [1]), (REDUCED, SMALL, [0])]
ONCE: Groups = [*METHOD, *LADDER, *SMALLER, *SAMPLES, *PAPER, *SIZES, *LONGER]


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
    """One training of a study, in a scene that lies in such a ``space``. ``seconds`` is what it is expected to take in
    all; of ``every`` so many pixels of the windows, along both axes, it is scored on one."""

    variant: str
    space: Space
    downscale: float
    steps: int
    seed: int
    seconds: float
    every: int = 1

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
        given = {"steps": self.steps, "downscale": self.downscale, "seed": self.seed}
        return options_of(self.variant, self.space) | given


class Selection(NamedTuple):
    """The arms to train, in order, and what the time does not allow, in words."""

    arms: tuple[Arm, ...]
    left_out: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """What they are expected to take in all."""
        return sum(arm.seconds for arm in self.arms)


def drawn_per_second(variant: str, speed: Speed) -> float:
    """Rays of pictures a second, expected of a variant whose ``speed`` of training, or that of the one it is timed as,
    is known."""
    return speed.rays * DRAWING[field_of(variant)] / VARIANTS[variant].cost


def family_of(variant: str) -> str:
    """Of variants that belong together in the plot."""
    return "own" if variant == OWN else VARIANTS[variant].family


def field_of(variant: str) -> Literal["grid", "paper"]:
    """The kind of field of a variant, as stage train calls it."""
    return "grid" if VARIANTS[variant].family.startswith("grid") else "paper"


def grid_sizes(grids: Grids, space: Space) -> dict[str, int]:
    """Sizes of a grid field: those that stage train has on a CPU for long runs (``usual``) and for short ones, whatever
    the size of the photos, and larger still, by one grid, twice the rows and twice the cells along an axis."""
    from stages.train.fields.hash_grid import SIZES

    (_, levels, log2_rows, finest), (_, *small) = SIZES[space]
    of = {"small": small, "usual": (levels, log2_rows, finest), "large": (levels + 1, log2_rows + 1, 2 * finest)}
    return dict(zip(("levels", "log2_rows", "finest"), of[grids], strict=True))


def options_of(variant: str, space: Space) -> dict[str, Any]:
    """The field of a variant as stage train is asked for it in such a space."""
    options, grids = VARIANTS[variant].options, VARIANTS[variant].grids
    return {"field": field_of(variant), **options, **(grid_sizes(grids, space) if grids else {})}


def meanings(variants: Collection[str], space: Space) -> str:
    """What these variants are, in words."""
    shown = {name: meaning for name, meaning in MEANINGS.items() if name in variants}
    sizes = {name: {} if name == OWN else options_of(name, space) for name in shown}
    return "; ".join(f"{name}: {meaning.format(**sizes[name])}" for name, meaning in shown.items())


def wanted(seeds: int) -> Iterator[tuple[str, int, int, int]]:
    """(variant, photo size, rung, seed) of all arms, the most informative first: the grid's ladder, the ablation and a
    smaller grid; second seeds of the ladder's ends and of the ablation; samples; the published networks; second
    seeds of the ladder's other rungs; sizes of grids; every other seed."""
    rounds: list[tuple[Groups, int]] = [([*LADDER, *METHOD, *SMALLER], 0)]
    rounds += [([*ENDS, *METHOD], 1)] if seeds > 1 else []
    rounds += [([*SAMPLES, *PAPER], 0)]
    rounds += [(SPREAD, 1)] if seeds > 1 else []
    rounds += [([*SIZES, *LONGER], 0), *((ONCE, seed) for seed in range(1, seeds))]
    said = set()
    for groups, seed in rounds:
        for variant, size, rungs in groups:
            for rung in rungs:
                if (key := (variant, size, rung, seed)) not in said:
                    said.add(key)
                    yield key


def select(
    seconds: float,
    seeds: int,
    space: Space,
    downscales: Sequence[float],
    speeds: Mapping[str, Speed],
    drawn_rays: float,
    reading: Reading = AT_ONCE,
) -> Selection:
    """The arms that fit into ``seconds``, in the order of :func:`wanted`; one that does not fit gives way to cheaper
    ones behind it.

    ``downscales`` are the photo sizes, the last one that for the paper's networks; sizes that are the same make one
    arm. ``drawn_rays`` are drawn to score each, and the first of a photo size has to read the photos. The published
    networks take fewer rays a step only where there is no time for as many as published.
    """
    left, arms, left_out = seconds * (1 - SPENT_ELSEWHERE) - reading.windows, dict[str, Arm](), dict[str, Arm]()
    for variant, size, rung, seed in wanted(seeds):
        downscale = downscales[-1 if size == SMALL else min(size, max(0, len(downscales) - 2))]
        arm = _arm(variant, space, downscale, rung, seed, seconds, speeds, drawn_rays)
        if arm.name in arms or (variant == FEWER_RAYS and any(a.variant == PUBLISHED for a in arms.values())):
            continue
        if all(arm.downscale != other.downscale for other in arms.values()):
            arm = arm._replace(seconds=arm.seconds + reading.photos)
        if arm.steps < VARIANTS[variant].fewest or arm.seconds > min(left, MOST_SHARE * seconds):
            left_out[arm.name] = arm
        else:
            arms[arm.name] = arm
            left -= arm.seconds
    return Selection(tuple(arms.values()), in_words(tuple(left_out.values())))


def _arm(
    variant: str,
    space: Space,
    downscale: float,
    rung: int,
    seed: int,
    seconds: float,
    speeds: Mapping[str, Speed],
    drawn_rays: float,
) -> Arm:
    speed, trained = speeds[VARIANTS[variant].speed], seconds * LONGEST / RUNG**rung
    steps = max(1, round_to_two_digits(trained * speed.steps))
    drawn = drawn_per_second(variant, speed)
    every = scored_every(drawn_rays / drawn, seconds)
    training = OVERHEAD * VARIANTS[variant].cost * steps / speed.steps
    return Arm(variant, space, downscale, steps, seed, training + (PROBED_RAYS + drawn_rays / every**2) / drawn, every)


def scored_every(drawing: float, seconds: float) -> int:
    """Of so many pixels of the windows, along both axes, one is scored: all, unless ``drawing`` them takes too many of
    a study's ``seconds``."""
    return 1 if drawing <= MOST_SCORING * seconds else THINNED


def round_to_two_digits(value: float) -> int:
    """The nearest whole number with two digits that are not zero."""
    return int(float(f"{value:.1e}")) if value >= 10 else round(value)


def in_words(arms: Sequence[Arm]) -> tuple[str, ...]:
    """``grid at half resolution: 26, 15 steps (fewer than 30)``, and how many further seeds."""
    groups: dict[tuple[str, float, bool], list[int]] = {}
    for arm in (arm for arm in arms if arm.seed == 0):
        few = arm.steps < VARIANTS[arm.variant].fewest
        groups.setdefault((arm.variant, arm.downscale, few), []).append(arm.steps)
    words = [
        f"{variant} at {resolution_words(downscale)}: {', '.join(f'{count:,}' for count in steps)} steps"
        + f" (fewer than {VARIANTS[variant].fewest})" * few
        for (variant, downscale, few), steps in groups.items()
    ]
    seeds = sum(arm.seed > 0 for arm in arms)
    return (*words, *([f"{seeds} trainings with further seeds"] if seeds else []))


def resolution_words(downscale: float) -> str:
    """``full resolution``, ``half resolution``, ``a quarter of the resolution``, ``1/2.7 of the resolution``."""
    names = {1.0: "full resolution", 2.0: "half resolution", 3.0: "a third of the resolution"}
    names[4.0] = "a quarter of the resolution"
    return names.get(downscale, f"1/{downscale:g} of the resolution")


def photo_sizes(chosen: float, largest: float, longer_side: float) -> tuple[float, ...]:
    """The downscales of a study, the finest first: half of the one ``chosen`` for its longest training, so that finer
    photos have their chance, twice and four times that, whole numbers; none beyond ``largest``, none nearly another.
    Then that for the paper's networks: it leaves at most SMALL_SIDE of ``longer_side`` pixels."""
    most = max(1, int(largest))
    sizes = [float(min(max(1, round(chosen / 2)) * factor, most)) for factor in (1, 2, 4)]
    kept = [size for index, size in enumerate(sizes) if index == 0 or size > 1.25 * sizes[index - 1]]
    return (*kept, float(max(1, math.ceil(longer_side / SMALL_SIDE))))
