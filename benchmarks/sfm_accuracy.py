"""How far the cameras that stage sfm finds are from measured ones.

    python benchmarks/sfm_accuracy.py DATA [--camera-model OPENCV] [--sets fountain_p11 herzjesu_p8]

DATA holds a folder per set: photos, and reference_cameras.json with K (px), world_from_camera_rotation and
camera_center_m for each. Printed are the mean and largest distance of the camera centres after the similarity that
fits them best, and the mean angle between the rotations, beside the seconds that sfm took.

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

import numpy as np

from nerf.alignment import align
from stages import ingest, sfm
from stages.colmap.models import read_model
from stages.sparse_model import SparseModel


class Quiet:
    """A Progress that passes on what stays."""

    def update(self, message: str, done: float | None = None) -> None:
        """Say nothing."""

    def note(self, message: str) -> None:
        """Print the note."""
        print(f"  {message}")


def errors(model: SparseModel, reference: dict[str, dict[str, list]]) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the centres in millimetres and angles between the rotations in degrees, per photo."""
    measured = [reference[image.file] for image in model.images]
    rotations = np.array([camera["world_from_camera_rotation"] for camera in measured])
    centres = np.array([camera["camera_center_m"] for camera in measured])
    found = np.stack([image.sfm_from_camera for image in model.images])
    world_from_sfm = align(found[:, :, 3], centres)
    aligned = np.stack([world_from_sfm.pose(pose) for pose in found])
    cosines = (np.einsum("nij,nij->n", aligned[:, :, :3], rotations) - 1) / 2
    distances = np.linalg.norm(aligned[:, :, 3] - centres, axis=1)
    return 1000 * distances, np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def measure(photos: Path, config: sfm.Config) -> None:
    """Run ingest and sfm on one set and print its line of the table."""
    reference = json.loads((photos / "reference_cameras.json").read_text())
    with tempfile.TemporaryDirectory() as scratch:
        folders = {name: Path(scratch, name) for name in ("ingest", "sfm")}
        folders["ingest"].mkdir()
        ingest.run(ingest.Config(photos=photos), {}, folders["ingest"], Quiet())
        begin = time.perf_counter()
        result = sfm.run(config, folders, folders["sfm"], Quiet())
        seconds = time.perf_counter() - begin
        model = read_model(folders["sfm"] / "sparse")
    millimetres, degrees = errors(model, reference)
    print(
        f"{photos.name:14s} {millimetres.mean():7.2f} {millimetres.max():7.2f} {degrees.mean():8.3f} {seconds:6.0f}  "
        f"{result.line}"
    )


def main() -> None:
    """Measure every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="+", default=["fountain_p11", "herzjesu_p8"])
    parser.add_argument("--camera-model", default=None)
    parser.add_argument("--max-features", type=int, default=sfm.Config().max_features)
    arguments = parser.parse_args()
    config = sfm.Config(camera_model=arguments.camera_model, max_features=arguments.max_features)
    print(f"{'set':14s} {'mean mm':>7s} {'max mm':>7s} {'mean deg':>8s} {'s':>6s}")
    for name in arguments.sets:
        measure(arguments.data / name, config)


if __name__ == "__main__":
    main()
