"""LLFF's poses_bounds.npy as known cameras."""

from pathlib import Path

import numpy as np
import pytest

from nerf.synthetic.scenes import ring_of_cameras
from stages.ingest.sources import find_source
from stages.sfm.imported.llff import read_llff
from stages.sfm.imported.pose_files import read_poses
from tests.refusals import codes, refused
from tests.stages.ingest.test_sources import touch
from tests.stages.sfm.imported.test_pose_files import H, W, photo

POSES = ring_of_cameras(3)[:, :3]
PHOTOS = [photo(index) for index in range(3)]
ROWS = {str(index): one.name for index, one in enumerate(PHOTOS)}


def rows_of(poses: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """As LLFF writes OpenCV poses: axes down, right, backward, then the place, then height, width and focal length."""
    right, down, forward, place = np.moveaxis(poses, 2, 0)
    size = np.broadcast_to([scale * H, scale * W, scale * 50.0], place.shape)
    matrices = np.stack([down, right, -forward, place, size], axis=2)
    return np.concatenate([matrices.reshape(len(poses), 15), np.tile([1.0, 9.0], (len(poses), 1))], axis=1)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_poses_and_focal_length_are_read(tmp_path: Path, scale: float) -> None:
    np.save(tmp_path / "poses_bounds.npy", rows_of(POSES, scale))
    known = read_poses(tmp_path / "poses_bounds.npy", PHOTOS, ROWS)
    for image, pose in zip(known.model.images, POSES, strict=True):
        np.testing.assert_allclose(image.sfm_from_camera, pose, atol=1e-9)
    assert [camera.params for camera in known.model.cameras] == [(50, 50, W / 2, H / 2)]
    assert known.notes == []


def test_rows_belong_to_photos_in_order_of_their_names(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", rows_of(POSES))
    for name in ("b.jpg", "a10.jpg", "a2.jpg", "b_depth.png"):
        (tmp_path / name).write_bytes(b"x")
    source = find_source(tmp_path, tmp_path / "poses_bounds.npy")
    assert (source.kind, source.frames) == ("llff", {"0": "a10.jpg", "1": "a2.jpg", "2": "b.jpg"})


def test_rows_belong_to_pictures_only(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "a.jpg.bak", "b.NEF", "notes.xyz", "c.png")
    np.save(tmp_path / "poses_bounds.npy", rows_of(POSES))
    source = find_source(tmp_path, tmp_path)
    assert source.frames == {"0": "a.jpg", "1": "b.NEF", "2": "c.png"} and len(source.files) == 5
    for file in source.files:
        file.rename(file.with_name(f"{file.stem}.{file.suffix[1:2]}0"))
    assert list(find_source(tmp_path, tmp_path).frames.values()) == ["a.j0", "a.jpg.b0", "b.N0", "c.p0", "notes.x0"]


def test_photos_without_a_row_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", rows_of(POSES))
    known = read_poses(tmp_path / "poses_bounds.npy", [*PHOTOS, photo(3)], ROWS)
    assert len(known.model.images) == 3
    assert codes(known.notes) == ["sfm.no-camera"] and photo(3).name in known.notes[0].text


def test_the_folder_of_the_file_may_be_given(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "poses_bounds.npy")
    source = find_source(tmp_path, tmp_path)
    assert (source.kind, source.cameras) == ("llff", tmp_path / "poses_bounds.npy")
    touch(tmp_path, "sparse/0/cameras.bin", "sparse/0/images.bin")
    assert find_source(tmp_path, tmp_path).cameras == tmp_path / "sparse/0"


def test_a_row_too_few_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", rows_of(POSES[:2]))
    with refused("sfm.llff-count"):
        read_poses(tmp_path / "poses_bounds.npy", PHOTOS, ROWS)


@pytest.mark.parametrize("content", ["text", "shape", "pickle", "archive", "large", "cut", "nan", "size"])
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: str) -> None:
    path, rows = tmp_path / "poses_bounds.npy", rows_of(POSES)
    if content == "text":
        path.write_text("no array")
    elif content == "pickle":
        np.save(path, np.array([{}], dtype=object))
    elif content == "archive":
        with path.open("wb") as stream:
            np.savez(stream, rows=rows)
    elif content in ("large", "cut"):
        np.save(path, rows)
        count = "9999999999999999" if content == "large" else "4"
        path.write_bytes(
            path.read_bytes().replace(b"(3, 17), }" + b" " * (len(count) - 1), f"({count}, 17), }}".encode())
        )
    else:
        rows[1, {"nan": 3, "size": 4}.get(content, 0)] = {"nan": np.nan, "size": 40.5}.get(content, 1.0)
        np.save(path, rows[:, :15] if content == "shape" else rows)
    with refused("sfm.llff-unreadable"):
        read_poses(path, PHOTOS, ROWS)


def test_the_fern_of_llff(shared_data: Path) -> None:
    given = read_llff(shared_data / "fern/poses_bounds.npy")
    assert len(given) == 20
    for one in given:
        rotation = one.world_from_camera[:, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) > 0 and (one.camera.width, one.camera.height) == (4032, 3024)
