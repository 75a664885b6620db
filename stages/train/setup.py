"""From settings and photos to a training run that is ready for its first step, or its next one after a kill."""

import math
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stages.amounts import short_count
from stages.contract import Inputs, Progress
from stages.hardware.device import compute_device

if TYPE_CHECKING:
    from nerf.effects import ImageEffects
    from nerf.fields.hash_grid import HashGridSettings
    from nerf.fields.vanilla import VanillaSettings
    from nerf.geometry.scene import Scene
    from nerf.training.hash_grid_trainer import HashGridTrainerSettings
    from nerf.training.ray_dataset import RayDataset
    from nerf.training.trainer import FieldTrainer
    from nerf.training.vanilla_trainer import VanillaTrainerSettings
    from stages.train import Config
    from stages.train.loop import TrainingRun
    from stages.train.state import TrainingBudget

LR_FINAL_FRACTION = 0.1  # of the paper field's learning rate at the start
# Weight of the distortion loss (Barron et al. 2022, who take 1e-2) in folded space, against fog and matter close before
# the cameras; fog also costs most of the time (docs/experiments/distortion_loss.md). A box around an object needs none.
DISTORTION = 2e-3
# Weight at first of the loss at sparse points (docs/experiments/sparse_depth.md; Deng et al. 2022 take 0.1, too, of
# another loss).
DEPTH_LOSS = 0.1
# Photos that must look into a cell for something to stand before their foregrounds (docs/experiments/few_photos.md).
LEAST_PHOTOS = 3
# Cells along an axis of the coarsest grid: fewer where they have to fill all of folded space
# (docs/experiments/few_photos.md).
COARSEST = {"bounded": 16, "contracted": 8}
# Samples along a ray (docs/experiments/ray_samples.md).
MOST_STEPS = 576  # bounded scenes: steps along the diagonal of the box
# Folded space: steps in one of the finest cells, by how many of these along an axis it counts for at most. Finer cells
# gain more by more rays than by closer samples (docs/experiments/cell_sizes.md).
STEPS_PER_CELL = {512: 3, 2048: 1.5}
EVEN_UNTIL = 0.25  # folded space: scene units from the camera up to which steps are even; beyond, they grow
# Folded space: at the shortest steps so many samples reach to a distance of 23; --train.ray-samples may ask for more.
MOST_SAMPLES = 1024
TABLE_COPIES = 6  # of the grids' features: themselves, their gradient, Adam's two moments, and twice in a checkpoint
SAMPLE_BYTES = 4096  # that a sample of a grid field's step takes while it is computed
ACTIVATIONS_PER_LAYER = 2  # numbers kept of each unit of the paper field for its gradient
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def prepare(config: "Config", scene: "Scene", inputs: Inputs, folder: Path, progress: Progress) -> "TrainingRun":
    """Load the photos and put everything in place for the first step, or the next after a kill."""
    import torch

    from nerf.training.validation_probe import make_probe
    from stages.effects.decisions import image_effects, read_decisions
    from stages.train.data import guided_dataset
    from stages.train.log import TrainingLog
    from stages.train.loop import TrainingRun
    from stages.train.more import budget_of
    from stages.train.state import Probes
    from stages.train.validation_images import PROBE_RAYS, PROBE_SEED, Target, unseen_photos

    assert config.downscale is not None, "plan() chooses it"
    device = compute_device()
    if device == "cpu":
        check_field_fits(config)
    progress.update("reading the photos")
    dataset = guided_dataset(inputs, scene, config.downscale, progress).to(device)
    shown_over = torch.tensor(field_background(config, scene), device=device)

    probes = Probes(
        make_probe(dataset, PROBE_RAYS, shown_over, PROBE_SEED),
        unseen_photos(config, inputs["ingest"], scene, "test", device, progress),
    )
    if config.target_psnr is not None:
        aside = unseen_photos(config, inputs["ingest"], scene, "validation", device, progress)
        assert aside is not None, "stage train sets some aside"
        probes = probes._replace(target=Target(config.target_psnr, aside))
    budget = budget_of(config, inputs)
    _say_sizes(config, budget, dataset, progress)
    decisions, views = read_decisions(inputs["effects"]), scene.of_split("train")
    return TrainingRun(
        lambda attempt: make_trainer(
            config, scene, dataset, config.seed + attempt, image_effects(decisions, views, dataset)
        ),
        probes,
        budget,
        folder,
        config.checkpoint_seconds,
        TrainingLog(folder, config.tensorboard),
        progress,
    )


