"""Stage render: a video of the field, and one of its depth."""

import time
from pathlib import Path

from pydantic import Field, field_validator

from stages.contract import Auto, Flexible, Inputs, Progress, Stage, StageConfig, StageResult, Workload
from stages.io.files import read_scene, write_json
from stages.render.planning import MAX_GIVEN_FPS, MIN_WIDTH, PathKind, even_width
from stages.train import trained_seconds


class Config(StageConfig):
    """The video. Its default size takes less time to render than the field took to train."""

    path: Auto[PathKind] = Field(
        default=None,
        description=(
            "Camera path (default: orbit around an object, spiral for a forward-facing capture, else interpolated)."
        ),
    )
    cameras: Auto[Path] = Field(
        default=None,
        description=(
            "Render the cameras in this file instead of a path: a transforms.json in the frame of "
            "output/transforms.json, or a path.json of this stage (default: a path)."
        ),
    )
    frames: Auto[int] = Field(
        default=None, ge=2, description="Number of frames (default: as time allows, usually 24 to 120)."
    )
    width: Auto[int] = Field(
        default=None,
        ge=MIN_WIDTH,
        le=8192,
        description="Width in pixels, rounded to an even number (default: as time allows).",
    )
    fps: Auto[int] = Field(
        default=None,
        ge=1,
        le=MAX_GIVEN_FPS,
        description="Frames per second (default: that of --render.cameras; else 30, fewer for fewer than 120 frames).",
    )
    seconds: Auto[float] = Field(
        default=None,
        gt=0,
        description="Time limit in seconds (default: 30% of the training time).",
    )
    depth: bool = Field(default=True, description="Also write depth.mp4.")
    match_exposure: Auto[str] = Field(
        default=None,
        description=(
            "Render with the exposure of this photo (its name), if the field models exposure (default: the "
            "reference exposure)."
        ),
    )
    save_frames: bool = Field(default=False, description="Also save every frame as a PNG file in frames/.")

    @field_validator("cameras")
    @classmethod
    def _absolute(cls, cameras: Path | None) -> Path | None:
        """Later commands may be given in another folder."""
        return cameras and cameras.absolute()

    @field_validator("width")
    @classmethod
    def _even(cls, width: int | None) -> int | None:
        """Video codecs need even sides."""
        return width and even_width(width)


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """About a quarter of the training's seconds (fox, fountain_p11 and the demo, after three minutes)."""
    if config.seconds is not None:
        return config.seconds
    trained = trained_seconds(workload)
    return None if trained is None else 0.27 * trained


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose path, frames, width and fps; frames and width by how fast this machine renders along the path."""
    from stages.render.video import planned

    return planned(config, inputs, progress)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Render the path and write video.mp4, depth.mp4, path.json and, if asked, frames/."""
    from stages.render import video
    from stages.render.renderer import load_renderer

    assert config.width is not None and config.fps is not None, "plan() chooses them"
    scene = read_scene(inputs["normalise"])
    renderer = load_renderer(inputs["train"], progress=progress)
    renderer, appearance = video.with_appearance(renderer, config.match_exposure, inputs["train"], scene, progress)
    path = video.camera_path(config, scene).resized(config.width)
    video.check_frame_memory(path)
    write_json(folder / "path.json", video.path_json(path, scene, config.fps))
    started = time.perf_counter()
    renderings = video.render_path(path, scene, renderer, progress)
    outputs = ("path.json", *video.write_videos(renderings, path, config, folder))
    frames_per_second = len(path.cameras) / (time.perf_counter() - started)
    write_json(folder / "speed.json", {"frames_per_second": frames_per_second})
    facts = video.facts(config, path) | ({} if appearance is None else {"appearance": appearance})
    summary = f"{facts['path']}, {facts['frames']} frames {facts['width']}×{facts['height']}"
    summary += "" if appearance is None else f" · {appearance}"
    return StageResult(outputs, f"{summary} · rendered at {frames_per_second:.2g} frames/s", ("speed.json",), facts)


STAGE = Stage(
    name="render",
    inputs=("normalise", "train"),
    version=16,
    exit_code=16,
    published=("video.mp4", "depth.mp4", "path.json"),
    config=Config,
    not_hashed=("seconds",),  # it decides how many frames and how large, and these enter the key
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    flexible=Flexible(share=0.15, min_seconds=4.0, max_seconds=300.0),
    less_memory="a smaller --render.width",
)
