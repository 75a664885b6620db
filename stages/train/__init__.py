"""Stage train: photos and cameras become a radiance field."""

from pathlib import Path

from stages.contract import Inputs, Progress, StageResult
from stages.train.config import Config

INPUTS = ("ingest", "normalise", "effects")
VERSION = 24
RESUMES = True
PUBLISHED = ("curve.json",)
NOT_HASHED = ("checkpoint_seconds", "tensorboard")


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Field, budget and sizes, where they were left open, by the scene and the speed of this machine."""
    from stages.train.planning import planned

    return planned(config, inputs, progress)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Train, and write the field with the record of how it came about.

    Raises:
        StageError: if training diverges or the field does not learn, every remedy of ours having failed.
    """
    from stages.train import training

    loaded = training.load(plan(config, inputs, progress), inputs, folder, progress)
    training.compute(loaded)
    return training.save(loaded, folder, progress)
