"""COLMAP's files, whole and damaged. Where COLMAP itself reads them it hangs, aborts or fills the memory."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from stages.contract import StageError
from stages.io.colmap_files import CAMERA_MODELS, image_names, read_model_files
from stages.sfm.colmap.models import read_model, world_from_camera
from tests.fuzz.cameras import colmap_models
from tests.refusals import refused


@pytest.fixture(params=["bin", "txt"])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder with a valid model of three photos and three points."""
    for name, content in colmap_models()[request.param].items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


def test_the_camera_models_are_those_of_this_colmap() -> None:
    native = {int(id_): name for name, id_ in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert {number: name for number, (name, _) in CAMERA_MODELS.items()} == native
    for number, (_, count) in CAMERA_MODELS.items():
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 10.0, 10, 10)
        assert len(camera.params) == count


def test_it_reads_what_colmap_reads(model: Path) -> None:
    ours, theirs = read_model(model), pycolmap.Reconstruction(model)
    assert [image.file for image in ours.images] == [theirs.image(i).name for i in sorted(theirs.reg_image_ids())]
    for index, image in enumerate(ours.images):
        native = theirs.image(index + 1)
        np.testing.assert_allclose(image.sfm_from_camera, native.cam_from_world().inverse().matrix(), atol=1e-15)
        mine = ours.view == index
        np.testing.assert_array_equal(ours.xy[mine], [point.xy for point in native.points2D])
        assert (ours.point[mine] + 1).tolist() == [point.point3D_id for point in native.points2D]
    np.testing.assert_array_equal(ours.xyz, [theirs.point3D(i).xyz for i in sorted(theirs.point3D_ids())])
    assert ours.cameras[0].params == tuple(theirs.camera(1).params)


def test_text_may_begin_with_the_byte_order_mark_of_windows(tmp_path: Path) -> None:
    for name, content in colmap_models()["txt"].items():
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + content)
    assert len(read_model(tmp_path).images) == 3


def written(folder: Path, kind: str = "txt") -> Path:
    for name, content in colmap_models()[kind].items():
        (folder / name).write_bytes(content)
    return folder


def test_binary_files_go_before_text_where_both_are_whole(tmp_path: Path) -> None:
    binary = read_model(written(tmp_path, "bin"))
    (written(tmp_path) / "cameras.txt").write_text("1 PINHOLE 32 24 1 2 3 4\n")
    assert read_model(tmp_path).cameras == binary.cameras
    (tmp_path / "images.bin").unlink()
    assert read_model(tmp_path).cameras[0].params == (1, 2, 3, 4)
    assert image_names(tmp_path) == [image.file for image in binary.images]


def test_text_of_programs_on_windows(tmp_path: Path) -> None:
    """With its line ends, backslashes in names, colours as decimals and no line of keypoints."""
    plain = read_model(written(tmp_path))
    for name in ("cameras", "images", "points3D"):
        path = tmp_path / f"{name}.txt"
        lines = [line.split(" ") for line in path.read_text().splitlines() if line and line[0] != "#"]
        if name == "images":
            lines = [[*line[:9], f"set\\{line[9]}"] for line in lines[::2]]
        elif name == "points3D":
            lines = [[*line[:4], *(f"{value}.0" for value in line[4:7]), line[7]] for line in lines]
        path.write_bytes(b"".join(" ".join(line).encode() + b"\r\n" for line in lines))
    read = read_model(tmp_path)
    assert read.cameras == plain.cameras and [i.file for i in read.images] == [f"set\\{i.file}" for i in plain.images]
    for one, other in zip(read.images, plain.images, strict=True):
        np.testing.assert_array_equal(one.sfm_from_camera, other.sfm_from_camera)
    np.testing.assert_array_equal(read.xyz, plain.xyz)
    np.testing.assert_array_equal(read.rgb, plain.rgb)


@pytest.mark.parametrize("left_out", [[0, 1, 2], [1], [2]])
@pytest.mark.parametrize("blank", [True, False])
def test_lines_of_keypoints_may_be_empty_or_left_out(left_out: list[int], blank: bool, tmp_path: Path) -> None:
    whole = read_model(written(tmp_path))
    lines = [line for line in (tmp_path / "images.txt").read_text().splitlines() if not line.startswith("#")]
    kept = []
    for index in range(3):
        keypoints = [lines[2 * index + 1]] if index not in left_out else [""] * blank
        kept += [lines[2 * index], *keypoints]
    (tmp_path / "images.txt").write_text("\n".join(kept) + "\n")
    model = read_model(tmp_path)
    assert [image.file for image in model.images] == [image.file for image in whole.images]
    for one, other in zip(model.images, whole.images, strict=True):
        np.testing.assert_array_equal(one.sfm_from_camera, other.sfm_from_camera)
    seen = ~np.isin(whole.view, left_out)
    np.testing.assert_array_equal(model.view, whole.view[seen])
    np.testing.assert_array_equal(model.xy, whole.xy[seen])


