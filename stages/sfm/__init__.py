"""Stage sfm: the camera poses and intrinsics of all photos, by structure-from-motion or imported."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from stages.contract import (
    Auto,
    BudgetLeft,
    Inputs,
    OptionalSourcePath,
    Progress,
    Stage,
    StageConfig,
    StageResult,
    Workload,
)
from stages.io.amounts import counted
from stages.io.files import write_json
from stages.sfm.pairs import MAX_EXHAUSTIVE, Matcher

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
Direction = Literal["world-from-camera", "camera-from-world"]
CameraAxes = Literal["opencv", "opengl"]
MAX_STRATEGIES = 9  # the default of ``max_strategies``, which is all of them
MAX_DOUBLED_MEGAPIXELS = 0.7  # photos of a longer side of up to 1024 pixels are doubled for feature extraction
BUDGET_SHARE = 0.5  # of a budget: what it may take before it extracts fewer features


class Config(StageConfig):
    """How camera poses and intrinsics are found."""

    photos: OptionalSourcePath = Field(default=None, description="What was given as PHOTOS, for messages.")
    cameras: OptionalSourcePath = Field(
        default=None,
        description="Poses to import: a transforms file or a folder of them, a COLMAP model or a poses_bounds.npy.",
    )
    pose_direction: Auto[Direction] = Field(
        default=None,
        description=(
            "Direction of the matrices of imported poses (default: world-from-camera in transforms files, "
            "camera-from-world in COLMAP models)."
        ),
    )
    camera_axes: Auto[CameraAxes] = Field(
        default=None,
        description=(
            "Camera axes of imported poses: opencv (x right, y down, z forward) or opengl (x right, y up, z back) "
            "(default: opengl in transforms files, opencv in COLMAP models)."
        ),
    )
    adjust_poses: bool = Field(
        default=True,
        description="Correct imported poses that do not fit the matches of their photos, in files without points.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        lt=2**31,
        description="Seed of matching and mapping.",
    )
    max_image_size: Auto[int] = Field(
        default=None,
        ge=100,
        description=(
            "Longer side in pixels at which features are extracted; larger photos are downscaled (default: 1600, "
            "less if --sfm.seconds or a budget leaves too little time)."
        ),
    )
    max_features: Auto[int] = Field(
        default=None,
        ge=100,
        description=(
            "Maximum number of features per photo, the largest first; matching time grows with its square "
            "(default: 4096, fewer if --sfm.seconds or a budget leaves too little time)."
        ),
    )
    camera_model: Auto[CameraModel] = Field(
        default=None,
        description=(
            "COLMAP camera model (default: SIMPLE_RADIAL for mapping, then the simplest one that held-out "
            "observations support)."
        ),
    )
    camera_params: Auto[tuple[float, ...]] = Field(
        default=None,
        description=(
            "Known parameters of --sfm.camera-model in COLMAP's order, which are not refined; they are those of one "
            "photo size, and are turned and rescaled for photos of other sizes (default: estimated)."
        ),
    )
    matcher: Auto[Matcher] = Field(
        default=None,
        description=(
            "How the first image pairs are selected: all pairs, by time, by GPS position, or by image retrieval "
            "(default: exhaustive for up to 50 photos, else sequential for frames of a video, spatial for photos with "
            "GPS that stand apart, else retrieval)."
        ),
    )
    neighbours: int = Field(
        default=30,
        ge=1,
        description="Pairs per photo when not all pairs are matched; more where few of a photo's pairs verify.",
    )
    max_strategies: int = Field(
        default=MAX_STRATEGIES,
        ge=1,
        le=MAX_STRATEGIES,
        description="How many strategies of the list to consider while images are unregistered, skipped ones "
        "included; 1 tries the default strategy only.",
    )
    seconds: Auto[float] = Field(
        default=None,
        gt=0,
        description=(
            "Time to aim for: fewer features are extracted if needed, and retry strategies that do not fit are "
            "skipped. Mapping is not aborted (default: no limit)."
        ),
    )
    max_seconds: float = Field(
        default=4 * 3600.0,
        gt=0,
        description="Abort after this many seconds; the matches are kept for the next run. Retry strategies that do "
        "not fit are skipped.",
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """Reading, features of each photo, matches of each pair, and mapping and adjusting, which have one core.

    Measured on two cores. Of up to MAX_EXHAUSTIVE photos it took 0.6 to 1.8 times as long (fox, fountain_p11, fern,
    banana, herzjesu_p8, the demo), and longer where images were not registered at once; of 120 (bonsai_120) as long.
    """
    photos, cores = workload.photos, workload.cores
    if config.cameras is not None:
        # Checked, given points, perhaps adjusted: of 11 to 125 photos 0.7 to 1.6 times as long (fountain_p11, fox,
        # lego_400, bonsai_120).
        return 5.0 + 0.3 * photos.number * 2 / cores + 0.1 * photos.number
    chosen = photos.number > MAX_EXHAUSTIVE and config.matcher != "exhaustive"
    pairs = 16.5 * photos.number if chosen else photos.number * (photos.number - 1) / 2
    extracted, matched = _done(workload.partial("sfm"))
    doubled = 4 if photos.megapixels < MAX_DOUBLED_MEGAPIXELS else 1
    features = 0.25 * max(0, photos.number - extracted) * min(doubled * photos.megapixels, 1.7)
    matching = (0.04 if chosen else 0.02) * max(0.0, pairs - matched)
    mapping = (0.8 if chosen else 0.4) * photos.number
    return 4.0 + photos.reading_seconds(cores) + (features + matching) * 2 / cores + mapping


def _done(partial: Path | None) -> tuple[int, int]:
    """How many photos have features and how many pairs are matched where the stage resumes."""
    if partial is None:
        return 0, 0
    from stages.sfm.registration import count_done, first_database

    return count_done(first_database(partial))


def budget_seconds(left: BudgetLeft) -> float:
    """At most half of the budget, and less where later stages need their minimum. Its time cannot be planned to the
    second, so later stages adapt to what it leaves."""
    return max(1.0, min(BUDGET_SHARE * left.total, left.free - left.reserved))


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose image size, number of features and matcher: by the time that some of the photos take on this machine."""
    if config.cameras is not None or None not in (config.max_image_size, config.max_features, config.matcher):
        return config
    from stages.sfm import reconstruction

    return reconstruction.choose_options(config, inputs["ingest"], progress)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write ``sparse/``, registration.json and, where photos form other groups, ``photo_groups/``. Raises StageError
    where no usable model comes out."""
    from stages.sfm import reconstruction

    folder.mkdir(parents=True, exist_ok=True)
    registration, skipped = reconstruction.find_cameras(config, inputs["ingest"], folder, progress)
    write_json(folder / "registration.json", registration)
    return StageResult(
        outputs=("sparse", "registration.json"),
        records=("sfm.log", *["photo_groups"] * (folder / "photo_groups").is_dir()),
        line=_line(registration) + skipped,
        facts={name: fact for name, fact in registration.items() if name not in ("images", "test_files")},
    )


def _line(registration: dict[str, Any]) -> str:
    """The stage's line."""
    what = "registered" if registration["source"] == "sfm" else "poses imported"
    what += " and adjusted" if (registration["check"] or {}).get("adjusted_from_px") is not None else ""
    error, points = registration["reprojection_px"], registration["points"]
    line = f"{registration['registered']}/{registration['photos']} {what}"
    if same := registration["near_duplicates"]:
        line += f", {counted(same, 'near-duplicate')} left out"
    line += "" if error is None else f", {error:.2f} px"
    line += f" · {registration['camera_model']}"
    return line + (f" · {points:,} points" if points else "")


STAGE = Stage(
    name="sfm",
    inputs=("ingest",),
    version=38,
    exit_code=11,
    resumes=True,
    published=("sparse", "registration.json", "photo_groups"),
    config=Config,
    # PHOTOS is for messages alone. Both limits may make the stage skip a retry strategy, ``max_seconds`` the check of
    # imported poses; it then says so. They stay out of the key, so that a run with another limit finds the matches of
    # the one before it and resumes from them. ``seconds`` also sets the quality of feature extraction, which enters the
    # key by options of its own (max_image_size, max_features).
    not_hashed=("photos", "max_seconds", "seconds"),
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    budget_seconds=budget_seconds,
    less_memory="a smaller --sfm.max-image-size or --sfm.max-features",
)
