"""Exposure brackets: the middle exposure of each place, against all of them with exposure modelled.

    python -m benchmarks.brackets ../shared/data/fountain_p11 --folder F --out benchmarks/results/brackets.json

Every photo becomes three (0, -2, +2 EV in linear light, clipped, 8 bits). Of every third place, three times another
third, the middle exposure is a test photo and the others are unused; cameras are the measured ones. Both trainings take
as many steps of as many colours.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

from benchmarks.record import Record, add_out
from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from pipeline.cli.commands import run_command
from stages.ingest import conversion
from stages.io.files import read_json

STOPS, FOLDS, WIDTH = (0, -2, 2), 3, 320
SMALL_STEPS = ("--train.downscale", "1", "--train.grid.target-samples", "8192")
EFFECTS = ("--effect", "view_dependence=on", "--effect", "background=on")
FIGURES = ("psnr", "ssim", "psnr_right_half", "psnr_exposure_fitted")


class Arm(NamedTuple):
    """What is trained on, in stops, and whether exposure is modelled."""

    name: str
    stops: tuple[int, ...]
    exposure: str


ARMS = (Arm("middle kept", (0,), "off"), Arm("all kept", STOPS, "on"))


def write_set(data: Path, folder: Path, fold: int, arm: Arm) -> None:
    """Photos of one arm and their transforms.json."""
    (folder / "images").mkdir(parents=True)
    frames, names = [], {"train": list[str](), "test": list[str]()}
    for place, (name, camera) in enumerate(sorted(read_json(data / "reference_cameras.json").items())):
        photo = Image.open(data / "images" / name).convert("RGB")
        scale = WIDTH / photo.width
        photo = photo.resize((WIDTH, round(photo.height * scale)), Image.Resampling.LANCZOS)
        light = srgb_to_linear(torch.from_numpy(np.array(photo)).float() / 255)
        split = "test" if place % FOLDS == fold else "train"
        for stops in (0,) if split == "test" else arm.stops:
            file = f"images/{place:03d}_{STOPS.index(stops)}.png"
            exposed = linear_to_srgb((light * 2.0**stops).clamp(0, 1)).numpy()
            Image.fromarray(np.rint(exposed * 255).astype(np.uint8)).save(folder / file)
            names[split].append(file)
            frames.append({"file_path": file, **_camera(camera, scale, *photo.size)})
    splits = {"train_filenames": names["train"], "val_filenames": names["test"], "test_filenames": names["test"]}
    (folder / "transforms.json").write_text(json.dumps({"frames": frames} | splits))


def _camera(camera: dict[str, Any], scale: float, width: int, height: int) -> dict[str, Any]:
    """A measured camera as a frame of a transforms file."""
    matrix = np.array(camera["K"]) * scale
    left, _, right = np.linalg.svd(np.array(camera["world_from_camera_rotation"]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = left @ right @ np.diag([1.0, -1.0, -1.0]), camera["camera_center_m"]
    intrinsics = {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    return intrinsics | {"w": width, "h": height, "transform_matrix": pose.tolist()}


def main() -> None:
    """Train and score both arms on every fold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a set with reference_cameras.json")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1500)
    add_out(parser)
    given = parser.parse_args()
    conversion.near_duplicates = lambda *_: {}  # all are kept
    record = Record(given.out)
    for fold in range(FOLDS):
        for arm in ARMS:
            photos, workspace = given.folder / "photos", given.folder / "w.nerf"
            for old in (photos, workspace):
                shutil.rmtree(old, ignore_errors=True)
            write_set(given.data, photos, fold, arm)
            words = ["run", str(photos), "--cameras", str(photos / "transforms.json"), "-o", str(workspace)]
            words += ["--until", "evaluate", "--train.steps", str(given.steps), *SMALL_STEPS, *EFFECTS]
            run_command([*words, "--effect", f"exposure={arm.exposure}", "--evaluate.fraction", "1"])
            metrics = read_json(workspace / "output" / "metrics.json")
            figures = {key: round(metrics[key], 3) for key in FIGURES}
            record.add(set=given.data.name, fold=fold, trained_on=arm.name, photos=metrics["photos_scored"], **figures)


if __name__ == "__main__":
    main()