def field_bytes(config: "Config", workers: int) -> float:
    """Memory on the CPU that training a field takes beside the photos, so many chunks of work at a time."""
    if config.field == "grid":
        settings = grid_settings(config, sky=False)  # which is small beside the rest
        assert config.batch_samples
        return (
            TABLE_COPIES * 4 * settings.features_per_level * settings.layout.rows + SAMPLE_BYTES * config.batch_samples
        )
    from nerf.training.vanilla_trainer import CHUNK_RAYS

    sizes = paper_settings(config)
    assert config.batch_rays
    rays = min(CHUNK_RAYS["cpu"], config.batch_rays)
    samples = rays * (2 * sizes.samples_coarse + sizes.samples_fine)
    return workers * ACTIVATIONS_PER_LAYER * 4 * samples * sizes.width * sizes.depth


def check_field_fits(config: "Config") -> None:
    """Raises StageError where training this field would take more memory than there is."""
    from stages.hardware.device import cores
    from stages.hardware.memory import check_memory

    if config.field == "grid":
        why, hint = (
            f"{config.levels} grids of up to 2^{config.log2_rows} rows take",
            "Give a smaller --train.log2-rows.",
        )
    else:
        why = f"{config.depth} × {config.width} networks on {cores()} cores at a time take"
        hint = "Give a smaller --train.width, --train.batch-rays or --train.samples-fine, or fewer cores (taskset)."
    check_memory(field_bytes(config, cores()), "the field", why, hint)


def make_trainer(
    config: "Config",
    scene: "Scene",
    dataset: "RayDataset",
    seed: int,
    effects: "ImageEffects | None" = None,
) -> "FieldTrainer":
    """A fresh field of the kind that ``config`` asks for, with its trainer, where ``dataset`` is. ``effects`` stand
    between it and the photos; None: none does."""
    from nerf.effects import NO_EFFECTS

    effects = effects or NO_EFFECTS
    if config.field == "grid":
        from nerf.fields.hash_grid import HashGridField
        from nerf.training.hash_grid_trainer import HashGridTrainer
        from stages.hardware.backend import load_backend

        assert config.backend, "plan() chooses it"
        backend = load_backend(config.backend, dataset.device.type)
        model = HashGridField(grid_settings(config, has_sky(config, scene)), seed, backend).to(dataset.device)
        return HashGridTrainer(model, dataset, grid_trainer_settings(config, scene, seed), effects)
    from nerf.fields.vanilla import VanillaNerf
    from nerf.training.vanilla_trainer import VanillaTrainer

    published = VanillaNerf(paper_settings(config), seed).to(dataset.device)
    return VanillaTrainer(published, dataset, paper_trainer_settings(config, scene, seed), effects)


def _say_sizes(config: "Config", budget: "TrainingBudget", dataset: "RayDataset", progress: Progress) -> None:
    much = f"{budget.seconds:g} s" if budget.steps is None else f"{budget.steps:,} steps"
    another = "" if budget.after is None else "another "
    photos = f"{len(dataset.near)} photos at 1/{config.downscale:g} of their size"
    grid = config.field == "grid"
    grids = f"{config.levels} grids of up to 2^{config.log2_rows} rows, to {config.finest}³"
    sizes = grids if grid else f"{config.depth} × {config.width}"
    progress.note(
        f"{config.field} field ({sizes}), {another}{much} · {photos}, {short_count(len(dataset.pixels))} pixels"
    )
    if grid:
        progress.note(_step_words(config))


