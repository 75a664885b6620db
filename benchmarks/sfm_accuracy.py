"""How far the cameras that stage sfm finds are from measured ones, or from those that came with the photos.

    python -m benchmarks.sfm_accuracy DATA [--camera-model OPENCV] [--sets fountain_p11 herzjesu_p8 fox] [--turned 3]
        [--contrast 0.12]

DATA holds a folder per set: photos, and reference_cameras.json with K (px), world_from_camera_rotation and
camera_center_m for each. Printed are the mean and largest distance of the camera centres after the similarity that
fits them best, and the mean angle between the rotations, beside the seconds that sfm took.

With --turned N every Nth photo is as if it had been held upright: its file says so in EXIF, its pixels stay. What
is measured there knows nothing of EXIF, and so cameras are turned back for it.

With --contrast C the photos are as if seen through fog: C of their contrast, about FOG grey levels, and noise.

A set with a transforms.json instead, and photos in images/, has no truth but the cameras of another program: how far
both agree, centres in percent of the largest distance between two of the given ones.

On two busy cores, pycolmap 4.2.1, mean mm / mean degrees on fountain_p11 (11 photos) and herzjesu_p8 (8 photos):

    mapping alone (SIMPLE_RADIAL, principal point in the centre)   5.63 / 0.440    8.36 / 0.532
    + final adjustment, principal point still in the centre        5.62 / 0.447    8.14 / 0.520
    + model and principal point by held-out observations (default) 2.46 / 0.086    3.84 / 0.127
    RADIAL and its principal point refined, soft-L1 at 1 px        2.70 / 0.163    3.93 / 0.120
    the same with squared residuals                                3.09 / 0.248    4.01 / 0.120
    the same with OPENCV                                           2.73 / 0.256    4.25 / 0.188
    photos doubled before features are searched (squared)          2.79 / 0.096    4.19 / 0.144

Doubling the photos first took 4.5 times the time for features.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from benchmarks.record import Record, add_out
from nerf.geometry.alignment import align
from pipeline.cli.terminal import PlainDisplay
from stages import ingest, sfm
from stages.contract import run_stage
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.photos import Photo, read_photos
from stages.io.sparse_model import SparseModel
from stages.sfm.colmap.cameras import turned_pose
from stages.sfm.colmap.models import read_model
from stages.sfm.imported.pose_files import read_poses

UPRIGHT_HELD = 6  # EXIF's orientation
APP1 = b"\xff\xe1"  # the marker of a JPEG's segment with EXIF
FOG, NOISE = 110.0, 1.0  # grey levels


def errors(
    model: SparseModel, reference: dict[str, dict[str, list]], turns: dict[str, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the centres in millimetres and angles between the rotations in degrees, per photo; ``turns``: by
    file, how many quarter turns clockwise made it upright, where any did."""
    measured = [reference[image.file] for image in model.images]
    rotations = np.array([camera["world_from_camera_rotation"] for camera in measured])
    centres = np.array([camera["camera_center_m"] for camera in measured])
    poses = np.concatenate([rotations, centres[:, :, None]], axis=2)
    upright = [turned_pose(pose, turns.get(image.file, 0)) for pose, image in zip(poses, model.images, strict=True)]
    distances, degrees = apart(model, np.stack(upright))
    return 1000 * distances, degrees


def write_turned(photos: Path, folder: Path, every: int) -> None:
    """Copy JPEGs of landscape photos; every nth says that it was held upright."""
    folder.mkdir()
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = UPRIGHT_HELD
    segment = exif.tobytes()
    for number, photo in enumerate(sorted(photos.rglob("*.jpg"))):
        content = photo.read_bytes()
        if number % every == every - 1:
            content = content[:2] + APP1 + (len(segment) + 2).to_bytes(2, "big") + segment + content[2:]
        (folder / photo.name).write_bytes(content)


def write_foggy(photos: Path, folder: Path, contrast: float) -> None:
    """Copy JPEGs with less contrast."""
    folder.mkdir()
    random = np.random.default_rng(0)
    for photo in sorted(photos.rglob("*.jpg")):
        light = np.asarray(Image.open(photo), np.float32)
        seen = FOG + contrast * (light - FOG) + random.normal(0, NOISE, light.shape)
        Image.fromarray(np.rint(seen).clip(0, 255).astype(np.uint8)).save(folder / photo.name, quality=92)


