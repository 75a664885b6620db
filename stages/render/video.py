"""The cameras of a video, the number and size of its frames, and the video itself."""

import difflib
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays, join_rays
from nerf.geometry.scene import Scene
from stages.contract import Inputs, Progress, StageError
from stages.effects.image_effects import new_view_like, new_view_words, photo_effects
from stages.hardware.memory import check_memory
from stages.io.amounts import duration, short_count
from stages.io.files import read_json, read_scene, write_png
from stages.io.photos import spread
from stages.io.transforms_export import intrinsics, opengl_matrix
from stages.io.video import video_writer
from stages.render.path import CameraPath, default_path, make_path, path_from_file, path_rays
from stages.render.planning import MIN_FRAMES, SMALL_SIDE, choose_frames_and_width, default_fps, max_useful_side
from stages.render.renderer import Renderer, TimeBudget, measured_speed

if TYPE_CHECKING:
    from stages.render import Config

STARTING_SECONDS = 1.0  # to load the field again and to write the small files
TIMED_VIEWS = 4  # of the path, to measure how fast the field renders them
BYTES_PER_PIXEL = 200  # of a frame while it is rendered and written: rays, colours, depth; 105 to 195 measured
WRITING_SECONDS = 1.5e-7  # to encode a pixel of video.mp4 and of depth.mp4 (x264 with one thread: 13 million a second)


def planned(config: "Config", inputs: Inputs, progress: Progress) -> "Config":
    """Choose path, frames, width and fps; frames and width by how fast this machine renders along the path."""
    _check(config)
    scene = read_scene(inputs["normalise"])
    if config.cameras is None:
        config = config.model_copy(update={"path": config.path or default_path(scene)})
    path = camera_path(config, scene)
    frames = len(path.cameras) if config.cameras else config.frames
    width = config.width
    if frames is None or width is None:
        downscale = 1 if config.cameras else read_json(inputs["train"] / "field.json")["downscale"]
        time_budget = TimeBudget(config.seconds, inputs["train"], STARTING_SECONDS)
        frames, width = _choose_frames_and_width(
            path, scene, inputs["train"], downscale, (frames, width), time_budget, progress
        )
    kept, fps = None if config.cameras else frames, config.fps or path.fps or default_fps(frames)
    return config.model_copy(update={"frames": kept, "width": width, "fps": fps})


def _choose_frames_and_width(
    path: CameraPath,
    scene: Scene,
    train: Path,
    downscale: float,
    given: tuple[int | None, int | None],
    time_budget: TimeBudget,
    progress: Progress,
) -> tuple[int, int]:
    """(frames, width): as given, or as many and as large as the time budget allows."""
    camera = path.cameras[0]
    progress.update("measuring rendering speed")
    longest = max_useful_side(camera, downscale)
    rendered = measured_speed(train, lambda side: _timed_rays(path, scene, side), int(longest))
    speed = 1 / (1 / rendered + WRITING_SECONDS)
    frames, width = choose_frames_and_width(time_budget.seconds_left() * speed, camera, longest, *given)
    progress.note("render.size", _choice_message(path.resized(width), frames, speed, time_budget, given))
    return frames, width


def _timed_rays(path: CameraPath, scene: Scene, side: int) -> Rays:
    """Rays of a few frames, reduced to a long side of ``side`` pixels, one above the other."""
    camera = path.cameras[0]
    count = len(path.cameras)
    few = path.select(sorted(set(spread(count, TIMED_VIEWS))))
    width = max(2, 2 * round(side * camera.width / max(camera.width, camera.height) / 2))
    return join_rays(path_rays(few.resized(width), scene))


def _choice_message(
    path: CameraPath, frames: int, rays_per_second: float, time_budget: TimeBudget, given: tuple[int | None, int | None]
) -> str:
    """What was chosen, how long it takes, and whether that is more time or a smaller video than usual."""
    camera = path.cameras[0]
    seconds = frames * camera.width * camera.height / rays_per_second
    size = f"{frames} frames {camera.width}×{camera.height}"
    message = (
        f"{short_count(rays_per_second)} rays/s here: {size} take about {duration(seconds)}, {time_budget.message()}"
    )
    if seconds > (time_budget.given or time_budget.trained):
        return f"{message}; that is longer, {'as requested' if any(given) else 'but there is no smaller video'}"
    small = (given[0] is None and frames < MIN_FRAMES) or (
        given[1] is None and max(camera.width, camera.height) < SMALL_SIDE - 2
    )
    return (
        f"{message}; more would take too long: use --render.frames and --render.width to get it" if small else message
    )


def _check(config: "Config") -> None:
    if config.cameras is not None and (config.path or config.frames):
        raise StageError(
            "render.cameras-and-path",
            "--render.cameras excludes --render.path and --render.frames",
            "the file contains all cameras of the video",
            "Leave out one of them.",
        )


def check_frame_memory(path: CameraPath) -> None:
    """Raises StageError if there is no memory for a single frame."""
    camera = max(path.cameras, key=lambda camera: camera.width * camera.height)
    size = f"{camera.width}×{camera.height}"
    needed, hint = BYTES_PER_PIXEL * camera.width * camera.height, f"Try --render.width {camera.width // 2}."
    check_memory(needed, "the video", f"rendering a frame of {size} takes", hint)


