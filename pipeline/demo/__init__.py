"""``pipeline demo``: photos of a synthetic still life whose cameras and surfaces are known exactly."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerf.geometry.scene import Camera
from nerf.synthetic import scenes
from nerf.synthetic.scenes import SyntheticScene, ring_of_cameras, still_life
from pipeline.demo.truth import Truth, compare_with_truth
from pipeline.engine.settings import Settings
from stages.contract import Progress, StageError
from stages.io.files import read_json
from stages.sfm.colmap.cameras import camera_rays
from stages.train import Config as TrainConfig

PHOTOS = 40
SEED = 0
# A wide-angle lens with visible barrel distortion, slightly decentred: parameters fx, fy, cx, cy, k1, k2, p1, p2.
LENS = Camera("OPENCV", 480, 360, (501.0, 499.5, 241.2, 179.3, -0.085, 0.032, 0.0011, -0.0008))
SAMPLES_PER_SIDE = 2
JPEG_QUALITY = 95
TRAIN_SECONDS = 75.0


def default_settings() -> Settings:
    """What the demo runs with unless flags say otherwise: a training short enough for five minutes in all."""
    return Settings(train=TrainConfig(seconds=TRAIN_SECONDS))


def photograph(folder: Path, progress: Progress) -> tuple[str, float]:
    """Write the demo's photos into ``folder`` and truth.json beside it, unless they are there already.

    Returns a line for the user and the seconds it took, 0 if nothing was to be done. Raises StageError if the
    folder holds anything else, or cannot be written.
    """
    truth = demo_truth(LENS, PHOTOS, SEED)
    line = f"{PHOTOS} photos {LENS.width}×{LENS.height} of a still life with known cameras and surfaces"
    try:
        _reject_foreign_files(folder, truth)
        if _is_done(folder, truth):
            return line, 0.0
        started = time.monotonic()
        write_photos(folder, truth, progress)
    except OSError as error:
        raise _cannot_write(folder, error.strerror or str(error), "a writable folder with free space") from error
    return line, time.monotonic() - started


def demo_truth(lens: Camera, count: int, seed: int) -> Truth:
    """``count`` photos around the still life of ``seed``, all taken with one camera."""
    poses = {f"photo_{index:03d}.jpg": pose for index, pose in enumerate(ring_of_cameras(count, seed))}
    return Truth(lens, poses, seed)


def write_photos(folder: Path, truth: Truth, progress: Progress) -> None:
    """Draw every photo of ``truth`` into ``folder``; truth.json beside it comes last and marks them complete."""
    folder.mkdir(parents=True, exist_ok=True)
    truth_file(folder).unlink(missing_ok=True)
    scene, directions = _scene_and_directions(truth)
    threads = torch.get_num_threads()
    # Whole photos side by side: threads that share one photo mostly wait for each other.
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            work = pool.map(lambda name: _draw(folder / name, scene, directions, truth.poses[name]), truth.poses)
            for number, _ in enumerate(work, start=1):
                progress.update(f"photo {number} of {len(truth.poses)}", number / len(truth.poses))
    finally:
        torch.set_num_threads(threads)
    truth.write(truth_file(folder))


def _scene_and_directions(truth: Truth) -> tuple[SyntheticScene, torch.Tensor]:
    """The scene, and the unit ray directions of a grid of points inside every pixel, lens distortion included."""
    camera = truth.camera
    rays = camera_rays(camera, SAMPLES_PER_SIDE * camera.width, SAMPLES_PER_SIDE * camera.height)
    return still_life(truth.seed), torch.from_numpy(rays)


def _draw(path: Path, scene: SyntheticScene, directions: torch.Tensor, pose: np.ndarray) -> None:
    with torch.inference_mode():
        image = scenes.photograph(scene, directions, torch.tensor(pose, dtype=torch.float32), SAMPLES_PER_SIDE)
    pixels = (255 * image).round().byte().numpy()
    Image.fromarray(pixels).save(path, quality=JPEG_QUALITY, subsampling=0)


def truth_file(photos: Path) -> Path:
    """Where the truth about the photos of a folder is written: beside the folder, for no stage may see it."""
    return photos.parent / "truth.json"


def truth_lines(output: Path, photos: Path) -> list[str]:
    """How far the results in a workspace's output folder are from the truth, for the user to read."""
    return compare_with_truth(output, Truth.read(truth_file(photos))).lines()


def _is_done(folder: Path, truth: Truth) -> bool:
    try:
        known = read_json(truth_file(folder))
    except StageError:  # not there, or its writing was cut short
        return False
    return known == truth.to_json() and all((folder / name).is_file() for name in truth.poses)


def _reject_foreign_files(folder: Path, truth: Truth) -> None:
    others = sorted(p.name for p in folder.iterdir() if p.name not in truth.poses) if folder.is_dir() else []
    if others:
        raise _cannot_write(folder, f"it holds {others[0]}, which is none of the demo's photos", "an empty folder")


def _cannot_write(folder: Path, why: str, better: str) -> StageError:
    return StageError(
        "pipeline.demo-not-written",
        f"cannot write the demo's photos to {folder}",
        why,
        f"Give {better}: pipeline demo -o FOLDER",
    )
