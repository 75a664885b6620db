"""From settings and photos to a training run that is ready for its first step, or its next one after a kill."""

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from stages.contract import Inputs, Progress
from stages.device import compute_device
from stages.live_line import short_count

if TYPE_CHECKING:
    from nerf.paper import PaperSettings
    from nerf.ray_bank import RayBank
    from nerf.scene import Scene
    from nerf.training import TrainerSettings
    from stages.train import Config
    from stages.training_loop import TrainingRun

FINAL_RATE = 0.1  # of the learning rate at the start
PROBE_RAYS = 2048
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def prepare(config: "Config", scene: "Scene", inputs: Inputs, folder: Path, progress: Progress) -> "TrainingRun":
    """Load the photos and put everything in place for the first step, or the next after a kill."""
    import torch

    from nerf.paper import PaperNerf
    from nerf.probe import make_probe
    from nerf.training import PaperTrainer
    from stages.training_data import training_bank
    from stages.training_log import TrainingLog
    from stages.training_loop import Budget, Probes, TrainingRun

    assert config.downscale is not None, "plan() chooses it"
    device = compute_device()
    progress.update("reading the photos")
    bank = training_bank(inputs["ingest"], scene, "train", config.downscale).to(device)
    settings, field = trainer_settings(config, scene), field_settings(config)
    shown_over = torch.tensor(field_background(config, scene), device=device)

    heldout = None
    if scene.of_split("test"):
        unseen = training_bank(inputs["ingest"], scene, "test", config.downscale).to(device)
        heldout = make_probe(unseen, PROBE_RAYS, shown_over, config.seed)
    _say_sizes(config, bank, progress)

    def make_trainer(attempt: int) -> PaperTrainer:
        seed = config.seed + attempt
        return PaperTrainer(PaperNerf(field, seed).to(device), bank, replace(settings, seed=seed))

    return TrainingRun(
        make_trainer,
        Probes(make_probe(bank, PROBE_RAYS, shown_over, config.seed), heldout),
        Budget(config.steps, config.seconds),
        folder,
        config.checkpoint_seconds,
        TrainingLog(folder, config.tensorboard),
        progress,
    )


def _say_sizes(config: "Config", bank: "RayBank", progress: Progress) -> None:
    budget = f"{config.steps:,} steps" if config.steps is not None else f"{config.seconds:g} s"
    photos = f"{len(bank.near)} photos at 1/{config.downscale:g} of their size"
    progress.note(f"{config.preset} field, {budget} · {photos}, {short_count(len(bank.pixels))} pixels")


def field_settings(config: "Config") -> "PaperSettings":
    from nerf.paper import PaperSettings

    return PaperSettings(**{part.name: getattr(config, part.name) for part in fields(PaperSettings)})


def trainer_settings(config: "Config", scene: "Scene") -> "TrainerSettings":
    from nerf.training import TrainerSettings

    background = "random" if scene.has_alpha and config.background == "random" else field_background(config, scene)
    assert config.batch_rays is not None and config.learning_rate is not None, "plan() chooses them"
    rates = (config.learning_rate, config.learning_rate * FINAL_RATE)
    return TrainerSettings(config.batch_rays, config.seed, background, *rates)


def field_background(config: "Config", scene: "Scene") -> tuple[float, float, float]:
    """What the finished field is shown over. Photos without alpha fill every ray; what a field leaves open is black,
    as published."""
    return WHITE if scene.has_alpha and config.background != "black" else BLACK


def rays_in_budget(config: "Config", scene: "Scene") -> float:
    """How many rays the run will draw: counted for a budget of steps, from measured speed for one of seconds."""
    from stages.training_size import rays_per_second

    settings = trainer_settings(config, scene)
    if config.steps is not None:
        return float(config.steps * settings.batch_rays)
    assert config.seconds is not None, "one of the two is given"
    return config.seconds * rays_per_second(scene, field_settings(config), settings, compute_device())
