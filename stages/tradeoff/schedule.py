"""Which runs a study consists of, the most informative first, and which of them fit its time on this machine.

A *run* is one training: a variant of a field, a photo size, a number of steps, a seed. The number of steps follows from
the *budget level*: level 0 gives a run ``LONGEST_RUN`` of the study's time, each further level ``LEVEL_RATIO`` times
less.
"""

import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

from nerf.geometry.scene import Scene, View
from stages import train
from stages.contract import Inputs, Progress, plan_stage
from stages.effects.decisions import Space, read_decisions
from stages.hardware.device import processors
from stages.io.amounts import counted, resolution_name
from stages.io.ascii_names import shell_quoted
from stages.io.pixels import load_view
from stages.train.config import FieldName
from stages.train.data import scaled_size
from stages.train.fields import hash_grid
from stages.train.fields.field_list import field_of
from stages.train.fields.space import chosen_space
from stages.train.planning import chosen_downscale, rays_per_second

LONGEST_RUN = 1 / 20
LEVEL_RATIO = 1.7
NUM_LEVELS = 6
MIN_STEPS = 30  # a training of fewer says nothing of its field
SMALL_SIDE = 128  # pixels: of photos for the vanilla NeRF, which learn nothing finer in so little time
WALL_TIME_RATIO = 1.2  # wall time of a run over its training seconds: validation, files, photos read before
VALIDATION_RAYS = 6144  # rendered at the end of a training, which takes long only where a field renders slowly
MAX_SCORING = 0.03  # of the study's time, for one score: where it would take more, only every SCORING_STRIDE-th pixel
SCORING_STRIDE = 4  # is rendered, along both axes of the tiles
MAX_RUN = 1 / 6  # of the study's time, for one run
RENDERING_SPEED: dict[FieldName, float] = {"grid": 0.7, "vanilla": 3.0}
"""Rays rendered a second over rays trained, about: rendering does less, but floaters fill a grid field of few steps."""
OTHER_TIME = 0.03  # of the study's time: measuring speeds before it, drawing plots after it

GridSize = Literal["small", "usual", "large"]


class Variant(NamedTuple):
    """A field as stage train is asked for it. ``family`` groups variants in the plot. ``timed_as`` names the variant
    whose speed sets the number of steps, so that the two differ in nothing else, and ``cost`` is what a ray of this one
    takes relative to a ray of that; with fewer than ``min_steps`` it is not trained. ``grid_size``: see
    :func:`grid_sizes`."""

    family: str
    options: Mapping[str, Any]
    timed_as: str
    cost: float = 1.0
    min_steps: int = MIN_STEPS
    grid_size: GridSize | None = None


REDUCED, PUBLISHED, FEWER_RAYS = "vanilla, reduced", "vanilla, published", "vanilla, published, 64 rays a step"
WORKSPACE_FIELD = "this workspace's field"  # no variant that a study trains: it exists, and is scored like the others


def _reduced(view_dependence: bool = True, **options: Any) -> Mapping[str, Any]:
    """The reduced method with all its parts but for ``options``. Half the rays that stage train would give it, for
    twice the steps."""
    return {"view_dependence": view_dependence, "vanilla": {"batch_rays": 256, **options}}


