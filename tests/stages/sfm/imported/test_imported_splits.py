"""Which photos a transforms file holds out, and which it leaves out."""

import json
from pathlib import Path
from typing import Any

import pytest

from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.pose_files import read_poses
from tests.refusals import codes, refused
from tests.stages.sfm.imported.test_pose_files import LENS, NAMES, PHOTOS, frame


@pytest.fixture
def read(tmp_path: Path):
    """Writes a transforms.json of these frames and values and reads it with PHOTOS."""

    def write_and_read(frames: list[dict[str, Any]], **values: Any) -> ImportedPoses:
        path = tmp_path / "transforms.json"
        path.write_text(json.dumps({**values, "frames": frames}))
        return read_poses(path, PHOTOS, NAMES)

    return write_and_read


@pytest.mark.parametrize(
    ("split", "test_files"),
    [
        ({"train_filenames": ["0", "1"], "test_filenames": ["./2"], "val_filenames": ["./1"]}, ["a2.png"]),
        ({"train_filenames": ["0"], "val_filenames": ["2", "./1"]}, ["a1.png", "a2.png"]),
        ({"val_filenames": ["2", "./1"]}, ["a1.png", "a2.png"]),
        ({"train_filenames": ["0", "1", "2"], "test_filenames": [], "val_filenames": []}, None),
    ],
)
def test_the_split_of_a_transforms_file_is_kept(read, split: dict[str, Any], test_files: list[str] | None) -> None:
    known = read([frame(i) for i in range(3)], **LENS, **split)
    assert known.test_files == test_files
    assert known.notes == []


def test_photos_in_no_split_are_left_out_by_name(read) -> None:
    known = read([frame(i) for i in range(3)], **LENS, train_filenames=["0"], test_filenames=["2"], val_filenames=["1"])
    assert [image.file for image in known.model.images] == ["a0.png", "a2.png"]
    assert known.test_files == ["a2.png"]
    assert [(file, why.code) for file, why in known.left_out.items()] == [("a1.png", "sfm.unregistered-in-no-split")]
    assert codes(known.notes) == ["sfm.in-no-split"] and "ä1.png" in known.notes[0].text


@pytest.mark.parametrize("key", ["test_filenames", "val_filenames"])
def test_test_photos_that_are_trained_on_stay_that(read, key: str) -> None:
    everything = ["0", "1", "2"]
    known = read([frame(i) for i in range(3)], **LENS, **{"train_filenames": everything, key: everything})
    assert len(known.model.images) == 3 and known.test_files is None
    assert codes(known.notes) == ["sfm.tests-repeat-training"] and key in known.notes[0].text


def test_test_photos_without_a_frame_are_named(read) -> None:
    known = read([frame(i) for i in range(3)], **LENS, test_filenames=["./2", "./7"])
    assert known.test_files == ["a2.png"]
    assert codes(known.notes) == ["sfm.split-photos-unknown"] and "./7" in known.notes[0].text


def test_test_photos_that_are_not_there_are_said(read) -> None:
    known = read([frame(i) for i in (0, 1, 7)], **LENS, test_filenames=["7"])
    assert known.test_files is None
    assert known.notes[-1].code == "io.no-test-photos"


@pytest.mark.parametrize(
    ("split", "code", "named"),
    [
        (["./7", "b/2" * 999], "split-of-no-frame", "./7, " + 20 * "b/2"),
        ("./2", "split-no-list", "transforms.json"),
        ([2], "split-no-list", "transforms.json"),
    ],
)
@pytest.mark.parametrize("key", ["train_filenames", "test_filenames", "val_filenames"])
def test_a_split_that_cannot_be_kept_is_refused(read, split: Any, code: str, named: str, key: str) -> None:
    with refused(f"sfm.{code}", key, "transforms.json", named) as raised:
        read([frame(i) for i in range(3)], **LENS, **{key: split})
    assert len(str(raised.value)) < 300