def camera_path(config: "Config", scene: Scene) -> CameraPath:
    """The cameras to render; of a path whose length is still open, MIN_FRAMES."""
    if config.cameras is not None:
        return path_from_file(scene, config.cameras)
    assert config.path is not None
    return make_path(scene, config.path, config.frames or MIN_FRAMES)


def render_path(path: CameraPath, scene: Scene, renderer: Renderer, progress: Progress) -> Iterator[Rendering]:
    """The frames, one by one, on the CPU."""
    count, started = len(path.cameras), time.perf_counter()
    for index, rays in enumerate(path_rays(path, scene)):

        def on_chunk(fraction: float, index: int = index) -> None:
            done = (index + fraction) / count
            left = (time.perf_counter() - started) * (1 - done) / done
            progress.update(f"frame {index + 1} of {count} · {duration(left)} left", done)

        yield renderer.render(rays, on_chunk)


def write_videos(renderings: Iterator[Rendering], path: CameraPath, config: "Config", folder: Path) -> list[str]:
    """Encode frames as they come; depth afterwards, as its colours need the range over the whole video."""
    assert config.fps is not None
    height, width = path.cameras[0].height, path.cameras[0].width
    if config.save_frames:
        (folder / "frames").mkdir()
    temporary = folder / "inverse_depth.tmp"
    # Not memory-mapped: on a full disk a write raises OSError, where a mapping would kill the process.
    with (
        temporary.open("wb") if config.depth else nullcontext() as depths,
        video_writer(folder / "video.mp4", width, height, config.fps) as add,
    ):
        for index, rendering in enumerate(renderings):
            frame = (rendering.colour.clamp(0, 1) * 255).round().byte().numpy()
            add(frame)
            if depths is not None:
                depths.write((1 / rendering.depth.numpy()).astype(np.float16).data)
            if config.save_frames:
                write_png(folder / "frames" / f"{index:05d}.png", frame)
    if config.depth:
        inverse = np.memmap(temporary, np.float16, "r", shape=(len(path.cameras), height, width))
        _write_depth(inverse, folder / "depth.mp4", config.fps)
        temporary.unlink()
    return ["video.mp4"] + ["depth.mp4"] * config.depth + ["frames"] * config.save_frames


def _write_depth(inverse: np.ndarray, file: Path, fps: int) -> None:
    """Inverse depth in colour, near red, far blue (turbo), on one scale from its 1 % to its 99 % quantile."""
    _, height, width = inverse.shape
    sample = inverse[:, :: max(1, height // 64), :: max(1, width // 64)].astype(np.float32)
    low, high = np.quantile(sample, [0.01, 0.99])
    span = high - low if high > low else 1.0
    with video_writer(file, width, height, fps) as add:
        for frame in inverse:
            level = np.clip((frame.astype(np.float32) - low) / span, 0, 1)
            bgr = cv2.applyColorMap(np.rint(255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
            add(np.ascontiguousarray(bgr[..., ::-1]))


def path_json(path: CameraPath, scene: Scene, fps: int) -> dict[str, Any]:
    """The path in the sfm frame, in a form that --render.cameras reads back."""
    sfm_from_scene = scene.scene_from_sfm.inverse()
    shared = len(set(path.cameras)) == 1
    frames = [
        ({} if shared else intrinsics(camera))
        | {"file_path": f"{index:05d}", "transform_matrix": opengl_matrix(sfm_from_scene.pose(pose))}
        for index, (camera, pose) in enumerate(zip(path.cameras, path.poses, strict=True))
    ]
    return (intrinsics(path.cameras[0]) if shared else {}) | {"fps": fps, "frames": frames}


def with_appearance(
    renderer: Renderer, photo: str | None, train: Path, scene: Scene, progress: Progress
) -> tuple[Renderer, str | None]:
    """The renderer of the video, and the appearance that it renders; None without colour effects.

    A photo without a known appearance is no error, as training is finished by then; a note says what is used instead.
    """
    field = read_json(train / "field.json")
    description = new_view_words(field)
    if photo is None:
        return renderer, description
    if "exposure" not in field["effects"]:
        progress.note(
            "render.no-exposure",
            f"the field has no exposure model: all photos, including {photo}, get the same exposure",
        )
        return renderer, description
    view = next((view for view in scene.views if view.name == photo), None)
    if view is None:
        similar = difflib.get_close_matches(photo, [view.name for view in scene.views], n=3)
        suggestion = f"; did you mean {' or '.join(similar)}?" if similar else ""
        progress.note("render.no-such-photo", f"there is no registered photo {photo}: {description}{suggestion}")
        return renderer, description
    as_photo = renderer.through(new_view_like(photo_effects(field, scene, view, renderer.device)))
    if any(photo in rows for rows in field["effects"].values()):
        return as_photo, f"exposed like {photo}"
    progress.note(
        "render.expected-exposure",
        f"{photo} is not a training photo: its exposure is estimated from the nearest training photos",
    )
    return as_photo, f"exposed as estimated for {photo}"


def facts(config: "Config", path: CameraPath) -> dict[str, Any]:
    """Of the video, for its line and the report."""
    camera = path.cameras[0]
    return {
        "path": config.path or "cameras from a file",
        "frames": len(path.cameras),
        "width": camera.width,
        "height": camera.height,
        "fps": config.fps,
    }