AS_PUBLISHED: Mapping[str, Any] = {"view_dependence": True, "preset": "paper"}
VARIANTS: dict[str, Variant] = {
    "small grid": Variant("grid", {}, "small grid", grid_size="small"),
    "grid": Variant("grid", {}, "grid", grid_size="usual"),
    "large grid": Variant("grid", {}, "large grid", grid_size="large"),
    "grid, half the samples": Variant("grid samples", {"grid": {"ray_samples": 0.5}}, "grid", grid_size="usual"),
    "grid, twice the samples": Variant("grid samples", {"grid": {"ray_samples": 2.0}}, "grid", grid_size="usual"),
    REDUCED: Variant("vanilla", _reduced(), REDUCED),
    "vanilla, half the samples": Variant("vanilla", _reduced(samples_coarse=16, samples_fine=16), REDUCED, 0.5),
    "vanilla, twice the samples": Variant("vanilla", _reduced(samples_coarse=64, samples_fine=64), REDUCED, 2.0),
    "no hierarchical sampling": Variant("ablation", _reduced(hierarchical=False), REDUCED),
    "no positional encoding": Variant("ablation", _reduced(positional_encoding=False), REDUCED),
    "no view dependence": Variant("ablation", _reduced(view_dependence=False), REDUCED),
    PUBLISHED: Variant("published", AS_PUBLISHED, PUBLISHED, min_steps=300),
    FEWER_RAYS: Variant("published", {**AS_PUBLISHED, "vanilla": {"batch_rays": 64}}, FEWER_RAYS),
}
GRID = "{grid[num_levels]} grids of features, the finest of {grid[max_res]:,}³ cells"
DESCRIPTIONS = {
    "small grid": GRID,
    "grid": GRID,
    "large grid": GRID,
    "grid, half the samples": "the same {grid[num_levels]} grids with half as many samples along a ray",
    "grid, twice the samples": "the same {grid[num_levels]} grids with twice as many samples along a ray",
    REDUCED: "the vanilla NeRF's two networks made small: 4 layers of 64, 32 + 32 samples along a ray, 256 rays a step",
    "vanilla, half the samples": "two such networks with 16 + 16 samples along a ray, for as many steps",
    "vanilla, twice the samples": "two such networks with 64 + 64 samples along a ray, for as many steps",
    "no hierarchical sampling": "one such network with as many samples, all stratified",
    "no positional encoding": "two such networks on bare coordinates",
    "no view dependence": "two such networks without the direction of the ray",
    PUBLISHED: "the vanilla NeRF's two networks: 8 layers of 256, 64 + 128 samples along a ray, 1,024 rays a step",
    FEWER_RAYS: "the same, 8 layers of 256, 64 + 128 samples along a ray, but 64 rays a step instead of 1,024",
    WORKSPACE_FIELD: "the field of the workspace when the study was made, with the seconds of its own training",
}
"""What the variants are, for the reader of a table, with places for the sizes of grids: :func:`describe`."""
ABLATIONS = tuple(name for name, variant in VARIANTS.items() if variant.family == "ablation")
TIMED = tuple(dict.fromkeys(variant.timed_as for variant in VARIANTS.values()))

# Groups of runs: (variant, which of the study's photo sizes, which budget levels). Sizes count from the finest; SMALL
# is the size for the vanilla NeRF.
FINE, MIDDLE, COARSE, SMALL = 0, 1, 2, -1
Groups = Sequence[tuple[str, int, Sequence[int]]]
GRID_LEVELS: Groups = [
    ("grid", MIDDLE, range(NUM_LEVELS)),
    ("grid", FINE, [0, 1]),
    ("grid", COARSE, range(3, NUM_LEVELS)),
]
ABLATION: Groups = [(name, SMALL, [1]) for name in (REDUCED, *ABLATIONS)]
SMALLER: Groups = [("small grid", MIDDLE, [2])]
OUTER_LEVELS: Groups = [("grid", MIDDLE, [0, NUM_LEVELS - 1]), ("grid", FINE, [0])]
INNER_LEVELS: Groups = [("grid", MIDDLE, range(1, NUM_LEVELS - 1))]
SAMPLES: Groups = [(name, MIDDLE, [2, 3]) for name, v in VARIANTS.items() if v.family == "grid samples"]
VANILLA: Groups = [(PUBLISHED, SMALL, [1]), (FEWER_RAYS, SMALL, [1]), ("vanilla, half the samples", SMALL, [1])]
SIZES: Groups = [("small grid", MIDDLE, [3, 1]), ("large grid", FINE, [1, 0]), ("grid", FINE, [2])]
LONGER: Groups = [("vanilla, twice the samples", SMALL, [1]), (REDUCED, SMALL, [0])]
EVERYTHING: Groups = [*ABLATION, *GRID_LEVELS, *SMALLER, *SAMPLES, *VANILLA, *SIZES, *LONGER]


class Speed(NamedTuple):
    """Steps and rays a second of training, measured for a variant on this machine."""

    steps: float
    rays: float


class ReadingTime(NamedTuple):
    """Seconds to read photos: all of them before the first run at a size, and the test photos to score."""

    photos: float = 0.0
    scored: float = 0.0


NO_READING = ReadingTime()


