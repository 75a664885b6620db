"""Stage render: a video of the field, and one of its depth."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages.contract import Inputs, Progress, StageConfig, StageError, StageResult
from stages.files import read_json, read_scene, write_json
from stages.render_path import BY_LAYOUT, CameraPath, PathKind, fitted_path, median_camera, path_from_file
from stages.render_plan import affordable, chosen_fps

if TYPE_CHECKING:
    import numpy as np

    from nerf.model import RadianceModel, Rendering
    from nerf.scene import Scene

NEEDS = ("normalise", "train")
VERSION = 1
RESUMES = False
LINKS = ("video.mp4", "depth.mp4", "path.json")

CHUNK = {"cpu": 512, "cuda": 8192}  # rays between two words to the user: a second of the published field on a laptop


class Config(StageConfig):
    """Settings of stage render. What is None is chosen, so that rendering costs no more than training did."""

    path: PathKind | None = Field(
        default=None,
        description="none: orbit around an object, spiral before a scene, interpolated within one",
    )
    cameras: Path | None = Field(
        default=None,
        description="poses and intrinsics instead of a path: a transforms.json in the frame of output/transforms.json, "
        "or a path.json of ours",
    )
    frames: int | None = Field(default=None, ge=2, description="none: 24 to 120")
    width: int | None = Field(default=None, ge=16, le=8192, description="pixels; odd numbers are rounded to even ones")
    fps: int | None = Field(default=None, ge=1, le=120, description="none: 30, fewer for fewer than 120 frames")
    depth: bool = Field(default=True, description="write depth.mp4 too")
    save_frames: bool = Field(default=False, description="keep every frame as PNG in frames/")


def plan(config: Config, inputs: Inputs) -> Config:
    """Choose path, frames, width and fps. Counts rays, not seconds: the same training gives the same plan."""
    _check(config)
    scene, info = read_scene(inputs["normalise"]), read_json(inputs["train"] / "field.json")
    if config.cameras is None:
        camera, frames = median_camera(scene), config.frames
        path = config.path or BY_LAYOUT[scene.layout]
    else:
        given = path_from_file(scene, config.cameras)
        camera, frames, path = given.cameras[0], len(given.cameras), None
    longest = max(camera.width, camera.height) / (info["downscale"] if config.cameras is None else 1)
    frames, width = affordable(info["rays"], camera, longest, frames, config.width)
    fps = config.fps or chosen_fps(frames)
    kept = None if config.cameras else frames
    return config.model_copy(update={"path": path, "frames": kept, "width": width, "fps": fps})


def _check(config: Config) -> None:
    if config.cameras is not None and (config.path or config.frames):
        raise StageError(
            "--render.cameras excludes --render.path and --render.frames",
            "the file says where the cameras stand and how many there are",
            "Leave out one of them.",
        )


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Render the path and write video.mp4, depth.mp4, path.json and, if asked, frames/."""
    from stages.device import compute_device
    from stages.field_files import load_field

    config = plan(config, inputs)
    assert config.width is not None and config.fps is not None
    scene = read_scene(inputs["normalise"])
    model, info = load_field(inputs["train"], compute_device())
    path = _path(config, scene).resized(config.width)
    write_json(folder / "path.json", _path_json(path, scene, config.fps))
    started = time.perf_counter()
    renderings = _render(path, scene, model, info["background"], progress)
    outputs = ("path.json", *_write(renderings, path, config, folder))
    frames_per_second = len(path.cameras) / (time.perf_counter() - started)
    write_json(folder / "speed.json", {"frames_per_second": frames_per_second})
    facts = _facts(config, path)
    line = f"{facts['path']}, {facts['frames']} frames {facts['width']}×{facts['height']}"
    return StageResult(outputs, f"{line} · {frames_per_second:.2g} frames/s", ("speed.json",), facts)


def _path(config: Config, scene: "Scene") -> CameraPath:
    if config.cameras is not None:
        return path_from_file(scene, config.cameras)
    assert config.path is not None and config.frames is not None
    return fitted_path(scene, config.path, config.frames)


