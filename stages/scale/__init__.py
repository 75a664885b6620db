"""Stage scale: how many metres a unit of the sfm frame is, by markers in the photos, a distance, or GPS.

It is a stage of its own, so that a length given after training changes only the files in metres; nothing is trained
again.
"""

from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator
from tyro.conf import UseAppendAction, arg

from stages.contract import Auto, Inputs, Progress, Stage, StageConfig, StageResult, Workload
from stages.io.files import read_json
from stages.scale.lengths import parse_length, parse_point
from stages.scale.marker_names import parse_marker


class Config(StageConfig):
    """What has a known length."""

    marker: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="DICTIONARY:ID=LENGTH")] = Field(
        default=(),
        description=(
            "A printed ArUco marker or AprilTag with the length of its black square, such as 4X4_50:7=50mm or "
            "APRILTAG_36h11:0=2in."
        ),
    )
    distance: Annotated[Auto[tuple[str, str, str]], arg(metavar="X,Y,Z X,Y,Z LENGTH")] = Field(
        default=None,
        description=(
            "Two points in the frame of output/transforms.json and the distance between them, such as "
            "0.1,0.2,3 0.4,0.2,3 1.25m (default: none)."
        ),
    )

    @field_validator("marker")
    @classmethod
    def _markers(cls, markers: tuple[str, ...]) -> tuple[str, ...]:
        """Of several lengths of a marker the last counts: a command may correct what the workspace has recorded."""
        return tuple({parse_marker(marker).printed: marker for marker in markers}.values())

    @field_validator("distance")
    @classmethod
    def _distance(cls, distance: tuple[str, str, str] | None) -> tuple[str, str, str] | None:
        if distance is not None:
            if parse_point(distance[0]) == parse_point(distance[1]):
                raise ValueError(f"both points are {distance[0]}")
            parse_length(distance[2])
        return distance


def metres_per_unit(folder: Path) -> float | None:
    """What the stage's finished ``folder`` says: metres a unit of the sfm frame, None where nothing tells."""
    return read_json(folder / "scale.json")["metres_per_unit"]


def expected_seconds(config: Config, workload: Workload) -> float:
    """Next to nothing without markers; with them the photos are decoded and searched."""
    if not config.marker:
        return 0.3
    return 0.3 + 3 * workload.photos.reading_seconds(workload.cores)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Measure what has a known length; write scale.json."""
    from stages.scale.measurement import measure_scale

    return measure_scale(config, inputs, folder, progress)


STAGE = Stage(
    name="scale",
    inputs=("ingest", "sfm", "normalise"),
    version=5,
    exit_code=22,
    published=("scale.json",),
    config=Config,
    run=run,
    expected_seconds=expected_seconds,
)
