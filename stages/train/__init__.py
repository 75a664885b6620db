"""Stage train: photos and cameras become a radiance field."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator
from tyro.conf import Suppress, arg

from stages.amounts import short_count
from stages.contract import (
    Flexible,
    Inputs,
    Progress,
    StageConfig,
    StageResult,
    Workload,
)
from stages.effects.decisions import Space, read_decisions
from stages.io.files import read_scene
from stages.io.photos import read_photos

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from stages.train.loop import TrainingRun

INPUTS = ("ingest", "normalise", "effects")
VERSION = 24
EXIT_CODE = 14
RESUMES = True
PUBLISHED = ("curve.json",)
NOT_HASHED = ("checkpoint_seconds", "tensorboard")

# Its own seconds count steps alone. Beside reading the photos, timing the first steps takes about STARTING_SECONDS,
# validation and checkpoints 1.5 to 2 % (fox, fountain_p11 and sceaux_castle, three minutes each).
STARTING_SECONDS, OVERHEAD = 4.0, 0.02


def step_seconds(wall: float, reading: float) -> float:
    """Seconds of training steps in a stage that takes ``wall`` seconds in all, at least half of these, and ``reading``
    of them to read the photos."""
    return max(wall / 2, (wall - STARTING_SECONDS - reading) / (1 + OVERHEAD))


# A user waits for the field, so it gets most of what is left; figures, a video and a mesh are there to see it by. A
# training of less than half a minute is worth none.
FLEXIBLE = Flexible(share=0.68, min_seconds=30.0, max_share=1.0, reads_photos=True, work=step_seconds)

# Of training, where neither seconds nor steps are given.
SECONDS = {"draft": 30.0, "standard": 180.0, "high": 900.0, "paper": 3600.0}
# The small field has few steps and takes large ones: after 300 of 512 rays on lego_400 at a quarter of its size a
# start at 5e-4 gave 14.7 dB held out, 2e-3 17.4, 5e-3 19.1. The paper's are those of its released lego config.
PAPER_SIZES = {
    "small": {
        "depth": 4,
        "width": 64,
        "skip": 4,
        "samples_coarse": 32,
        "samples_fine": 32,
        "batch_rays": 512,
        "learning_rate": 5e-3,
    },
    "published": {
        "depth": 8,
        "width": 256,
        "skip": 4,
        "samples_coarse": 64,
        "samples_fine": 128,
        "batch_rays": 1024,
        "learning_rate": 5e-4,
    },
}


# Of the grid field at first; both fall while training. Where space is folded a cell is met from farther away, and rays
# are longer.
GRID_RATES = {"bounded": 2e-2, "contracted": 1e-2}
MOST_PARTS = 64  # of a step
# Colours that each part of a step computes, so each core: half of what a part takes does not depend on how many they
# are, and fewer cost as long. In a box more of them go with its closer samples (docs/experiments/colour_samples.md).
PART_SAMPLES = {"bounded": 3 << 13, "contracted": 1 << 14}
# The largest step, which a GPU takes as fast as a small one. Its gradients are sure enough for the larger rate
# (docs/experiments/colour_samples.md).
LARGEST_STEP, LARGE_STEP_RATE = 1 << 18, 2e-2

GRID_ONLY = ("backend", "chunks", "levels", "log2_rows", "finest", "batch_samples", "ray_samples")
PAPER_ONLY = (
    *("batch_rays", "depth", "width", "skip", "position_frequencies", "direction_frequencies"),
    *("samples_coarse", "samples_fine", "positional_encoding", "hierarchical"),
    *("density_activation", "spacing"),
)


class Config(StageConfig):
    """How to train. None is chosen for you, by the scene and the budget.

    The options of the paper field ask for that field: without one of them, none is the grid field.
    """

    field: Literal["grid", "paper"] | None = Field(
        default=None, description="grid: minutes without a GPU; paper: the published networks; none: grid"
    )
    steps: int | None = Field(
        default=None, ge=1, description="train so many steps; on a CPU with the same result every time"
    )
    preset: Literal["draft", "standard", "high", "paper"] | None = Field(
        default=None,
        description="draft, standard, high: train for half a minute, three, fifteen, in sizes to match; "
        "paper: the networks as published, for an hour; none: standard",
    )
    seconds: float | None = Field(default=None, gt=0, description="train so long; none, without steps: by the preset")
    target_psnr: Annotated[float | None, arg(aliases=("--target-psnr",))] = Field(
        default=None,
        gt=0,
        le=100,
        description="stop once so many dB are reached on photos set aside from the training photos; at the latest "
        "when the time or the steps are used up",
    )
    learning_rate: float | None = Field(default=None, gt=0, description="at the start; none: by the field")
    seed: int = Field(default=0, description="of weights, batches and samples")
    downscale: float | None = Field(
        default=None, ge=1, description="photo width / trained width; none: as the budget allows"
    )
    background: Literal["white", "black", "random"] | None = Field(
        default=None, description="behind photos with transparency; none: random for grid, white for paper"
    )
    matmul: Literal["highest", "medium"] | None = Field(
        default=None,
        description="torch's precision of matrix products; none: highest, of a run in seconds medium where that is "
        "measured to be faster and about as exact",
    )
    # `--more` gives these.
    after: Annotated[str | None, Suppress] = Field(default=None, description="go on from this finished training,")
    more_steps: Annotated[int | None, Suppress] = Field(default=None, ge=1, description="for so many steps,")
    more_seconds: Annotated[float | None, Suppress] = Field(default=None, gt=0, description="or for so long")
    # Stage effects decides these; no flag is offered for them.
    contracted: Annotated[bool | None, Suppress] = Field(default=None, description="fold in unbounded space")
    view_dependence: Annotated[bool | None, Suppress] = Field(default=None, description="colour knows the direction")

    backend: Literal["warp", "torch"] | None = Field(
        default=None, description="grid: its kernels; none: warp where they run, torch runs anywhere"
    )
    chunks: int | None = Field(
        default=None, ge=1, le=MOST_PARTS, description="grid: parts of a step, each on a core; none: as many as cores"
    )
    levels: int | None = Field(default=None, ge=1, le=16, description="grid: grids of features")
    log2_rows: int | None = Field(default=None, ge=8, le=24, description="grid: rows of a grid's table, as power of 2")
    finest: int | None = Field(default=None, ge=16, le=4096, description="grid: cells along an axis of the finest grid")
    batch_samples: int | None = Field(default=None, ge=256, description="grid: colours computed in a step")
    ray_samples: float = Field(
        default=1.0, gt=0, le=16, description="grid: samples along a ray, times what suits its finest cells"
    )

    batch_rays: int | None = Field(default=None, ge=1, description="paper: rays in a step; none: by the preset")
    depth: int | None = Field(default=None, ge=1, description="paper: layers before the density")
    width: int | None = Field(default=None, ge=2, description="paper: of each layer")
    skip: int | None = Field(
        default=None, ge=0, description="paper: index of the layer after which the position enters again"
    )
    position_frequencies: int = Field(
        default=10, ge=1, description="paper: L of the positional encoding of the position"
    )
    direction_frequencies: int = Field(
        default=4, ge=1, description="paper: L of the positional encoding of the direction"
    )
    samples_coarse: int | None = Field(default=None, ge=2, description="paper: on each ray, for the coarse network")
    samples_fine: int | None = Field(
        default=None, ge=1, description="paper: on each ray, placed by the coarse network's weights"
    )
    positional_encoding: bool = Field(default=True, description="paper: lift coordinates to sines and cosines")
    hierarchical: bool = Field(default=True, description="paper: place fine samples by a coarse network")
    density_activation: Literal["softplus", "relu"] = Field(
        default="softplus", description="paper: relu is as published"
    )
    spacing: Literal["linear", "log"] | None = Field(
        default=None, description="paper: of coarse samples; none: log if contracted"
    )

    checkpoint_seconds: float | None = Field(
        default=None, gt=0, description="between checkpoints; none: a twentieth of the seconds, 30 at most"
    )
    tensorboard: bool = Field(default=False, description="write the curve for TensorBoard, too")

    @model_validator(mode="after")
    def _one_budget(self) -> "Config":
        if self.steps is not None and self.seconds is not None:
            raise ValueError(f"steps ({self.steps}) and seconds ({self.seconds:g}) are two budgets; give one")
        return self

    @model_validator(mode="after")
    def _one_field(self) -> "Config":
        of_grid, of_paper = self._given(GRID_ONLY), self._given(PAPER_ONLY)
        if self.preset == "paper":
            of_paper.insert(0, "preset (paper)")
        if of_grid and of_paper:
            raise ValueError(f"{of_grid[0]} belongs to the grid field and {of_paper[0]} to the paper field; choose one")
        if wrong := {"grid": of_paper, "paper": of_grid, None: []}[self.field]:
            raise ValueError(f"{wrong[0]} does not belong to the {self.field} field; leave out one of the two")
        return self

    @property
    def time_is_open(self) -> bool:
        """Whether neither seconds nor steps are given, nor those of ``--more``."""
        return self.seconds is None and self.steps is None and self.after is None

    @property
    def exempt_from_budget(self) -> bool:
        """A training that goes on (``--more``) has a time of its own."""
        return self.after is not None

    @property
    def planned_seconds(self) -> float | None:
        """Of a training from the beginning: those asked for, or the preset's; None where it counts steps."""
        return None if self.steps is not None else self.seconds or SECONDS[self.preset or "standard"]

    @property
    def kind(self) -> Literal["grid", "paper"]:
        """The field that these options ask for."""
        return self.field or ("paper" if self.preset == "paper" or self._given(PAPER_ONLY) else "grid")

    @property
    def space(self) -> Space:
        """Which of the measured constants count."""
        return "contracted" if self.contracted else "bounded"

    def _given(self, names: tuple[str, ...]) -> list[str]:
        """Which of these options differ from their defaults, with their values."""
        values = {name: getattr(self, name) for name in names}
        return [f"{n} ({value})" for n, value in values.items() if value != type(self).model_fields[n].default]


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """The seconds of steps and what comes beside them; None where it counts steps, which nobody has timed yet."""
    seconds = config.planned_seconds if config.after is None else config.more_seconds
    return None if seconds is None else seconds + STARTING_SECONDS + workload.photos.reading_seconds(workload.cores)