def apart(model: SparseModel, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the centres and angles (degrees) of the model's images from poses (n, 3, 4) from the camera."""
    found = np.stack([image.sfm_from_camera for image in model.images])
    true_from_sfm = align(found[:, :, 3], true[:, :, 3])
    aligned = np.stack([true_from_sfm.pose(pose) for pose in found])
    cosines = (np.einsum("nij,nij->n", aligned[:, :, :3], true[:, :, :3]) - 1) / 2
    distances = np.linalg.norm(aligned[:, :, 3] - true[:, :, 3], axis=1)
    return distances, np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def agreement(model: SparseModel, transforms: Path, photos: list[Photo]) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the centres in percent of the largest between two given ones, and angles in degrees, per photo."""
    frames = json.loads(transforms.read_text())["frames"]
    names = {frame["file_path"]: Path(frame["file_path"]).name for frame in frames}
    given = {image.file: image.sfm_from_camera for image in read_poses(transforms, photos, names).model.images}
    poses = np.stack([given[image.file] for image in model.images])
    size = max(float(np.linalg.norm(poses[:, :, 3] - pose[:, 3], axis=1).max()) for pose in poses)
    distances, degrees = apart(model, poses)
    return 100 * distances / size, degrees


def measure(data: Path, config: sfm.Config, turned: int | None, contrast: float | None) -> dict[str, Any]:
    """Run ingest and sfm on one set; its row of the table."""
    transforms = data / "transforms.json"
    with tempfile.TemporaryDirectory() as scratch:
        folders = {name: Path(scratch, name) for name in ("ingest", "sfm")}
        folders["ingest"].mkdir()
        photos = data / "images" if transforms.exists() else data
        if turned:
            write_turned(photos, Path(scratch, "turned"), turned)
            photos = Path(scratch, "turned")
        if contrast:
            write_foggy(photos, Path(scratch, "foggy"), contrast)
            photos = Path(scratch, "foggy")
        ingest.run(ingest.Config(photos=photos), {}, folders["ingest"], PlainDisplay())
        begin = time.perf_counter()
        result = run_stage(sfm.STAGE, config, folders, folders["sfm"], PlainDisplay())
        seconds = time.perf_counter() - begin
        model = read_model(folders["sfm"] / "sparse")
        if transforms.exists():
            unit, (off, degrees) = "percent", agreement(model, transforms, read_photos(folders["ingest"]))
        else:
            reference = json.loads((data / "reference_cameras.json").read_text())
            turns = {photo.image_name: QUARTER_TURNS[photo.orientation] for photo in read_photos(folders["ingest"])}
            unit, (off, degrees) = "mm", errors(model, reference, turns)
    return {
        "set": data.name,
        **({"turned": turned} if turned else {}),
        **({"contrast": contrast} if contrast else {}),
        "registered": len(model.images),
        f"centres_{unit}": round(float(off.mean()), 3),
        f"centres_max_{unit}": round(float(off.max()), 3),
        "rotations_deg": round(float(degrees.mean()), 4),
        "seconds": round(seconds),
        "found": result.line,
    }


def main() -> None:
    """Measure every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="+", default=["fountain_p11", "herzjesu_p8"])
    parser.add_argument("--camera-model", default=None)
    parser.add_argument("--max-features", type=int, default=None)
    parser.add_argument("--max-image-size", type=int, default=None)
    parser.add_argument("--turned", type=int, default=None)
    parser.add_argument("--contrast", type=float, default=None)
    add_out(parser)
    arguments = parser.parse_args()
    record = Record(arguments.out)
    given = {name: getattr(arguments, name) for name in ("camera_model", "max_features", "max_image_size")}
    config = sfm.Config(**given)
    for name in arguments.sets:
        record.add(**measure(arguments.data / name, config, arguments.turned, arguments.contrast))


if __name__ == "__main__":
    main()
