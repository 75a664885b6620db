"""Stage mesh: the field's density becomes a coloured triangle mesh.

Density on a grid over the region of interest → marching cubes at the iso-level where the photos' rays stop → only what
the photos see → decimation → vertex colours from the field → GLB, PLY, OBJ.
A surface that leaves the region of interest ends there, open: closing it would invent geometry.
"""

from pathlib import Path
from typing import Literal

from pydantic import Field

from stages.contract import Auto, Flexible, Inputs, Progress, StageConfig, StageResult, Workload
from stages.train import trained_seconds

INPUTS = ("ingest", "normalise", "train")
VERSION = 13
EXIT_CODE = 17
RESUMES = False
PUBLISHED = ("mesh.glb", "mesh.ply", "mesh.obj")
NOT_HASHED = ("seconds",)  # it decides the resolution, and that enters the key
FLEXIBLE = Flexible(share=0.12, min_seconds=8.0, max_seconds=60.0)

Format = Literal["glb", "ply", "obj"]
Keep = Literal["visible", "largest", "all"]


class Config(StageConfig):
    """How the mesh is extracted."""

    resolution: Auto[int] = Field(
        default=None,
        ge=16,
        le=1024,
        description=(
            "Density grid points along an edge of a cube; a flat box has as many in all (default: from the training)."
        ),
    )
    seconds: Auto[float] = Field(
        default=None, gt=0, description="Time limit in seconds (default: about a tenth of the training time)."
    )
    iso_level: Auto[float] = Field(
        default=None, gt=0, description="Density at the surface (default: where the photos' rays terminate)."
    )
    keep: Keep = Field(default="visible", description="Components of the surface to keep.")
    min_views: int = Field(default=2, ge=1, description="Photos that must see a component for it to count as visible.")
    min_component: float = Field(
        default=0.01, ge=0, le=1, description="Area of the smallest component kept, as a fraction of the largest one's."
    )
    max_faces: int = Field(default=300_000, ge=100, description="Maximum number of faces after decimation.")
    formats: tuple[Format, ...] = Field(default=("glb", "ply"), min_length=1, description="File formats to write.")
    frame: Literal["sfm", "scene"] = Field(default="sfm", description="Coordinate frame of the files.")


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """5 s and about a seventh of the training's seconds (fox, fountain_p11 and the demo, after three minutes)."""
    if config.seconds is not None:
        return config.seconds
    trained = trained_seconds(workload)
    return None if trained is None else 5.0 + 0.15 * trained


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose the resolution: from the training, or from ``seconds`` and the speed of this machine."""
    from stages.mesh.resolution import choose_resolution

    if config.resolution is not None:
        return config
    return config.model_copy(update={"resolution": choose_resolution(config.seconds, inputs, progress)})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Extract the mesh; write it in every format asked for, and a picture of it."""
    from stages.mesh.extraction import extract_mesh, load, save

    source = load(inputs, progress)
    extracted = extract_mesh(config, source, progress)
    progress.update("writing", 0.95)
    return save(config, extracted, source, folder)