def trained_seconds(workload: Workload) -> float | None:
    """Seconds of training steps behind the field that the later stages will meet, by which they give themselves time:
    those of the finished training, or those to come. None where nobody can tell."""
    if finished := workload.facts("train", None):
        return finished["train_seconds"]
    config: Config = workload.options["train"]
    if config.after is None:
        return config.planned_seconds
    before = workload.facts("train", config.after)  # without it the stage says why it cannot go on
    return before["train_seconds"] + config.more_seconds if before and config.more_seconds else None


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Everything that was left open: field and budget, what stage effects decided, then sizes and the photos' size; or
    all of it as the finished training has it that is to go on."""
    scene, decisions = read_scene(inputs["normalise"]), read_decisions(inputs["effects"])
    if config.after is not None:
        from stages.train.more import continued, larger_photos_words

        whole = continued(config, inputs)
        open_size = config.downscale is None  # what the user gave is what they want
        if open_size and (words := larger_photos_words(whole, inputs, scene, _used_shares(inputs["ingest"], scene))):
            progress.note(words)
        return whole
    preset = config.preset or "standard"
    seconds = SECONDS[preset] if config.steps is None and config.seconds is None else config.seconds
    config = config.model_copy(update={"field": config.kind, "preset": preset, "seconds": seconds})
    config = _filled(
        config, {"contracted": "background" in decisions.on, "view_dependence": "view_dependence" in decisions.on}
    )
    config = with_habits(config)
    if config.kind == "grid":
        from stages.hardware.backend import chosen_backend, load_backend
        from stages.hardware.device import compute_device

        backend = config.backend or chosen_backend(compute_device(), progress)
        load_backend(backend, compute_device(), progress)
        config = config.model_copy(update={"backend": backend})
    if config.matmul is None:
        from stages.train.precision import chosen_precision

        config = config.model_copy(update={"matmul": chosen_precision(config, progress)})
    grids_open = config.kind == "grid" and None in (config.levels, config.log2_rows, config.finest)
    if config.downscale is None or grids_open:
        from stages.train.size import chosen_downscale, grid_size, rays_in_budget, reason_words

        progress.update("trying how fast this machine trains")
        rays = rays_in_budget(config, scene, decisions)
        progress.note(reason_words(config, rays))
        if config.downscale is None:
            downscale = chosen_downscale(scene, rays, _used_shares(inputs["ingest"], scene), progress)
            config = config.model_copy(update={"downscale": downscale})
        if grids_open:
            config = _filled(config, grid_size(config, scene, rays, progress))
    return config


def _used_shares(ingest: Path, scene: "Scene") -> dict[str, float]:
    """By name, which share of its pixels a photo's mask leaves; photos that are not named have none."""
    masks = {view.file: view.mask for view in scene.views if view.mask}
    photos = [photo for photo in read_photos(ingest) if photo.file in masks] if masks else []
    cut_out = {photo.name for photo in photos if masks[photo.file] == photo.opaque_mask}
    return {photo.name: photo.opaque_share if photo.name in cut_out else photo.used_share for photo in photos}


