"""Stage evaluate: how good the field is on photos it has never seen, and beside two trivial predictions.

Every test photo is scored at its own size, up to 1600 pixels of the longer side, whatever size was trained on; where
there is no time for all of it, in tiles. PSNR is taken from the float image in [0, 1], per photo; figures over all
photos are means of the photos' own.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from pydantic import Field

from stages.contract import Auto, Flexible, Inputs, Progress, SilentProgress, Stage, StageConfig, StageResult, Workload
from stages.evaluate.seconds import SHARE, other_seconds
from stages.train import trained_seconds


class Config(StageConfig):
    """How test photos are scored."""

    downscale: Auto[float] = Field(
        default=None,
        ge=1,
        description=(
            "Photo width divided by scored width (default: 1; more if the longer side has more than 1600 pixels)."
        ),
    )
    fraction: Auto[float] = Field(
        default=None,
        gt=0,
        le=1,
        description="Fraction of each test photo to score, in tiles spread over it (default: as time allows).",
    )
    background: Auto[Literal["white", "black"]] = Field(
        default=None,
        description="Background behind transparent pixels (default: as in training; white if that was random).",
    )
    fit_poses: Literal["auto", "on", "off"] = Field(
        default="auto",
        description=(
            "Also score the right half of each test photo at a pose fitted to its left half; auto: if training "
            "refined poses. Only for a hash-grid field."
        ),
    )
    seconds: Auto[float] = Field(
        default=None, gt=0, description="Time limit in seconds (default: a tenth of the training time for rendering)."
    )


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """What rendering may take, and what comes beside it; a small set takes less."""
    if config.seconds is not None:
        return config.seconds
    trained = trained_seconds(workload)
    return None if trained is None else SHARE * trained + other_seconds(workload.photos.number, workload.cores)


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose how much of each test photo is scored, by the speed of this machine."""
    from stages.evaluate.planning import affordable_fraction

    if config.fraction is not None:
        return config
    return config.model_copy(update={"fraction": affordable_fraction(config, inputs, progress)})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Render the test photos, compare, and write metrics.json, renders/ and errors/; where there are depth maps,
    compare with these, too."""
    from stages.evaluate.scoring import load, save, score

    scorer = load(config, inputs, progress)
    images = score(scorer, folder, progress, partial(load, config, dict(inputs), SilentProgress()))
    result = save(scorer, images, folder)
    if "depth" not in inputs:
        return result
    from stages.evaluate.planning import stereo_seconds
    from stages.evaluate.stereo_check import PICTURES, RECORD, check, line_of

    checked = check(scorer.scene, inputs, scorer.renderer, stereo_seconds(config, inputs["train"]), folder, progress)
    return replace(result, records=(RECORD, PICTURES), line=f"{result.line} · {line_of(checked)}")


STAGE = Stage(
    name="evaluate",
    inputs=("ingest", "normalise", "train"),
    optional_inputs=("depth",),
    version=19,
    exit_code=15,
    published=("metrics.json", "renders", "errors", "stereo_check.json", "stereo_check"),
    config=Config,
    not_hashed=("seconds",),  # it decides how much of the photos is scored, and that enters the key
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    flexible=Flexible(share=0.05, min_seconds=3.0, max_seconds=60.0),
    less_memory="a larger --evaluate.downscale",
)
