"""One training as a stage: photos and settings are loaded, steps taken, the field saved with what came of them."""

from pathlib import Path
from typing import NamedTuple

import torch

from nerf.geometry.scene import Scene
from nerf.runtime.matmul_precision import use_matmul_precision
from nerf.training.ray_dataset import RayDataset
from nerf.training.validation_probe import make_probe
from stages.amounts import short_count
from stages.contract import Inputs, Note, Progress, StageResult
from stages.effects.decisions import read_decisions
from stages.effects.image_effects import image_effects, learnt_effects
from stages.hardware.device import compute_device, cores
from stages.hardware.memory import check_memory
from stages.io.field_files import save_field
from stages.io.files import read_scene
from stages.train.checkpoints import checkpoint_files
from stages.train.config import Config
from stages.train.curve import (
    coming_doubling,
    doubling_words,
    next_words,
    sparkline,
    target_words,
    write_curve,
)
from stages.train.data import field_background, guided_dataset
from stages.train.fields import field_of, make_trainer
from stages.train.loop import TrainingRun
from stages.train.more import budget_of, earlier_seconds
from stages.train.precision import precision_facts, say_if_inexact
from stages.train.profile import write_parts
from stages.train.state import Probes, TrainingBudget, TrainingLog
from stages.train.validation_images import PROBE_RAYS, PROBE_SEED, Target, unseen_photos, with_validation


class Training(NamedTuple):
    """A run that is ready for its first step, or its next one after a kill. ``earlier``: seconds of the trainings that
    it goes on from; ``scene`` has the validation photos that a target asks for."""

    config: Config
    scene: Scene
    run: TrainingRun
    earlier: float