class Run(NamedTuple):
    """One training of a study, in a scene of that ``space``. ``seconds`` is what it is expected to take in all; every
    ``stride``-th pixel of the tiles is scored, along both axes."""

    variant: str
    space: Space
    downscale: float
    steps: int
    seed: int
    seconds: float
    stride: int = 1

    @property
    def name(self) -> str:
        """A file name of its own."""
        words = self.variant.replace(",", "").replace(" ", "-")
        return f"{words}_{self.downscale:g}_{self.steps}_{self.seed}"

    @property
    def label(self) -> str:
        """``grid, half resolution, 590 steps, seed 0``."""
        return f"{self.variant}, {resolution_name(self.downscale)}, {counted(self.steps, 'step')}, seed {self.seed}"

    @property
    def options(self) -> dict[str, Any]:
        """What stage train is asked for."""
        given = {"steps": self.steps, "downscale": self.downscale, "seed": self.seed}
        return train_options(self.variant, self.space) | given


class Schedule(NamedTuple):
    """The runs of a study in order, and those that the time does not allow."""

    runs: tuple[Run, ...]
    left_out: tuple[Run, ...]

    @property
    def seconds(self) -> float:
        """What they are expected to take in all."""
        return sum(run.seconds for run in self.runs)


def field_name(variant: str) -> FieldName:
    """The field of a variant, as stage train calls it."""
    return train.Config(**VARIANTS[variant].options).kind


def family_of(variant: str) -> str:
    """The variants that belong together in the plot."""
    return "workspace" if variant == WORKSPACE_FIELD else VARIANTS[variant].family


def grid_sizes(size: GridSize, space: Space) -> dict[str, int]:
    """Sizes of a grid field: those that stage train has on a CPU for a few minutes (``usual``) and for shorter runs,
    whatever the size of the photos, and larger still, by one grid, twice the rows and twice the cells along an axis."""
    *_, (_, *usual), (_, *small) = hash_grid.SIZES[space]
    large = (usual[0] + 1, usual[1] + 1, 2 * usual[2])
    of = {"small": small, "usual": usual, "large": large}
    return dict(zip(("num_levels", "log2_hashmap_size", "max_res"), of[size], strict=True))


def train_options(variant: str, space: Space) -> dict[str, Any]:
    """The field of a variant as stage train is asked for it in such a space."""
    options, size = VARIANTS[variant].options, VARIANTS[variant].grid_size
    sized = {"grid": {**options.get("grid", {}), **grid_sizes(size, space)}} if size else {}
    return {"field": field_name(variant), **options, **sized}


def describe(variants: Collection[str], space: Space) -> str:
    """What these variants are, in words."""
    shown = {name: text for name, text in DESCRIPTIONS.items() if name in variants}
    sizes = {name: {} if name == WORKSPACE_FIELD else train_options(name, space) for name in shown}
    return "; ".join(f"{name}: {text.format(**sizes[name])}" for name, text in shown.items())


def train_command(variant: str, seconds: float, downscale: float, space: Space, workspace: str) -> str:
    """What trains a variant for so long in a workspace. Field and preset are given, because it may remember others, and
    the field's sizes, because those that would be chosen follow from a timing."""
    given = {"seconds": max(1, round(seconds)), "downscale": downscale, "preset": "standard"}
    flags = _flags("train", given | train_options(variant, space))
    return " ".join(["pipeline train", shell_quoted(workspace), *flags])


def _flags(group: str, options: Mapping[str, Any]) -> Iterator[str]:
    for name, value in options.items():
        flag = name.replace("_", "-")
        if isinstance(value, Mapping):
            yield from _flags(f"{group}.{flag}", value)
        elif name == "view_dependence":  # an option of stage effects
            yield f"--effect view_dependence={'on' if value else 'off'}"
        elif value is False:
            yield f"--{group}.no-{flag}"
        else:
            yield f"--{group}.{flag} {value if isinstance(value, str) else format(value, 'g')}"


# --- which runs fit the time


def run_order(seeds: int) -> Iterator[tuple[str, int, int, int]]:
    """(variant, photo size, budget level, seed) of all runs, the most informative first: the grid at all levels, the
    ablation and a smaller grid; second seeds of the outer levels and of the ablation; samples; the published networks;
    second seeds of the inner levels; sizes of grids; every other seed."""
    rounds: list[tuple[Groups, int]] = [([*GRID_LEVELS, *ABLATION, *SMALLER], 0)]
    rounds += [([*OUTER_LEVELS, *ABLATION], 1)] if seeds > 1 else []
    rounds += [([*SAMPLES, *VANILLA], 0)]
    rounds += [(INNER_LEVELS, 1)] if seeds > 1 else []
    rounds += [([*SIZES, *LONGER], 0), *((EVERYTHING, seed) for seed in range(1, seeds))]
    keys = (
        (variant, size, level, seed) for groups, seed in rounds for variant, size, levels in groups for level in levels
    )
    return iter(dict.fromkeys(keys))


