"""Stage normalise: the calibrated scene in our own frame, the split, and the export for other programs."""

from pathlib import Path

from pydantic import Field

from stages.contract import Inputs, Progress, StageConfig, StageResult, Workload

INPUTS = ("ingest", "sfm")
VERSION = 17
EXIT_CODE = 12
RESUMES = False
PUBLISHED = ("transforms.json", "scene.json")


class Config(StageConfig):
    """Settings of stage normalise."""

    roi: tuple[float, float, float, float] | None = Field(
        default=None,
        description="centre x, y, z and half side of the region of interest, in the frame of output/transforms.json",
    )
    test_every: int = Field(
        default=8, ge=2, description="hold out every n-th photo by name, from the first (imported splits are kept)"
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """However many photos there are."""
    return 0.3


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Read the sparse model, choose the scene frame, write scene.json, points.safetensors and transforms.json."""
    from stages.normalise.scene_frame import normalise_scene

    return normalise_scene(config, inputs, folder, progress)
