"""One training as a stage: photos and settings are loaded, steps taken, the field saved with what came of them.

Where several processes (ranks) train together, rank 0 does all that, and :func:`follow` is what the others do.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

from nerf.geometry.scene import Scene
from nerf.runtime.matmul_precision import use_matmul_precision
from nerf.runtime.ranks import RankLost, Ranks
from nerf.training.data_parallel import LeadingTrainer, end_others, follow_first_rank
from nerf.training.evaluation_pixels import sample_evaluation_pixels
from nerf.training.graph_trainer import GraphTrainer
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import FieldTrainer
from stages.contract import Inputs, Progress, SilentProgress, StageError, StageResult
from stages.effects.decisions import read_decisions
from stages.effects.image_effects import image_effects, learnt_effects
from stages.hardware.device import compute_device
from stages.hardware.memory import check_memory
from stages.hardware.ranks import check_ranks, leading, rank_count, tasks_of_first_rank
from stages.io.amounts import counted, duration, short_count
from stages.io.field_files import save_field
from stages.io.files import read_scene
from stages.train.checkpoints import checkpoint_files
from stages.train.config import Config
from stages.train.continuation import budget_of, earlier_seconds
from stages.train.curve import (
    doubling_message,
    predicted_gain,
    predicted_gain_message,
    sparkline,
    target_message,
    write_curve,
)
from stages.train.data import dataset_with_depths, field_background
from stages.train.fields.field_list import field_of, make_trainer
from stages.train.live import LiveFolder
from stages.train.loop import TrainingRun
from stages.train.precision import precision_facts, say_if_inexact
from stages.train.profile import write_profile
from stages.train.state import EvaluationSets, TrainingBudget, TrainingLog
from stages.train.validation_images import (
    EVALUATION_PIXELS,
    EVALUATION_SEED,
    Target,
    held_out_evaluation,
    with_validation_split,
)
from stages.viewer.live import LiveContents

LACKS_MEMORY = (
    "the GPU's memory has no place for CUDA graphs of the steps, which make them up to twice as fast; try a smaller "
    "--train.grid.target-samples"
)


class Training(NamedTuple):
    """A run that is ready for its next step. ``earlier_seconds``: wall time of the trainings that it continues;
    ``scene`` has the validation photos that a target needs."""

    config: Config
    scene: Scene
    run: TrainingRun
    earlier_seconds: float


@contextmanager
def ranks_of(config: Config, inputs: Inputs) -> Iterator[Ranks | None]:
    """The processes that train together, this one first; None where it trains alone. Raises StageError where one of
    them is gone."""
    if rank_count(config.devices) == 1:
        yield None
        return
    if config.kind != "grid":
        why = "only the hash-grid field supports data-parallel training"
        raise StageError(
            "train.one-device", f"the {config.kind} field trains on one device", why, "Leave out torchrun."
        )
    assert config.grid.micro_batches, "plan() chooses it"
    check_ranks(config.devices, config.grid.micro_batches)
    folders = {name: str(path.resolve()) for name, path in inputs.items()}
    with leading(config.devices, {"config": config.model_dump(mode="json"), "inputs": folders}) as ranks:
        yield ranks
        with suppress(RankLost):  # which matters no longer
            end_others(ranks)


def follow() -> None:
    """Be one of the other ranks: train with rank 0 whenever it asks for it, until it ends."""
    for task, ranks in tasks_of_first_rank():
        config = Config.model_validate(task["config"])
        trainers = _trainers_later(config, {name: Path(folder) for name, folder in task["inputs"].items()})
        with use_matmul_precision(config.matmul):
            follow_first_rank(ranks, lambda attempt, trainers=trainers: _hash_grid(trainers()(attempt)))


def _trainers_later(config: Config, inputs: Inputs) -> Callable[[], Callable[[int], FieldTrainer]]:
    """Reads the photos at the first call, which comes when rank 0 has its trainer and so has filled the pixel store."""
    scene = read_scene(inputs["normalise"])
    if config.target_psnr is not None:
        scene = with_validation_split(scene)

    @cache
    def trainers() -> Callable[[int], FieldTrainer]:
        return _trainers(config, scene, inputs, _dataset(config, scene, inputs, SilentProgress()))

    return trainers


def load(config: Config, inputs: Inputs, folder: Path, progress: Progress, ranks: Ranks | None = None) -> Training:
    """Load the photos and put everything in place. Nothing is open in ``config``."""
    scene, earlier = read_scene(inputs["normalise"]), earlier_seconds(config, inputs)
    if config.target_psnr is not None:
        scene = _with_validation_photos(config.target_psnr, scene, progress)
    run = prepare(config, scene, inputs, folder, progress, ranks)
    contents = LiveContents(inputs["normalise"])
    run.live = LiveFolder(
        folder, lambda shown: contents.save(shown, run.trainer.model, _field_info(config, scene, run))
    )
    say_if_inexact(config, progress)
    return Training(config, scene, run, earlier)


def _with_validation_photos(target_psnr: float, scene: Scene, progress: Progress) -> Scene:
    scene = with_validation_split(scene)
    validation, left = len(scene.of_split("validation")), len(scene.of_split("train"))
    progress.note(
        "train.validation-photos",
        f"{validation} of {validation + left} training photos become validation photos, "
        f"to detect when {target_psnr:g} dB are reached",
    )
    return scene


def prepare(
    config: Config, scene: Scene, inputs: Inputs, folder: Path, progress: Progress, ranks: Ranks | None = None
) -> TrainingRun:
    """Photos, evaluation pixels, budget and trainer of a run. Raises StageError if the field takes too much memory."""
    device = compute_device()
    if device == "cpu":
        field = field_of(config)
        check_memory(field.memory_bytes(config), "the field", *field.memory_advice(config))
    progress.update("reading the photos")
    dataset = _dataset(config, scene, inputs, progress)
    if dataset.depth_maps is not None:
        known = float((dataset.depth_maps.distance > 0).float().mean())
        progress.note("train.depth-maps", f"depth maps cover {known:.0%} of the pixels")
    background = torch.tensor(field_background(config, scene), device=device)

    evaluation_sets = EvaluationSets(
        sample_evaluation_pixels(dataset, EVALUATION_PIXELS, background, EVALUATION_SEED),
        held_out_evaluation(config, inputs["ingest"], scene, "test", device, progress),
    )
    if config.target_psnr is not None:
        validation = held_out_evaluation(config, inputs["ingest"], scene, "validation", device, progress)
        assert validation is not None, "load() makes some"
        evaluation_sets = evaluation_sets._replace(target=Target(config.target_psnr, validation))
    budget = budget_of(config, inputs)
    _note_sizes(config, budget, dataset, progress)
    make = _trainers(config, scene, inputs, dataset)
    if ranks is not None:
        progress.note("train.ranks", ranks_message(ranks, config))
    return TrainingRun(
        make if ranks is None else lambda attempt: LeadingTrainer(_hash_grid(make(attempt)), attempt, ranks),
        evaluation_sets,
        budget,
        folder,
        config.checkpoint_seconds,
        TrainingLog(folder, config.tensorboard),
        progress,
    )


def _dataset(config: Config, scene: Scene, inputs: Inputs, progress: Progress) -> RayDataset:
    """The training photos, on the device that trains."""
    assert config.downscale is not None, "plan() chooses it"
    depth = inputs["depth"] if config.depth else None
    return dataset_with_depths(inputs, scene, config.downscale, progress, depth).to(compute_device())


def _trainers(config: Config, scene: Scene, inputs: Inputs, dataset: RayDataset) -> Callable[[int], FieldTrainer]:
    """Makes a fresh trainer for each attempt: every rank the same."""
    decisions, views = read_decisions(inputs["effects"]), scene.of_split("train")
    return lambda attempt: make_trainer(
        config, scene, dataset, config.seed + attempt, image_effects(decisions, scene, views, dataset)
    )


def _hash_grid(trainer: FieldTrainer) -> HashGridTrainer:
    """The trainer whose steps ranks share."""
    if isinstance(trainer, GraphTrainer):
        return trainer.trainer
    assert isinstance(trainer, HashGridTrainer), "ranks_of() lets no other field pass"
    return trainer


def ranks_message(ranks: Ranks, config: Config) -> str:
    """Who computes a step."""
    return f"{ranks.size} processes share the {config.grid.micro_batches} micro-batches of a step, over {ranks.backend}"


def _note_sizes(config: Config, budget: TrainingBudget, dataset: RayDataset, progress: Progress) -> None:
    amount = f"{budget.seconds:g} s" if budget.steps is None else counted(budget.steps, "step")
    another = "" if budget.after is None else "another "
    photos = f"{counted(len(dataset.near))} at 1/{config.downscale:g} of their size"
    field = field_of(config)
    sizes = f"{config.field} field ({field.sizes_in_words(config)})"
    progress.note("train.sizes", f"{sizes}, {another}{amount} · {photos}, {short_count(len(dataset.pixels))} pixels")
    if message := field.step_in_words(config):
        progress.note("train.step", message)


def compute(training: Training) -> None:
    """Take the steps of the budget, at the precision that was chosen."""
    with use_matmul_precision(training.config.matmul):
        training.run.train()


def save(training: Training, folder: Path, progress: Progress) -> StageResult:
    """Write the field with the record of how it came about."""
    config, scene, run, _ = training
    assert config.downscale is not None, "plan() chooses it"
    save_field(folder, run.trainer.model, _field_info(config, scene, run))
    write_curve(folder, config.kind, config.downscale, run.schedule.is_single_cycle, run.state.curve)
    progress.update("measuring what this machine can do")
    with use_matmul_precision(config.matmul):
        profile = write_profile(folder, run.state.timings, config, run.evaluation_sets.train.colours.device)
    for message in _closing_notes(training):
        progress.note("train.outlook", message)
    batches = sorted(path.name for path in folder.glob("nonfinite_*.safetensors"))
    tensorboard = ["tensorboard"] if config.tensorboard else []
    final = checkpoint_files(run.checkpoints, run.state.step)
    records = ("curve.json", "log.jsonl", "schedule.json", *profile, *final, *batches, *tensorboard)
    return StageResult(("field.safetensors", "field.json"), _summary(training), records, _facts(training))


def _field_info(config: Config, scene: Scene, run: TrainingRun) -> dict[str, Any]:
    """What field.json says beside the field itself."""
    return {
        "downscale": config.downscale,
        "steps": run.state.step,
        "rays": run.state.rays,
        "background": list(field_background(config, scene)),
        "effects": learnt_effects(run.trainer.effects, scene.of_split("train")),
    }


def _closing_notes(training: Training) -> list[str]:
    """The gain of the last doubling of the time, the predicted gain of the next, and whether a target is reached."""
    state, config = training.run.state, training.config
    gain = predicted_gain(config.kind, training.run.schedule.is_single_cycle, state.curve)
    doubling = doubling_message(state.curve, gain)
    target = target_message(state.pending_target(config.target_psnr), state.validation_psnr, state.seconds)
    trainer = training.run.trainer
    memory = isinstance(trainer, GraphTrainer) and trainer.lacks_memory and LACKS_MEMORY
    return [message for message in (doubling, target, memory) if message]


def _facts(training: Training) -> dict[str, object]:
    config, run, state = training.config, training.run, training.run.state
    last = state.curve[-1]
    return {
        "field": config.field,
        "steps": state.step,
        "train_seconds": round(state.seconds, 3),
        "earlier_seconds": round(training.earlier_seconds, 3),
        "rays_per_second": round(state.rays / state.seconds, 1),
        "colours_per_second": round(state.colour_evaluations / state.seconds, 1),
        "train_psnr": last["train_psnr"],
        "probe_psnr": last["probe_psnr"],
        "validation_psnr": state.validation_psnr,
        "curve": state.curve[-5:],
        "downscale": config.downscale,
        "restarts": state.restarts,
        "rollbacks": state.rollbacks,
        "failure_reason": state.failure_reason,
        **precision_facts(config),
        **_rank_facts(training.run),
        **({"refused_steps": run.trainer.refused} if isinstance(run.trainer, GraphTrainer) else {}),
    }


def _rank_facts(run: TrainingRun) -> dict[str, object]:
    """What several ranks brought each other since the last resume; nothing where one process trained."""
    trainer = run.trainer
    if not isinstance(trainer, LeadingTrainer):
        return {}
    ranks, exchange = trainer.ranks, trainer.exchange
    reduction = "dense" if exchange.is_dense else "sparse"
    return {
        "ranks": {"size": ranks.size, "backend": ranks.backend, "table_gradient": reduction},
        "received_bytes_per_step": round(ranks.received_bytes / max(1, exchange.steps)),
        "exchange_share": round(trainer.waited_seconds / trainer.seconds, 3) if trainer.seconds else None,
    }


def _summary(training: Training) -> str:
    """3 min · 5.4 k steps · 24 k rays/s · 28.9 dB on test pixels, over time ▁▃▅▆▇█ · as long again (--more 3m) is
    predicted to gain +0.6 ± 0.4 dB."""
    config, state = training.config, training.run.state
    probe = state.curve[-1]["probe_psnr"]
    before = "" if config.after is None else f", {duration(state.seconds_before)} of them in the earlier training"
    parts: list[str | None] = [f"{duration(state.seconds)}{before}"]
    parts += [f"{short_count(state.step)} steps", f"{short_count(state.rays / state.seconds)} rays/s"]
    spark = sparkline(state.curve)
    rising = f", over time {spark}" if spark else ""
    parts.append("no test photos" if probe is None else f"{probe:.1f} dB on test pixels{rising}")
    gain = predicted_gain(config.kind, training.run.schedule.is_single_cycle, state.curve)
    parts.append(predicted_gain_message(state.curve, gain))
    parts.append(target_message(state.pending_target(config.target_psnr), state.validation_psnr, state.seconds))
    if state.failure_reason is not None:
        parts.append(f"undertrained: {state.failure_reason}")
    return " · ".join(filter(None, parts))
