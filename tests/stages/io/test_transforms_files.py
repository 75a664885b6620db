"""Which frames of transforms files are held out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.io.photos import Photo
from stages.io.transforms_files import read_transforms
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.pose_files import read_poses
from tests.refusals import codes, refused

LENS = {"camera_angle_x": 0.7}


def frame(name: str, place: float) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[0, 3] = place
    return {"file_path": name, "transform_matrix": matrix.tolist()}


TRAIN = [frame("train/0", 0), frame("train/1", 1)]
TEST, VAL = [frame("test/0", 2)], [frame("val/0", 3)]
COPY = [frame("./train/0", 0), frame("train/1", 1)]
GONE = [frame("test/7", 7)]


def known(folder: Path, **splits: list[dict[str, Any]]) -> ImportedPoses:
    """A Blender-style folder with these files, read."""
    folder.mkdir(exist_ok=True)
    for split, frames in splits.items():
        (folder / f"transforms_{split}.json").write_text(json.dumps({**LENS, "frames": frames}))
    return read_poses(folder, PHOTOS, NAMES)


NAMES = {f["file_path"]: f"{f['file_path']}.png".removeprefix("./") for f in (*TRAIN, *TEST, *VAL, *COPY)}
PHOTOS = [Photo(name, f"images/{name}", 6, 4, 0, None, None, False, 1.0) for name in sorted(set(NAMES.values()))]
REPEATS, FROM_VAL, NOT_THERE = "io.tests-repeat-training", "io.tests-from-validation", "io.no-test-photos"


@pytest.mark.parametrize(
    ("splits", "test_files", "notes"),
    [
        ({"test": TEST, "val": VAL}, ["test/0.png"], []),
        ({"test": COPY}, None, [REPEATS]),
        ({"test": COPY + TEST}, ["test/0.png"], [REPEATS]),
        ({"test": COPY, "val": VAL}, ["val/0.png"], [REPEATS, FROM_VAL]),
        ({"test": []}, None, []),
        ({"test": [], "val": VAL}, ["val/0.png"], [FROM_VAL]),
        ({"val": VAL}, ["val/0.png"], [FROM_VAL]),
        ({"test": [], "val": []}, None, []),
        ({"test": GONE, "val": VAL}, ["val/0.png"], [NOT_THERE, FROM_VAL]),
        ({"test": GONE + TEST, "val": VAL}, ["test/0.png"], []),
        ({"test": COPY + GONE}, None, [REPEATS, NOT_THERE]),
    ],
)
def test_the_test_photos_of_blender_folders(
    splits: dict[str, list[dict[str, Any]]], test_files: list[str] | None, notes: list[str], tmp_path: Path
) -> None:
    found = known(tmp_path, train=TRAIN, **splits)
    assert found.test_files == test_files
    assert [code for code in codes(found.notes) if code.startswith("io.")] == notes
    assert {"train/0.png", "train/1.png"} <= {image.file for image in found.model.images}


def test_one_photo_in_two_places_is_an_error_still(tmp_path: Path) -> None:
    with refused("sfm.two-frames", "train/0.png"):
        known(tmp_path, train=TRAIN, test=[frame("train/0", 9)])


def test_validation_photos_that_are_not_needed_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "transforms_val.json").write_text("{")
    assert known(tmp_path, train=TRAIN, test=TEST).test_files == ["test/0.png"]
    with refused("io.transforms-not-json", "transforms_val.json"):
        known(tmp_path, train=TRAIN, test=[])


def test_test_frames_of_one_file_are_test_photos(tmp_path: Path) -> None:
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({**LENS, "frames": TRAIN, "test_frames": TEST}))
    found = read_poses(file, PHOTOS, NAMES)
    assert (len(found.model.images), found.test_files) == (3, ["test/0.png"])
    file.write_text(json.dumps({**LENS, "frames": TRAIN, "test_frames": COPY}))
    found = read_poses(file, PHOTOS, NAMES)
    assert found.test_files is None
    assert found.notes[-1].code == REPEATS
    for wrong, code in (({}, "io.transforms-split"), ([{}], "io.transforms-incomplete-frame")):
        file.write_text(json.dumps({**LENS, "frames": TRAIN, "test_frames": wrong}))
        with refused(code, "test_frames of transforms.json"):
            read_poses(file, PHOTOS, NAMES)


def test_a_file_without_frames_is_no_path_to_render(tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text('{"frames": []}')
    with refused("io.transforms-empty"):
        read_transforms(tmp_path / "path.json")


def test_a_camera_path_of_nerfstudio_is_no_transforms_file(tmp_path: Path) -> None:
    frame = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50, "aspect": 1.5}
    (tmp_path / "camera_path.json").write_text(json.dumps({"camera_type": "perspective", "camera_path": [frame]}))
    with refused("io.transforms-without-frames"):
        read_transforms(tmp_path / "camera_path.json")