def _render(
    path: CameraPath, scene: "Scene", model: "RadianceModel", background: list[float], progress: Progress
) -> "Iterator[Rendering]":
    """The frames, one by one, on the CPU."""
    import numpy as np
    import torch

    from nerf.depth_range import range_between_views
    from nerf.model import Rendering
    from nerf.rays import Rays, rays_of_view
    from nerf.rendering import render_image
    from stages.colmap import camera_rays
    from stages.device import compute_device

    device = compute_device()
    views = scene.of_split("train")
    near, far = range_between_views(
        path.poses[:, :, 3],
        np.stack([view.scene_from_camera[:, 3] for view in views]),
        np.array([view.near for view in views]),
        np.array([view.far for view in views]),
        scene.bounded,
    )
    bearings = {
        camera: torch.from_numpy(camera_rays(camera, camera.width, camera.height)) for camera in set(path.cameras)
    }
    count, started = len(path.cameras), time.perf_counter()
    for index, camera in enumerate(path.cameras):
        pose = torch.from_numpy(path.poses[index]).float()
        rays = rays_of_view(bearings[camera], pose, float(near[index]), float(far[index]))

        def on_chunk(share: float, index: int = index) -> None:
            done = (index + share) / count
            left = (time.perf_counter() - started) * (1 - done) / done
            progress.update(f"frame {index + 1} of {count} · {left:.0f} s left", done)

        image = render_image(
            model,
            Rays(*(part.to(device) for part in rays)),
            torch.tensor(background, device=device),
            chunk=CHUNK[device],
            on_chunk=on_chunk,
        )
        yield Rendering(*(part.cpu() for part in image))


def _write(renderings: "Iterator[Rendering]", path: CameraPath, config: Config, folder: Path) -> list[str]:
    """Encode frames as they come; depth afterwards, for its colours need the range over the whole video."""
    import numpy as np

    from stages.video import video_writer

    assert config.fps is not None
    height, width = path.cameras[0].height, path.cameras[0].width
    if config.save_frames:
        (folder / "frames").mkdir()
    waiting = folder / "inverse_depth.tmp"
    inverse = np.memmap(waiting, np.float16, "w+", shape=(len(path.cameras), height, width))
    with video_writer(folder / "video.mp4", width, height, config.fps) as add:
        for index, rendering in enumerate(renderings):
            frame = (rendering.colour.clamp(0, 1) * 255).round().byte().numpy()
            add(frame)
            inverse[index] = 1 / rendering.depth.numpy()
            if config.save_frames:
                _write_png(folder / "frames" / f"{index:05d}.png", frame)
    if config.depth:
        _write_depth(inverse, folder / "depth.mp4", config.fps)
    waiting.unlink()
    return ["video.mp4"] + ["depth.mp4"] * config.depth + ["frames"] * config.save_frames


def _write_depth(inverse: "np.ndarray", file: Path, fps: int) -> None:
    """Inverse depth in colour, near red, far blue (turbo), on one scale from its 1 % to its 99 % quantile."""
    import cv2
    import numpy as np

    from stages.video import video_writer

    _, height, width = inverse.shape
    sample = inverse[:, :: max(1, height // 64), :: max(1, width // 64)].astype(np.float32)
    low, high = np.quantile(sample, [0.01, 0.99])
    span = high - low if high > low else 1.0
    with video_writer(file, width, height, fps) as add:
        for frame in inverse:
            level = np.clip((frame.astype(np.float32) - low) / span, 0, 1)
            bgr = cv2.applyColorMap(np.rint(255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
            add(np.ascontiguousarray(bgr[..., ::-1]))


def _write_png(file: Path, frame: "np.ndarray") -> None:
    from PIL import Image

    Image.fromarray(frame).save(file)


def _path_json(path: CameraPath, scene: "Scene", fps: int) -> dict[str, Any]:
    """The path in the sfm frame, in a form that --render.cameras reads back."""
    from stages.transforms_export import intrinsics, opengl_matrix

    sfm_from_scene = scene.scene_from_sfm.inverse()
    shared = len(set(path.cameras)) == 1
    frames = [
        ({} if shared else intrinsics(camera))
        | {"file_path": f"{index:05d}", "transform_matrix": opengl_matrix(sfm_from_scene.pose(pose))}
        for index, (camera, pose) in enumerate(zip(path.cameras, path.poses, strict=True))
    ]
    return (intrinsics(path.cameras[0]) if shared else {}) | {"fps": fps, "frames": frames}


def _facts(config: Config, path: CameraPath) -> dict[str, Any]:
    camera = path.cameras[0]
    return {
        "path": config.path or "cameras from a file",
        "frames": len(path.cameras),
        "width": camera.width,
        "height": camera.height,
        "fps": config.fps,
    }
