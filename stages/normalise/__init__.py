"""Stage normalise: the calibrated scene in our own frame, the split, and the export for other programs."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from stages.contract import Auto, Inputs, Progress, Stage, StageConfig, StageResult, Workload, reading_seconds

MASK_SHARE = 0.1  # of the time that its photo takes to decode: a mask is looked at, and its outline carves the region


class Config(StageConfig):
    """The region of interest and the test photos."""

    roi: Auto[tuple[float, float, float, float]] = Field(
        default=None,
        description=(
            "Region of interest: its centre x, y, z and half its side, in the frame of output/transforms.json "
            "(default: from the cameras and points)."
        ),
    )
    test_every: int = Field(
        default=8,
        ge=2,
        description=(
            "Hold out every n-th photo by name as a test photo, starting with the first; imported splits are kept."
        ),
    )
    masks: Auto[Literal["cut-out", "ignore"]] = Field(
        default=None,
        description=(
            "cut-out: what masks ignore is transparent; ignore: it is unknown (default: transparent where they cut out "
            "an object, as the sparse points tell)."
        ),
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """However many photos there are; masks may all be looked at."""
    masked = 0 if config.masks == "ignore" else workload.photos.masked
    return 0.3 + MASK_SHARE * reading_seconds(masked * workload.photos.megapixels, workload.cores)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Read the sparse model, choose the scene frame, write scene.json, points.safetensors and transforms.json."""
    from stages.normalise.scene_frame import normalise_scene

    return normalise_scene(config, inputs, folder, progress)


STAGE = Stage(
    name="normalise",
    inputs=("ingest", "sfm"),
    version=21,
    exit_code=12,
    published=("transforms.json", "scene.json"),
    config=Config,
    run=run,
    expected_seconds=expected_seconds,
)