def make_schedule(
    seconds: float,
    seeds: int,
    space: Space,
    downscales: Sequence[float],
    speeds: Mapping[str, Speed],
    scored_rays: float,
    reading: ReadingTime = NO_READING,
) -> Schedule:
    """The runs that fit into ``seconds``, in the order of :func:`run_order`; one that does not fit gives way to cheaper
    ones behind it.

    ``downscales`` are the photo sizes, the last one that for the vanilla NeRF; equal sizes make one run.
    ``scored_rays`` are rendered to score each, and the first run at a photo size has to read the photos. The published
    networks take fewer rays a step only where there is no time for as many as published.
    """
    left, runs, left_out = seconds * (1 - OTHER_TIME) - reading.scored, dict[str, Run](), dict[str, Run]()
    for variant, size, level, seed in run_order(seeds):
        downscale = downscales[-1 if size == SMALL else min(size, max(0, len(downscales) - 2))]
        run = _run(variant, space, downscale, level, seed, seconds, speeds, scored_rays)
        if run.name in runs or (variant == FEWER_RAYS and any(r.variant == PUBLISHED for r in runs.values())):
            continue
        if all(run.downscale != other.downscale for other in runs.values()):
            run = run._replace(seconds=run.seconds + reading.photos)
        if run.steps < VARIANTS[variant].min_steps or run.seconds > min(left, MAX_RUN * seconds):
            left_out[run.name] = run
        else:
            runs[run.name] = run
            left -= run.seconds
    return Schedule(tuple(runs.values()), tuple(left_out.values()))


def _run(
    variant: str,
    space: Space,
    downscale: float,
    level: int,
    seed: int,
    seconds: float,
    speeds: Mapping[str, Speed],
    scored_rays: float,
) -> Run:
    speed, budget = speeds[VARIANTS[variant].timed_as], seconds * LONGEST_RUN / LEVEL_RATIO**level
    steps = max(1, round_to_two_digits(budget * speed.steps))
    rendering = rendered_rays_per_second(variant, speed)
    stride = scoring_stride(scored_rays / rendering, seconds)
    training = WALL_TIME_RATIO * VARIANTS[variant].cost * steps / speed.steps
    expected = training + (VALIDATION_RAYS + scored_rays / stride**2) / rendering
    return Run(variant, space, downscale, steps, seed, expected, stride)


def rendered_rays_per_second(variant: str, speed: Speed) -> float:
    """Rays rendered a second, expected of a variant from the ``speed`` of training of the one it is timed as."""
    return speed.rays * RENDERING_SPEED[field_name(variant)] / VARIANTS[variant].cost


def scoring_stride(rendering: float, seconds: float) -> int:
    """1 to score all pixels of the tiles; SCORING_STRIDE where ``rendering`` them takes too many of a study's
    ``seconds``."""
    return 1 if rendering <= MAX_SCORING * seconds else SCORING_STRIDE


def round_to_two_digits(value: float) -> int:
    """The nearest whole number with two digits that are not zero."""
    return int(float(f"{value:.1e}")) if value >= 10 else round(value)


def list_runs(runs: Sequence[Run]) -> tuple[str, ...]:
    """``grid at half resolution: 26, 15 steps (fewer than 30)``, and how many further seeds."""
    groups: dict[tuple[str, float, bool], list[int]] = {}
    for run in (run for run in runs if run.seed == 0):
        too_few = run.steps < VARIANTS[run.variant].min_steps
        groups.setdefault((run.variant, run.downscale, too_few), []).append(run.steps)
    words = [
        f"{variant} at {resolution_name(downscale)}: "
        + ", ".join([*(f"{count:,}" for count in steps[:-1]), counted(steps[-1], "step")])
        + f" (fewer than {VARIANTS[variant].min_steps})" * too_few
        for (variant, downscale, too_few), steps in groups.items()
    ]
    seeds = sum(run.seed > 0 for run in runs)
    return (*words, *([f"{counted(seeds, 'run')} with further seeds"] if seeds else []))