def load(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> Training:
    """Load the photos and put everything in place. Nothing is open in ``config``."""
    scene, earlier = read_scene(inputs["normalise"]), earlier_seconds(config, inputs)
    if config.target_psnr is not None:
        scene = _with_photos_aside(config.target_psnr, scene, progress)
    run = prepare(config, scene, inputs, folder, progress)
    say_if_inexact(config, progress)
    return Training(config, scene, run, earlier)


def _with_photos_aside(target_psnr: float, scene: Scene, progress: Progress) -> Scene:
    scene = with_validation(scene)
    aside, left = len(scene.of_split("validation")), len(scene.of_split("train"))
    progress.note(
        "train.validation-photos",
        f"{aside} of {aside + left} training photos are set aside to tell when {target_psnr:g} dB are reached",
    )
    return scene


def prepare(config: Config, scene: Scene, inputs: Inputs, folder: Path, progress: Progress) -> TrainingRun:
    """Photos, probes, budget and trainer of a run. Raises StageError where the field takes too much memory."""
    assert config.downscale is not None, "plan() chooses it"
    device = compute_device()
    if device == "cpu":
        field = field_of(config)
        check_memory(field.memory_bytes(config, cores()), "the field", *field.memory_advice(config))
    progress.update("reading the photos")
    dataset = guided_dataset(inputs, scene, config.downscale, progress).to(device)
    shown_over = torch.tensor(field_background(config, scene), device=device)

    probes = Probes(
        make_probe(dataset, PROBE_RAYS, shown_over, PROBE_SEED),
        unseen_photos(config, inputs["ingest"], scene, "test", device, progress),
    )
    if config.target_psnr is not None:
        aside = unseen_photos(config, inputs["ingest"], scene, "validation", device, progress)
        assert aside is not None, "load() sets some aside"
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


def _say_sizes(config: Config, budget: TrainingBudget, dataset: RayDataset, progress: Progress) -> None:
    much = f"{budget.seconds:g} s" if budget.steps is None else f"{budget.steps:,} steps"
    another = "" if budget.after is None else "another "
    photos = f"{len(dataset.near)} photos at 1/{config.downscale:g} of their size"
    field = field_of(config)
    sizes = f"{config.field} field ({field.sizes_in_words(config)})"
    progress.note("train.sizes", f"{sizes}, {another}{much} · {photos}, {short_count(len(dataset.pixels))} pixels")
    if words := field.step_in_words(config):
        progress.note("train.step", words)


def compute(training: Training) -> None:
    """Take the steps of the budget, at the precision that was chosen."""
    with use_matmul_precision(training.config.matmul):
        training.run.train()


def save(training: Training, folder: Path, progress: Progress) -> StageResult:
    """Write the field with the record of how it came about."""
    config, scene, run, _ = training
    assert config.downscale is not None, "plan() chooses it"
    info = {"downscale": config.downscale, "steps": run.state.step, "rays": run.state.rays}
    info["background"] = list(field_background(config, scene))
    info["effects"] = learnt_effects(run.trainer.effects, scene.of_split("train"))
    save_field(folder, run.trainer.model, info)
    write_curve(folder, config.kind, config.downscale, run.plan.is_whole, run.state.curve)
    progress.update("measuring what this machine can do")
    with use_matmul_precision(config.matmul):
        parts = write_parts(folder, run.state.timings, config, run.probes.train.colours.device)
    for note in _closing_notes(training):
        progress.note(*note)
    left_behind = sorted(path.name for path in folder.glob("nonfinite_*.safetensors"))
    board = ["tensorboard"] if config.tensorboard else []
    final = checkpoint_files(run.checkpoints, run.state.step)
    records = ("curve.json", "log.jsonl", "plan.json", *parts, *final, *left_behind, *board)
    return StageResult(("field.safetensors", "field.json"), _line(training), records, _facts(training))


def _closing_notes(training: Training) -> list[Note]:
    """What the last doubling of the time bought, what the next is predicted to buy, and whether a target is reached."""
    state, config = training.run.state, training.config
    doubling = doubling_words(state.curve, coming_doubling(config.kind, training.run.plan.is_whole, state.curve))
    target = target_words(state.open_target(config.target_psnr), state.validation_psnr, state.seconds)
    return [Note(code, words) for code, words in (("train.doubling", doubling), ("train.target", target)) if words]


def _facts(training: Training) -> dict[str, object]:
    config, state, last = training.config, training.run.state, training.run.state.curve[-1]
    return {
        "field": config.field,
        "steps": state.step,
        "train_seconds": round(state.seconds, 3),
        "earlier_seconds": round(training.earlier, 3),
        "rays_per_second": round(state.rays / state.seconds, 1),
        "samples_per_second": round(state.samples / state.seconds, 1),
        "train_psnr": last["train_psnr"],
        "probe_psnr": last["probe_psnr"],
        "validation_psnr": state.validation_psnr,
        "curve": state.curve[-5:],
        "downscale": config.downscale,
        "restarts": state.restarts,
        "rollbacks": state.rollbacks,
        "symptom": state.symptom,
        **precision_facts(config),
    }


def _line(training: Training) -> str:
    """180 s · 5.4 k steps · 24 k rays/s · 28.9 dB on test pixels, over time ▁▃▅▆▇█ · as long again (--more 3m) is
    predicted to buy +0.6 ± 0.4 dB."""
    config, state = training.config, training.run.state
    probe = state.curve[-1]["probe_psnr"]
    before = "" if config.after is None else f", {state.seconds_before:.0f} s of them before"
    parts: list[str | None] = [f"{state.seconds:.0f} s{before}"]
    parts += [f"{short_count(state.step)} steps", f"{short_count(state.rays / state.seconds)} rays/s"]
    spark = sparkline(state.curve)
    rising = f", over time {spark}" if spark else ""
    parts.append("no test photos" if probe is None else f"{probe:.1f} dB on test pixels{rising}")
    parts.append(next_words(state.curve, coming_doubling(config.kind, training.run.plan.is_whole, state.curve)))
    parts.append(target_words(state.open_target(config.target_psnr), state.validation_psnr, state.seconds))
    if state.symptom is not None:
        parts.append(f"of no use yet: {state.symptom}")
    return " · ".join(filter(None, parts))
