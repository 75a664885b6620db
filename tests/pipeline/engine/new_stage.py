"""A stage that nobody has heard of: it counts the photos, up to a number, and has all that a stage may declare."""

from pathlib import Path

from stages.contract import Flexible, Inputs, Progress, Stage, StageConfig, StageError, StageResult, Workload
from stages.io.files import write_json
from stages.io.photos import read_photos


class Config(StageConfig):
    """How far to count."""

    most: int = 100
    """The largest number."""
    seconds: float | None = None
    """Time that it may take."""


def expected_seconds(config: Config, workload: Workload) -> float:
    """A second for each photo."""
    return float(workload.photos.number)


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Counts no further than there is time."""
    return config if config.seconds is None else config.model_copy(update={"most": int(config.seconds)})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write count.json."""
    if not config.most:
        raise StageError("count.zero", "nothing is counted", "0 is where it starts", "Give a larger --count.most.")
    count = min(config.most, len(read_photos(inputs["ingest"])))
    write_json(folder / "count.json", count)
    return StageResult(("count.json",), f"{count} photos")


STAGE = Stage(
    name="count",
    inputs=("ingest",),
    version=1,
    exit_code=42,
    published=("count.json",),
    config=Config,
    not_hashed=("seconds",),
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    flexible=Flexible(share=0.1, min_seconds=1.0),
)
