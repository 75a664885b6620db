"""Stage tradeoff: a study of what quality costs on this scene and this machine.

It trains fields of several kinds and sizes for several times, at several photo sizes, with several seeds, and scores
each on the same pixels of the test photos, together with the field that the workspace has already. It draws the
Pareto front of training time and quality and recommends one point of it. It runs only when it is asked for.
"""

from pathlib import Path
from typing import Annotated

from pydantic import Field
from tyro.conf import Suppress

from stages.contract import Auto, Inputs, Progress, Stage, StageConfig, StageResult, Workload
from stages.effects.decisions import Space


class Config(StageConfig):
    """The size of the study."""

    seconds: float = Field(
        default=1800.0, gt=0, description="Time for all runs and scores, in seconds; --budget 30m means the same."
    )
    seeds: int = Field(
        default=3, ge=1, le=9, description="Maximum number of seeds per setting; fewer if there is too little time."
    )
    downscale: Auto[float] = Field(
        default=None,
        ge=1,
        description=(
            "Photo width divided by scored width (default: 1; more if the longer side has more than 1600 pixels)."
        ),
    )
    # Measured or chosen by plan(); no flag is offered for them.
    speeds: Annotated[dict[str, tuple[float, float]] | None, Suppress] = Field(
        default=None, description="Steps and rays per second of training, by variant (default: measured)."
    )
    space: Annotated[Space | None, Suppress] = Field(
        default=None, description="Space map of the scene (default: as stage train chooses)."
    )
    sizes: Annotated[tuple[float, ...] | None, Suppress] = Field(
        default=None, description="Photo sizes to train at (default: as time allows)."
    )
    tiles: Annotated[int | None, Suppress] = Field(
        default=None, description="Tiles of the test photos to score (default: as time allows)."
    )
    reading: Annotated[tuple[float, float] | None, Suppress] = Field(
        default=None,
        description="Seconds to read the photos at one size, and the test photos to score (default: measured).",
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """Just what it is given."""
    return config.seconds


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Measure how fast this machine trains each kind of field and reads photos; choose photo sizes and tiles."""
    from stages.tradeoff.study import plan_study

    return plan_study(config, inputs, progress)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Train and score run by run, then write tables, plot, pictures and the recommendation."""
    from stages.tradeoff.study import run_study, save_study

    outcome = run_study(config, inputs, folder, progress)
    return save_study(config, outcome, folder, workspace=inputs["normalise"].resolve().parents[1].name)


STAGE = Stage(
    name="tradeoff",
    inputs=("ingest", "normalise", "effects"),
    optional_inputs=("train",),
    version=18,
    exit_code=19,
    resumes=True,
    published=("tradeoff.svg", "tradeoff.png", "tradeoff.md", "tradeoff.json", "ablation.png"),
    config=Config,
    plan=plan,
    run=run,
    on_request=True,
    expected_seconds=expected_seconds,
    less_memory="a larger --tradeoff.downscale",
)
