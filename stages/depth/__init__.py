"""Stage depth: a depth map for every training photo, and a dense point cloud, by stereo alone, without any training.

Pairs of photos → rectified → disparities by semi-global matching → per photo the distances that several neighbours
agree on → points. Test photos are not used, so a field that is trained with the depth maps still sees nothing of them.
"""

from pathlib import Path

from pydantic import Field

from stages.contract import Auto, Inputs, Progress, Stage, StageConfig, StageResult, Workload

PAIRS_PER_PHOTO = 2.5  # with four neighbours each: most pairs are chosen from both sides, and matched once
PAIR_SECONDS, PHOTO_SECONDS = 0.35, 0.5  # of a core, at the default size


class Config(StageConfig):
    """How depth maps are made."""

    downscale: Auto[float] = Field(
        default=None, ge=1, description="Photo width divided by depth map width (default: a longer side of 640 pixels)."
    )
    neighbours: int = Field(default=4, ge=2, le=12, description="Number of photos that each photo is matched with.")
    seconds: Auto[float] = Field(
        default=None, gt=0, description="Time limit in seconds; depth maps get smaller (default: none)."
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """For pairs and photos at the default size."""
    if config.seconds is not None:
        return config.seconds
    work = workload.photos.number * (PAIRS_PER_PHOTO * config.neighbours / 4 * PAIR_SECONDS + PHOTO_SECONDS)
    return work / workload.cores + workload.photos.reading_seconds(workload.cores)


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose the size of the depth maps: from ``seconds`` and the speed of this machine where there is a limit."""
    from stages.depth.planning import choose_downscale

    if config.downscale is not None:
        return config
    return config.model_copy(update={"downscale": choose_downscale(config, inputs, progress)})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Match pairs of photos, write what they agree on, fuse it into points."""
    from stages.depth.estimation import estimate_depth

    return estimate_depth(config, inputs, folder, progress)


STAGE = Stage(
    name="depth",
    inputs=("ingest", "normalise"),
    version=5,
    exit_code=20,
    resumes=True,
    published=("points.ply",),
    config=Config,
    not_hashed=("seconds",),  # it decides the size of the depth maps, and that enters the key
    plan=plan,
    run=run,
    on_request=True,
    expected_seconds=expected_seconds,
    less_memory="a larger --depth.downscale",
)
