"""A small set of synthetic photos with known cameras, drawn once per test run."""

from pathlib import Path
from typing import NamedTuple

import pytest

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
    return write_synthetic_photos(tmp_path_factory.mktemp("synthetic") / "photos")


def write_synthetic_photos(folder: Path) -> SyntheticPhotos:
    """The same in a folder of one's own."""
    poses = {f"photo_{index:03d}.jpg": pose for index, pose in enumerate(ring_of_cameras(36)[:12])}
    truth = Truth(LENS, poses, seed=0)
    write_photos(folder, truth, SilentDisplay())
    return SyntheticPhotos(folder, truth)
