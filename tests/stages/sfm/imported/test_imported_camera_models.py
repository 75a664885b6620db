"""Given cameras whose lens folds in the corners of the photo: few are left out by name, most end the import."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerf.geometry.scene import Camera
from stages.io.photos import Photo
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import camera_rays
from stages.sfm.colmap.models import write_model
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.pose_files import read_poses
from tests.camera_layouts import ring
from tests.refusals import refused

W, H = 600, 400
BENT = -0.2939  # as k1: no ray for the outermost pixels of the corners, the outer 1.4 % of the diagonals
LENS = (500.0, 500.0, W / 2, H / 2)
LOST = "0.485% of the pixels"


def photos(count: int) -> list[Photo]:
    return [Photo(f"{i}.jpg", f"images/{i}.jpg", W, H, 0, None, None, False, 1.0) for i in range(count)]


def from_transforms(folder: Path, bent: list[int], count: int) -> ImportedPoses:
    frames: list[dict[str, Any]] = []
    for i, pose in enumerate(ring(count)):
        matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{i}.jpg", "transform_matrix": matrix.tolist(), "k1": BENT * (i in bent)})
    content = {"fl_x": LENS[0], "test_filenames": ["0.jpg", "1.jpg"], "frames": frames}
    (folder / "given.json").write_text(json.dumps(content))
    return read_poses(folder / "given.json", photos(count), {f"{i}.jpg": f"{i}.jpg" for i in range(count)})


def from_colmap(folder: Path, bent: list[int], count: int) -> ImportedPoses:
    """Every camera sees the one point, at (i, i)."""
    cameras = [Camera("PINHOLE", W, H, LENS), Camera("OPENCV", W, H, (*LENS, BENT, 0.0, 0.0, 0.0))]
    images = [SparseImage(f"{i}.jpg", int(i in bent), pose) for i, pose in enumerate(ring(count))]
    point = {"xyz": np.zeros((1, 3)), "rgb": np.zeros((1, 3), np.uint8), "error_px": np.zeros(1)}
    index = np.arange(count)
    seen = {"view": index, "point": 0 * index, "xy": np.stack([index, index], axis=1).astype(float)}
    write_model(folder, SparseModel(cameras=cameras, images=images, **point, **seen))
    return read_poses(folder, photos(count), {})


def test_a_fold_in_the_corner_is_missed_coarsely() -> None:
    assert camera_rays(Camera("OPENCV", W, H, (*LENS, BENT, 0.0, 0.0, 0.0)), 32, 32).shape == (32, 32, 3)


@pytest.mark.parametrize("read", [from_transforms, from_colmap])
def test_photos_whose_lens_folds_in_the_corners_are_left_out(read: Any, tmp_path: Path) -> None:
    known = read(tmp_path, [1], 5)
    assert [image.file for image in known.model.images] == ["0.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert [camera.model for camera in known.model.cameras] == ["PINHOLE"]
    (note,) = known.notes
    assert note.code == "sfm.no-rays" and "1.jpg" in note.text
    account = known.account(photos(5))
    assert [entry["registered"] for entry in account] == [True, False, True, True, True]
    no_ray = "sfm.unregistered-no-ray"
    assert [entry["reason_code"] for entry in account] == [None, no_ray, None, None, None]
    assert LOST in account[1]["reason"]
    if read is from_transforms:
        assert known.test_files == ["0.jpg"]
    else:
        np.testing.assert_array_equal(known.model.view, np.arange(4))
        np.testing.assert_array_equal(known.model.xy[:, 0], [0, 2, 3, 4])


def test_that_no_test_photo_is_left_is_said(tmp_path: Path) -> None:
    known = from_transforms(tmp_path, [0, 1], 5)
    assert known.test_files is None
    assert known.notes[-1].code == "sfm.tests-left-out"


@pytest.mark.parametrize("read", [from_transforms, from_colmap])
def test_where_half_of_the_lenses_fold_the_first_is_named(read: Any, tmp_path: Path) -> None:
    with refused("sfm.no-ray", "OPENCV", "2.jpg", "0.485%"):
        read(tmp_path, [2, 3], 4)