# --- how fast this machine is, and which photo sizes that calls for


class _NoNotes:
    """A Progress without notes: stage train says them again."""

    def __init__(self, progress: Progress) -> None:
        self.update = progress.update

    def note(self, code: str, text: str) -> None:
        """Nothing."""


def measure_speeds(scene: Scene, inputs: Inputs, seconds: float, progress: Progress) -> dict[str, Speed]:
    """Train each variant that is timed for a second or two.

    The published networks are timed only where a study of ``seconds`` could train them: one of their steps may take
    longer than the whole timing. Otherwise their speed follows from their arithmetic relative to the reduced networks.
    """
    decisions, speeds = read_decisions(inputs["effects"]), dict[str, Speed]()
    space, _ = chosen_space(decisions, scene)
    for number, name in enumerate(TIMED, 1):  # no share of the work is told: that is of the study, not of its plan
        progress.update(f"timing training {number} of {len(TIMED)}: {name}")
        config = _planned(name, space, inputs, progress)
        rays_per_step = field_of(config).rays_per_step(config)
        if VARIANTS[name].family == "published":
            reduced = _planned(REDUCED, space, inputs, progress)
            rays = speeds[REDUCED].rays * _multiplications(reduced) / _multiplications(config)
            if LONGEST_RUN * seconds * rays < VARIANTS[name].min_steps * rays_per_step:
                speeds[name] = Speed(rays / rays_per_step, rays)
                continue
        rays = rays_per_second(config, scene, decisions)
        speeds[name] = Speed(rays / rays_per_step, rays)
    return speeds


def _planned(name: str, space: Space, inputs: Inputs, progress: Progress) -> train.Config:
    """What stage train makes of a variant; nothing is left for it to choose by time."""
    asked = train.Config(steps=1, downscale=1.0, **train_options(name, space))  # type: ignore[arg-type]
    return plan_stage(train.STAGE, asked, inputs, _NoNotes(progress))


def _multiplications(config: train.Config) -> float:
    """Of a ray through both networks of a vanilla NeRF, about."""
    sizes = config.vanilla
    assert sizes.samples_coarse and sizes.samples_fine and sizes.depth and sizes.width
    return (2 * sizes.samples_coarse + sizes.samples_fine) * sizes.depth * sizes.width**2


def measure_reading(scene: Scene, ingest: Path) -> ReadingTime:
    """What reading the photos takes, from the time of one of them: all on all cores, the test photos one by one."""

    def pixels(views: Sequence[View]) -> int:
        return sum(scene.cameras[view.camera].width * scene.cameras[view.camera].height for view in views)

    test, started = scene.of_split("test"), 0.0
    for view in (test[-1], test[0]):  # the first one pays for imports
        started = time.perf_counter()
        load_view(ingest, view, *scaled_size(scene.cameras[view.camera], 2.0))
    per_pixel = (time.perf_counter() - started) / pixels(test[:1])
    return ReadingTime(per_pixel * pixels(scene.views) / processors(), per_pixel * pixels(test))


def study_sizes(scene: Scene, speeds: Mapping[str, Speed], seconds: float) -> tuple[float, ...]:
    """The photo sizes of a study of ``seconds``, see :func:`photo_sizes`."""
    smallest = chosen_downscale(scene, rays=1.0)  # as small as photos are ever made
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    longer_side = median(max(camera.width, camera.height) for camera in cameras)
    return photo_sizes(chosen_downscale(scene, LONGEST_RUN * seconds * speeds["grid"].rays), smallest, longer_side)


def photo_sizes(chosen: float, largest: float, longer_side: float) -> tuple[float, ...]:
    """The downscales of a study, the finest first: half of the one ``chosen`` for its longest run, so that finer photos
    have their chance, twice and four times that, whole numbers; none beyond ``largest``, none nearly another. Then that
    for the vanilla NeRF: it leaves at most SMALL_SIDE of ``longer_side`` pixels."""
    most = max(1, int(largest))
    sizes = [float(min(max(1, round(chosen / 2)) * factor, most)) for factor in (1, 2, 4)]
    kept = [size for index, size in enumerate(sizes) if index == 0 or size > 1.25 * sizes[index - 1]]
    return (*kept, float(max(1, math.ceil(longer_side / SMALL_SIDE))))