def _step_words(config: "Config") -> str:
    """Of the grid field: how a step is divided and what computes it, and where samples stand along a ray."""
    stepping = grid_settings(config, sky=False).stepping
    growing = (
        f", from {stepping.linear_until:g} on every {stepping.cone_angle:.1%} of the distance"
        if stepping.cone_angle
        else ""
    )
    parts = f"{config.chunks} part{'' if config.chunks == 1 else 's'}"
    step = f"{config.batch_samples:,} colours a step in {parts}, by {config.backend}"
    return f"{step} · samples every {stepping.step_size:.2g} scene units{growing}"


def has_sky(config: "Config", scene: "Scene") -> bool:
    """Whether something is seen at infinity: where space has no end, and no alpha tells what is seen of it."""
    return bool(config.contracted) and not scene.has_alpha


def grid_settings(config: "Config", sky: bool) -> "HashGridSettings":
    """Sizes of the grid field. Samples stand as close as the finest cells can tell them apart: in folded space a third
    to two thirds of a cell near the camera, growing with the distance, as pixels do; in a box a cell, or MOST_STEPS in
    all."""
    from nerf.fields.hash_grid import HashGridSettings
    from nerf.kernels import CONTRACTED_BOX

    assert config.levels and config.log2_rows and config.finest, "plan() chooses them"
    assert config.contracted is not None and config.view_dependence is not None, "plan() takes them from stage effects"
    shortest = 2 * CONTRACTED_BOX / (_steps_across(config.finest) * config.ray_samples)
    return HashGridSettings(
        num_levels=config.levels,
        log2_hashmap_size=config.log2_rows,
        base_res=min(COARSEST[config.space], config.finest),
        max_res=config.finest,
        contracted=config.contracted,
        diagonal_steps=max(1, round(config.ray_samples * min(math.sqrt(3) * config.finest, MOST_STEPS))),
        min_step_size=shortest,
        cone_angle=shortest / EVEN_UNTIL,
        max_samples_per_ray=math.ceil(MOST_SAMPLES * max(1.0, config.ray_samples)),
        view_dependence=config.view_dependence,
        background_model=sky,
    )


def _steps_across(finest: int) -> float:
    """The shortest steps that fit along an axis of folded space whose finest cells are so many."""
    return max(per_cell * min(finest, most) for most, per_cell in STEPS_PER_CELL.items())


def grid_trainer_settings(config: "Config", scene: "Scene", seed: int) -> "HashGridTrainerSettings":
    """How the grid field is trained."""
    from nerf.training.hash_grid_trainer import HashGridTrainerSettings

    assert config.batch_samples and config.chunks and config.learning_rate, "plan() chooses them"
    return HashGridTrainerSettings(
        seed=seed,
        background=_trained_over(config, scene),
        samples=config.batch_samples,
        chunks=config.chunks,
        rate=config.learning_rate,
        distortion=DISTORTION if config.contracted else 0.0,
        depth_loss=DEPTH_LOSS,
        least_photos=LEAST_PHOTOS,
    )


def paper_settings(config: "Config") -> "VanillaSettings":
    """Sizes and ablations of the paper field."""
    from nerf.fields.vanilla import VanillaSettings

    return VanillaSettings(**{part.name: getattr(config, part.name) for part in fields(VanillaSettings)})


def paper_trainer_settings(config: "Config", scene: "Scene", seed: int) -> "VanillaTrainerSettings":
    """How the paper field is trained."""
    from nerf.training.vanilla_trainer import VanillaTrainerSettings

    assert config.batch_rays is not None and config.learning_rate is not None, "plan() chooses them"
    rates = (config.learning_rate, config.learning_rate * LR_FINAL_FRACTION)
    return VanillaTrainerSettings(config.batch_rays, seed, _trained_over(config, scene), *rates)


def _trained_over(config: "Config", scene: "Scene") -> tuple[float, float, float] | Literal["random"]:
    """What lies behind the scene while training; random only where alpha says how much of it is seen."""
    return "random" if scene.has_alpha and config.background == "random" else field_background(config, scene)


def field_background(config: "Config", scene: "Scene") -> tuple[float, float, float]:
    """What the finished field is shown over, unless it has a sky. Photos without alpha fill every ray; what a field
    without one leaves open is black, as published."""
    return WHITE if scene.has_alpha and config.background != "black" else BLACK
