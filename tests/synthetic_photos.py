"""A small set of synthetic photos with known cameras, drawn once per test run."""

import os
from pathlib import Path
from typing import NamedTuple

import pytest
from filelock import FileLock

from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import ring_of_cameras
from pipeline.demo import write_photos
from pipeline.demo.truth import Truth
from pipeline.engine.display import SilentDisplay

LENS = Camera("OPENCV", 240, 180, (250.5, 249.75, 120.6, 89.65, -0.085, 0.032, 0.0011, -0.0008))


class SyntheticPhotos(NamedTuple):
    """Photos of the demo's still life, taken along a third of a circle, and the truth about them."""

    folder: Path
    truth: Truth


@pytest.fixture(scope="session")
def synthetic_photos(tmp_path_factory: pytest.TempPathFactory) -> SyntheticPhotos:
    """Twelve photos of 240 × 180 with exact cameras. Do not write into the folder: all tests share it."""
    folder = of_all_workers(tmp_path_factory) / "synthetic"
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            partial = folder.with_suffix(".partial")
            write_synthetic_photos(partial / "photos")
            partial.rename(folder)
    return SyntheticPhotos(folder / "photos", synthetic_truth())


def write_synthetic_photos(folder: Path) -> SyntheticPhotos:
    """The same in a folder of one's own."""
    write_photos(folder, synthetic_truth(), SilentDisplay())
    return SyntheticPhotos(folder, synthetic_truth())


def synthetic_truth() -> Truth:
    """Of these photos."""
    poses = {f"photo_{index:03d}.jpg": pose for index, pose in enumerate(ring_of_cameras(36)[:12])}
    return Truth(LENS, poses, seed=0)


def of_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of this test run, which the worker processes of pytest-xdist share; each has one of its own in it."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