def with_habits(config: Config) -> Config:
    """``config`` with what its field is usually trained with where it leaves that open."""
    return _filled(config, _grid_habits(config) if config.kind == "grid" else _paper_habits(config))


def _grid_habits(config: Config) -> dict[str, Any]:
    from stages.hardware.device import compute_device, cores

    gpu, parts = compute_device() == "cuda", config.chunks or min(MOST_PARTS, cores())
    samples = config.batch_samples or (LARGEST_STEP if gpu else min(LARGEST_STEP, parts * PART_SAMPLES[config.space]))
    rate = LARGE_STEP_RATE if samples >= LARGEST_STEP else GRID_RATES[config.space]
    return {"background": "random", "learning_rate": rate, "batch_samples": samples, "chunks": parts}


def _paper_habits(config: Config) -> dict[str, Any]:
    spacing = "log" if config.contracted else "linear"
    sizes = PAPER_SIZES["published" if config.preset == "paper" else "small"]
    return {"background": "white", "spacing": spacing, **sizes}


def _filled(config: Config, values: dict[str, Any]) -> Config:
    """``config`` with ``values`` where it holds None."""
    return config.model_copy(update={name: v for name, v in values.items() if getattr(config, name) is None})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Train, and write the field with the record of how it came about.

    Raises:
        StageError: if training diverges or the field does not learn, every remedy of ours having failed.
    """
    from nerf.runtime.matmul_precision import use_matmul_precision
    from stages.effects.decisions import learnt_of_photos
    from stages.io.field_files import save_field
    from stages.train.curve import write_curve
    from stages.train.more import earlier_seconds
    from stages.train.precision import say_if_inexact
    from stages.train.profile import write_parts
    from stages.train.setup import field_background, prepare

    config, scene = plan(config, inputs, progress), read_scene(inputs["normalise"])
    earlier = earlier_seconds(config, inputs)
    if config.target_psnr is not None:
        scene = _with_photos_aside(config, scene, progress)
    training = prepare(config, scene, inputs, folder, progress)
    say_if_inexact(config, progress)
    with use_matmul_precision(config.matmul):
        training.train()
    info = {"downscale": config.downscale, "steps": training.state.step, "rays": training.state.rays}
    info["background"] = list(field_background(config, scene))
    info |= learnt_of_photos(training.trainer, scene.of_split("train"))
    save_field(folder, training.trainer.model, info)
    assert config.downscale is not None, "plan() chooses it"
    write_curve(folder, config.kind, config.downscale, training.plan.is_whole, training.state.curve)
    progress.update("measuring what this machine can do")
    device = training.probes.train.colours.device
    with use_matmul_precision(config.matmul):
        parts = write_parts(folder, training.state.timings, training.trainer.model, device)
    return _result(config, training, folder, parts, earlier, progress)


def _with_photos_aside(config: Config, scene: "Scene", progress: Progress) -> "Scene":
    from stages.train.validation_images import with_validation

    scene = with_validation(scene)
    aside, left = len(scene.of_split("validation")), len(scene.of_split("train"))
    progress.note(
        f"{aside} of {aside + left} training photos are set aside to tell when {config.target_psnr:g} dB are reached"
    )
    return scene


def _result(
    config: Config, training: "TrainingRun", folder: Path, parts: list[str], earlier: float, progress: Progress
) -> StageResult:
    """``earlier``: seconds of the trainings that this one went on from."""
    from stages.train.checkpoints import checkpoint_files
    from stages.train.curve import coming_doubling, doubling_words, target_words
    from stages.train.precision import precision_facts

    state, last = training.state, training.state.curve[-1]
    doubling = doubling_words(state.curve, coming_doubling(config.kind, training.plan.is_whole, state.curve))
    target = target_words(state.open_target(config.target_psnr), state.validation_psnr, state.seconds)
    for words in filter(None, (doubling, target)):
        progress.note(words)
    left_behind = sorted(path.name for path in folder.glob("nonfinite_*.safetensors"))
    board = ["tensorboard"] if config.tensorboard else []
    facts = {
        "field": config.field,
        "steps": state.step,
        "train_seconds": round(state.seconds, 3),
        "earlier_seconds": round(earlier, 3),
        "rays_per_second": round(state.rays / state.seconds, 1),
        "samples_per_second": round(state.samples / state.seconds, 1),
        "train_psnr": last["train_psnr"],
        "heldout_psnr": last["heldout_psnr"],
        "validation_psnr": state.validation_psnr,
        "curve": state.curve[-5:],
        "downscale": config.downscale,
        "restarts": state.restarts,
        "rollbacks": state.rollbacks,
        "symptom": state.symptom,
        **precision_facts(config),
    }
    final = checkpoint_files(training.checkpoints, state.step)
    records = ("curve.json", "log.jsonl", "plan.json", *parts, *final, *left_behind, *board)
    return StageResult(("field.safetensors", "field.json"), _line(config, training), records, facts)


def _line(config: Config, training: "TrainingRun") -> str:
    """180 s · 5.4 k steps · 24 k rays/s · held out 28.9 dB, over time ▁▃▅▆▇█ · as long again (--more 3m) is predicted
    to buy +0.6 ± 0.4 dB."""
    from stages.train.curve import coming_doubling, next_words, sparkline, target_words

    state = training.state
    heldout = state.curve[-1]["heldout_psnr"]
    before = "" if config.after is None else f", {state.seconds_before:.0f} s of them before"
    parts: list[str | None] = [f"{state.seconds:.0f} s{before}"]
    parts += [f"{short_count(state.step)} steps", f"{short_count(state.rays / state.seconds)} rays/s"]
    spark = sparkline(state.curve)
    rising = f", over time {spark}" if spark else ""
    parts.append("no photos held out" if heldout is None else f"held out {heldout:.1f} dB{rising}")
    parts.append(next_words(state.curve, coming_doubling(config.kind, training.plan.is_whole, state.curve)))
    parts.append(target_words(state.open_target(config.target_psnr), state.validation_psnr, state.seconds))
    if state.symptom is not None:
        parts.append(f"of no use yet: {state.symptom}")
    return " · ".join(filter(None, parts))
