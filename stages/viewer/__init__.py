"""Stage viewer: the trained field itself in one HTML file, which any browser draws without a server or a network.

The page marches rays through the hash grids on the graphics chip, as the Python renderer does it (page/*.glsl). What
the grids hold is packed into it in 8 bits a number, or in 16 where 8 would be seen.
"""

from pathlib import Path
from typing import Literal

from pydantic import Field

from stages.contract import READING_SECONDS, Inputs, Progress, Stage, StageConfig, StageResult, Workload


class Config(StageConfig):
    """What the page contains."""

    photos: Literal["on", "off"] = Field(
        default="on", description="Whether small copies of the photos are in the page, to compare with the field."
    )
    mesh: Literal["on", "off"] = Field(
        default="on", description="Whether a small copy of the mesh is in the page, as a layer; at most 0.3 MB."
    )
    bits: Literal["auto", "8", "16"] = Field(
        default="auto",
        description="Bits per number of the grids: 8, or 16 where 8 lose more than 0.05 dB of held-out PSNR.",
    )


def more_inputs(config: Config) -> tuple[str, ...]:
    """The mesh, where the page is to have it. A mesh that fails leaves a page without one."""
    return ("mesh",) if config.mesh == "on" else ()


def expected_seconds(config: Config, workload: Workload) -> float:
    """A few small renders, packing, and decoding the test photos; those of training are in the pixel store."""
    test_photos = workload.photos.number / workload.options["normalise"].test_every
    return 3.0 + READING_SECONDS * workload.photos.megapixels * test_photos / workload.cores


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Pack the field, the cameras, small photos, sparse points and the mesh; write viewer.html."""
    from stages.viewer import page
    from stages.viewer.contents import load

    contents = load(config, inputs, progress)
    progress.update("writing the page", 0.95)
    return page.save(contents, folder)


STAGE = Stage(
    name="viewer",
    inputs=("ingest", "normalise", "scale", "train"),
    more_inputs=more_inputs,
    dispensable=("mesh",),
    version=10,
    exit_code=21,
    published=("viewer.html",),
    config=Config,
    run=run,
    expected_seconds=expected_seconds,
)
