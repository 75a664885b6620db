"""Stage mesh: the field's density becomes a triangle mesh that looks like the photos.

Density on a grid over the region of interest → marching cubes at the iso-level where the photos' rays stop → only what
the photos see → decimation → fringes cut off → refinement: moved to where the photos agree → holes closed, if asked for
→ a texture from the photos → GLB, PLY, OBJ, STL, 3MF, USDZ.
A surface that leaves the region of interest ends there, open: closing it would invent geometry.
"""

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator

from stages.contract import Auto, Flexible, Inputs, Progress, Stage, StageConfig, StageError, StageResult, Workload
from stages.hardware.device import processors
from stages.io.files import read_scene
from stages.mesh.face_count import default_faces
from stages.scale import metres_per_unit
from stages.train import trained_seconds

# Of a texture, besides decoding the photos twice: in all, and of a core for each photo. Fox with 100,000 faces takes 5
# and 19 s of a core for its 43 training photos (docs/experiments/mesh.md).
TEXTURE_SECONDS, TEXTURE_SECONDS_PER_PHOTO = 5.0, 0.45
# Of a refinement, of a core: for 100,000 faces, and for each photo that a texture would have looked through anyway.
REFINEMENT_SECONDS, REFINEMENT_SECONDS_PER_PHOTO = 6.0, 0.2
MEASURED_FACES = 100_000  # which REFINEMENT_SECONDS are for
MIN_SHARE_OF_SHAPE = 0.3  # of a time limit, that refinement and texture leave

Format = Literal["glb", "ply", "obj", "stl", "3mf", "usdz"]
Keep = Literal["visible", "largest", "all"]
Box = tuple[float, float, float, float, float, float]


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
    min_views: int = Field(
        default=2, ge=1, description="Photos that must see a face for it to be kept; the same holds for components."
    )
    min_component: float = Field(
        default=0.01, ge=0, le=1, description="Area of the smallest component kept, as a fraction of the largest one's."
    )
    box: Auto[Box] = Field(
        default=None,
        description=(
            "Keep only what lies in this box: its lowest x, y, z and its highest, in the frame of the files "
            "(default: everything)."
        ),
    )
    max_faces: Auto[int] = Field(
        default=None,
        ge=100,
        description=(
            "Maximum number of faces after decimation (default: a quarter of them, at least 100000 and at most 300000; "
            "without a texture 300000)."
        ),
    )
    refine: bool = Field(default=True, description="Move the surface to where the photos agree that it is.")
    smooth: bool = Field(default=False, description="Smooth the faces, and keep edges.")
    close: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description=(
            "Close holes up to this size, as a fraction of the mesh's; 1 closes all of them, for printing. What is "
            "closed is invented."
        ),
    )
    texture_size: int = Field(
        default=4096,
        ge=0,
        le=8192,
        description=(
            "Maximum side of the texture in texels; it is smaller where the photos show no more. 0: a colour per "
            "vertex."
        ),
    )
    formats: tuple[Format, ...] = Field(default=("glb", "ply"), min_length=1, description="File formats to write.")
    frame: Auto[Literal["metric", "sfm", "scene"]] = Field(
        default=None,
        description=(
            "Coordinate frame of the files; metric is the sfm frame in metres (default: metric if the scale is known, "
            "else sfm)."
        ),
    )

    @field_validator("box")
    @classmethod
    def _box(cls, box: Box | None) -> Box | None:
        if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("give the lowest x, y, z first, then the highest")
        return box


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """5 s and about a seventh of the training's seconds (fox, fountain_p11 and the demo, after three minutes); for a
    refinement and a texture, time for each photo besides."""
    if config.seconds is not None:
        return config.seconds
    trained, photos, cores = trained_seconds(workload), workload.photos, workload.cores
    reads = 2 * (config.texture_size > 0) + config.refine
    reading = reads * photos.reading_seconds(cores)
    return None if trained is None else 5.0 + 0.15 * trained + _photo_seconds(config, photos.number, cores) + reading


def _photo_seconds(config: Config, photos: int, cores: int) -> float:
    """What a refinement and a texture take, besides decoding the photos."""
    textured, seconds = config.texture_size > 0, 0.0
    if textured:
        seconds += TEXTURE_SECONDS + TEXTURE_SECONDS_PER_PHOTO * photos / cores
    if config.refine:
        faces = config.max_faces or default_faces(0, textured)
        per_photo = 0.0 if textured else REFINEMENT_SECONDS_PER_PHOTO * photos
        seconds += (REFINEMENT_SECONDS + per_photo) * faces / MEASURED_FACES / cores
    return seconds


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose the resolution: from the training, or from what refinement and texture leave of ``seconds`` and the speed
    of this machine; and the frame. The number of faces follows from the surface, once that is there."""
    from stages.mesh.resolution import choose_resolution

    if "usdz" in config.formats:
        from stages.mesh.files.usdz import check_installed

        check_installed()
    metres = metres_per_unit(inputs["scale"])
    if config.frame == "metric" and metres is None:
        raise StageError(
            "mesh.no-metres",
            "--mesh.frame metric needs a scale that is known",
            "no marker, distance or GPS position tells how long a unit is",
            "Give --scale.marker or --scale.distance, or leave --mesh.frame out.",
        )
    frame = config.frame or ("sfm" if metres is None else "metric")
    resolution = config.resolution
    if resolution is None:
        seconds = config.seconds
        if seconds is not None:
            photos = len(read_scene(inputs["normalise"]).of_split("train"))
            seconds = max(MIN_SHARE_OF_SHAPE * seconds, seconds - _photo_seconds(config, photos, processors()))
        resolution = choose_resolution(seconds, inputs, progress)
    return config.model_copy(update={"resolution": resolution, "frame": frame})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Extract the mesh; write it in every format asked for, and a picture of it."""
    from stages.mesh.extraction import extract_mesh, load, save

    source = load(inputs, progress)
    extracted = extract_mesh(config, source, progress)
    progress.update("writing", 0.95)
    return save(config, extracted, source, folder)


STAGE = Stage(
    name="mesh",
    inputs=("ingest", "normalise", "scale", "train"),
    version=25,
    exit_code=17,
    published=("mesh.glb", "mesh.ply", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.stl", "mesh.3mf", "mesh.usdz"),
    config=Config,
    not_hashed=("seconds",),  # it decides the resolution, and that enters the key
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    flexible=Flexible(share=0.12, min_seconds=8.0, max_seconds=60.0),
    less_memory="a smaller --mesh.resolution",
)
