"""Stage train: photos and cameras become a radiance field."""

from pathlib import Path

from stages.contract import Flexible, Inputs, Progress, Stage, StageResult, Workload
from stages.train.config import Config

# Its own seconds count steps alone. Beside reading the photos, timing the first steps takes about STARTING_SECONDS,
# validation and checkpoints 1.5 to 2 % (fox, fountain_p11 and sceaux_castle, three minutes each).
STARTING_SECONDS, OVERHEAD = 4.0, 0.02


def step_seconds(wall: float, reading: float) -> float:
    """Seconds of training steps in a stage that takes ``wall`` seconds in all, at least half of these, and ``reading``
    of them to read the photos."""
    return max(wall / 2, (wall - STARTING_SECONDS - reading) / (1 + OVERHEAD))


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


def more_inputs(config: Config) -> tuple[str, ...]:
    """Depth maps, where training is to use them."""
    return ("depth",) if config.depth else ()


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

    with training.ranks_of(config, inputs) as ranks:
        loaded = training.load(config, inputs, folder, progress, ranks)
        training.compute(loaded)
    return training.save(loaded, folder, progress)


STAGE = Stage(
    name="train",
    inputs=("ingest", "normalise", "effects"),
    more_inputs=more_inputs,
    version=34,
    exit_code=14,
    resumes=True,
    published=("curve.json",),
    config=Config,
    not_hashed=("checkpoint_seconds", "devices", "tensorboard"),
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    # A user waits for the field, so it gets most of what is left; figures, a video and a mesh are there to see it by. A
    # training of less than half a minute is worth none.
    flexible=Flexible(share=0.68, min_seconds=30.0, max_share=1.0, reads_photos=True, work=step_seconds),
    less_memory="a larger --train.downscale",
)