def test_a_model_may_be_without_points(model: Path) -> None:
    (points,) = model.glob("points3D.*")
    points.unlink()
    read = read_model(model)
    assert len(read.images) == 3 and len(read.xyz) == len(read.view) == 0


def test_colours_may_be_written_as_decimals(tmp_path: Path) -> None:
    whole = read_model(written(tmp_path))
    lines = (tmp_path / "points3D.txt").read_text().splitlines()
    decimals = [" ".join(f"{f}.0" if 4 <= i < 7 else f for i, f in enumerate(line.split())) for line in lines]
    colours = [[int(field) for field in line.split()[4:7]] for line in lines if not line.startswith("#")]
    np.testing.assert_array_equal(whole.rgb, colours)
    (tmp_path / "points3D.txt").write_text("\n".join(decimals))
    np.testing.assert_array_equal(read_model(tmp_path).rgb, whole.rgb)


@pytest.mark.parametrize(
    ("name", "line", "why"),
    [
        (
            "images",
            "7 1 0 0 0 1 2",
            "line 1: an image (id, quaternion, translation, camera, name; below it a line of keypoints or none) needs",
        ),
        ("images", "7 1 0 0 0 x 0 0 1 a.png\n", "line 1: 'x' is not a number"),
        ("images", "7 1 0 0 0 0 0 0 1 a.png\n1 2 3 4", "line 2: keypoints are triples"),
        ("images", "7 1 0 0 0 0 0 0 1 0007\n8 1 0 0 0 0 0 0 1 0008", "line 2: keypoints are triples"),
        ("points3D", "7 0 0 0 1 2 300 0.5", "line 1: a colour is not between 0 and 255"),
        ("points3D", "7 0 0 0 1 2", "line 1: a point needs 7 fields and has 6"),
        ("images", "7 1 0 0 0 0,5 0 0 1 a.png\n", "line 1: '0,5' is not a number"),
        ("images", "7 1 0 0 0 0 0 0 1.5 a.png\n", "line 1: '1.5' is not a whole number"),
        ("cameras", "7, PINHOLE, 60, 40, 1, 1, 1, 1", "line 1: '7,' is not a whole number"),
        ("cameras", "7 PINHOLE 60", "line 1: a camera needs 4 fields and has 3"),
        ("cameras", "7 PINHOLE 60 40.5 1 1 1 1", "line 1: '40.5' is not a whole number"),
    ],
)
def test_a_damaged_line_is_named(name: str, line: str, why: str, tmp_path: Path) -> None:
    path = written(tmp_path) / f"{name}.txt"
    path.write_text(line + "\n" + path.read_text())
    with refused("sfm.damaged-model", f"{name}.txt", why):
        read_model(tmp_path)


@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_text_that_can_only_mean_one_thing(line_end: str, tmp_path: Path) -> None:
    """Whole numbers such as 1.0, camera models in small letters, points that end with their colour, quoted names,
    UTF-16, any end of line."""
    whole = read_model(written(tmp_path))
    files = {name: tmp_path / f"{name}.txt" for name in ("cameras", "images", "points3D")}
    rows = {name: [line.split() for line in file.read_text().splitlines()] for name, file in files.items()}
    for row in rows["cameras"]:
        if row[0] != "#":
            row[0], row[1], row[2], row[3] = f"{row[0]}.0", row[1].lower(), f"{row[2]}.0", f"{row[3]}e0"
    rows["points3D"] = [row[:7] for row in rows["points3D"]]
    for row in rows["images"]:
        if len(row) == 10 and row[0] != "#":
            row[9] = f'"{row[9]}"'
    for name, file in files.items():
        file.write_text(line_end.join(map(" ".join, rows[name])), "utf-16", newline="")
    read = read_model(tmp_path)
    assert read.cameras == whole.cameras and [image.file for image in read.images] == [i.file for i in whole.images]
    np.testing.assert_array_equal(read.xyz, whole.xyz)
    np.testing.assert_array_equal(read.rgb, whole.rgb)
    np.testing.assert_array_equal(read.xy, whole.xy)
    np.testing.assert_array_equal(read.error_px, 0)


def test_points_that_were_emptied_are_left_out_of_images(tmp_path: Path) -> None:
    written(tmp_path)
    (tmp_path / "points3D.txt").write_text("# 3D point list\n")
    read = read_model(tmp_path)
    assert len(read.images) == 3 and len(read.xyz) == len(read.view) == 0


@pytest.mark.parametrize("scale", [1e-300, 1e-9, 1.0, 1e9, 1e300])
def test_quaternions_need_no_length(scale: float) -> None:
    pose = np.array([0.1, -0.5, 0.7, 0.2, 1.0, 2.0, 3.0])
    expected = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[[1, 2, 3, 0]] / np.linalg.norm(pose[:4])), pose[4:])
    pose[:4] *= scale
    np.testing.assert_allclose(world_from_camera(pose), expected.inverse().matrix(), atol=1e-14)


def overwritten(path: Path, place: int, form: str, value: float) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, place, value)
    path.write_bytes(content)


def test_files_may_be_in_capitals(model: Path) -> None:
    expected = read_model_files(model)
    for file in list(model.iterdir()):
        file.rename(model / file.name.upper())
    found = read_model_files(model)
    assert found.cameras == expected.cameras and found.points == expected.points
    assert [image.name for image in found.images.values()] == image_names(model)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize(
    ("content", "why"),
    [(b"", "empty"), (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"), (b"<html>", "web page")],
)
def test_what_stands_in_for_a_file_is_named(part: str, content: bytes, why: str, tmp_path: Path) -> None:
    written(tmp_path, "bin")
    (tmp_path / f"{part}.bin").write_bytes(content)
    with refused("sfm.damaged-model", f"{part}.bin", why):
        read_model(tmp_path)


@pytest.mark.parametrize("count", [2**64 - 1, 2**63, 2**40, 5])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_count_that_is_too_large_ends_with_the_file(name: str, count: int, tmp_path: Path) -> None:
    for file, content in colmap_models()["bin"].items():
        (tmp_path / file).write_bytes(content)
    overwritten(tmp_path / f"{name}.bin", 0, "<Q", count)
    with refused("sfm.damaged-model", f"{name}.bin", "bytes"):
        read_model(tmp_path)


def test_a_keypoint_count_too_large_ends_the_file(tmp_path: Path) -> None:
    for file, content in colmap_models()["bin"].items():
        (tmp_path / file).write_bytes(content)
    overwritten(tmp_path / "images.bin", 8 + 64 + len("p0.png") + 1, "<Q", 2**61)
    with refused("sfm.damaged-model", "images.bin", 2305843009213693952):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("name", "old", "new", "why"),
    [
        ("cameras", "OPENCV", "OPENCVX", "'OPENCVX'"),
        ("cameras", " 24 20 ", " 0 20 ", "0×20 pixels"),
        ("cameras", " 24 20 ", " 99999999999 20 ", "1e+11×20 pixels"),
        ("cameras", " 12 10 ", " 12 ", "a OPENCV camera has 8 parameters"),
        ("images", " 1 p0.png", " 7 p0.png", "image p0.png names camera 7"),
    ],
)
def test_text_that_is_no_model(name: str, old: str, new: str, why: str, tmp_path: Path) -> None:
    for file, content in colmap_models()["txt"].items():
        (tmp_path / file).write_bytes(content)
    text = (tmp_path / f"{name}.txt").read_text()
    assert old in text
    (tmp_path / f"{name}.txt").write_text(text.replace(old, new))
    with pytest.raises(StageError) as caught:
        read_model(tmp_path)
    assert why in caught.value.why


def test_points_that_are_not_there_and_poses_that_are_none(tmp_path: Path) -> None:
    for file, content in colmap_models()["bin"].items():
        (tmp_path / file).write_bytes(content)
    whole = tmp_path / "whole"
    whole.mkdir()
    shutil.copy(tmp_path / "images.bin", whole)
    overwritten(tmp_path / "images.bin", 8 + 64 + len("p0.png") + 1 + 8 + 16, "<q", 99)
    with refused("sfm.damaged-model", "p0.png", "point 99"):
        read_model(tmp_path)
    for place, value in ((12, float("nan")), (44, float("inf"))):
        shutil.copy(whole / "images.bin", tmp_path)
        overwritten(tmp_path / "images.bin", place, "<d", value)
        with refused("sfm.damaged-model", "p0.png", "pose"):
            read_model(tmp_path)


def test_an_id_twice(tmp_path: Path) -> None:
    for file, content in colmap_models()["txt"].items():
        (tmp_path / file).write_bytes(content)
    camera = (tmp_path / "cameras.txt").read_text()
    (tmp_path / "cameras.txt").write_text(camera + camera)
    with pytest.raises(ValueError, match=r"cameras\.txt is damaged: the id 1 "):
        read_model_files(tmp_path)
