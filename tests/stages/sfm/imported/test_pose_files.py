import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from nerf.geometry.scene import Camera
from stages.contract import StageError
from stages.io.photos import Photo
from stages.io.sparse_model import SparseImage, SparseModel
from stages.io.transforms_export import intrinsics
from stages.sfm.colmap.models import write_model
from stages.sfm.imported.conventions import PoseConvention
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.photo_names import photos_by_name
from stages.sfm.imported.pose_files import read_poses
from tests.refusals import codes, refused

W, H = 60, 40


def photo(index: int, width: int = W, height: int = H, folder: str = "") -> Photo:
    return Photo(f"{folder}ä{index}.png", f"images/{folder}a{index}.png", width, height, 0, None, None, False, 1.0)


def rotation(angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


def matrix(index: int) -> np.ndarray:
    """world_from_camera with OpenGL axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(0.3 * index), (index, 2.0, -1.0)
    return pose


def frame(index: int, **values: Any) -> dict[str, Any]:
    return {"file_path": f"./{index}", "transform_matrix": matrix(index).tolist()} | values


PHOTOS = [photo(index) for index in range(3)]
NAMES = {f"./{index}": f"ä{index}.png" for index in range(3)}
LENS = {"fl_x": 50.0, "fl_y": 52.0, "cx": 31.0, "cy": 19.0}


@pytest.fixture
def read(tmp_path: Path):
    """Writes a transforms.json of these frames and values and reads it with PHOTOS."""

    def write_and_read(frames: list[dict[str, Any]], photos: list[Photo] = PHOTOS, **values: Any) -> ImportedPoses:
        path = tmp_path / "transforms.json"
        path.write_text(json.dumps({**values, "frames": frames}))
        return read_poses(path, photos, NAMES)

    return write_and_read


def test_axes_turn_from_opengl_to_opencv_and_centres_stay(read) -> None:
    known = read([frame(i) for i in (2, 0, 1)], **LENS)
    assert [image.file for image in known.model.images] == ["a0.png", "a1.png", "a2.png"]
    for index, image in enumerate(known.model.images):
        pose = image.sfm_from_camera
        np.testing.assert_allclose(pose[:, 3], matrix(index)[:3, 3])
        np.testing.assert_allclose(pose[:, 0], matrix(index)[:3, 0], atol=1e-12)  # x stays
        np.testing.assert_allclose(pose[:, 1:3], -matrix(index)[:3, 1:3], atol=1e-12)  # y and z turn round
        assert np.linalg.det(pose[:, :3]) == pytest.approx(1)
    assert known.test_files is None
    assert known.notes == []


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (LENS, ("PINHOLE", (50, 52, 31, 19))),
        (LENS | {"k1": 0.1, "p2": 0.01}, ("OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0.01))),
        (LENS | {"k1": 0.1, "camera_model": "SIMPLE_RADIAL"}, ("OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0))),
        (LENS | {"k3": 0.2}, ("FULL_OPENCV", (50, 52, 31, 19, 0, 0, 0, 0, 0.2, 0, 0, 0))),
        (
            LENS | {"k1": 0.1, "k4": 0.3, "camera_model": "FULL_OPENCV"},
            ("FULL_OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0, 0, 0.3, 0, 0)),
        ),
        (
            LENS | {"k1": 0.1, "k4": 0.3, "camera_model": "OPENCV_FISHEYE"},
            ("OPENCV_FISHEYE", (50, 52, 31, 19, 0.1, 0, 0, 0.3)),
        ),
        (LENS | {"k1": 0.1, "is_fisheye": True}, ("OPENCV_FISHEYE", (50, 52, 31, 19, 0.1, 0, 0, 0))),
        (
            LENS | {"distortion_params": [0.1, 0.02, 0.003, 0, 0.01, -0.01]},
            ("FULL_OPENCV", (50, 52, 31, 19, 0.1, 0.02, 0.01, -0.01, 0.003, 0, 0, 0)),
        ),
        (
            LENS | {"distortion_params": [0.1, 0.02, 0.03, 0.04, 0, 0], "camera_model": "OPENCV_FISHEYE"},
            ("OPENCV_FISHEYE", (50, 52, 31, 19, 0.1, 0.02, 0.03, 0.04)),
        ),
        (
            LENS | {"k1": 0.1, "k3": 0.03, "p1": 0.01, "p2": 0.02, "camera_model": "OPENCV_FISHEYE"},
            ("THIN_PRISM_FISHEYE", (50, 52, 31, 19, 0.1, 0, 0.01, 0.02, 0.03, 0, 0, 0)),
        ),
        (
            LENS | {"k4": 0.1, "sx1": 0.01, "sy1": 0.02, "camera_model": "THIN_PRISM_FISHEYE"},
            ("THIN_PRISM_FISHEYE", (50, 52, 31, 19, 0, 0, 0, 0, 0, 0.1, 0.01, 0.02)),
        ),
        ({"fl_x": 50}, ("PINHOLE", (50, 50, 30, 20))),
        ({"camera_angle_x": math.pi / 2}, ("PINHOLE", (30, 30, 30, 20))),
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": 2 * math.atan(0.5)}, ("PINHOLE", (30, 40, 30, 20))),
        ({"fl_y": 50}, ("PINHOLE", (50, 50, 30, 20))),
        ({"camera_angle_y": 2 * math.atan(0.5)}, ("PINHOLE", (40, 40, 30, 20))),
        ({"y_fov": 90}, ("PINHOLE", (20, 20, 30, 20))),
        ({"x_fov": 90.0, "fl_y": 31}, ("PINHOLE", (30, 31, 30, 20))),
        (LENS | {"camera_angle_x": 3.0}, ("PINHOLE", (50, 52, 31, 19))),
        (LENS | {"w": 2 * W, "h": 2 * H}, ("PINHOLE", (25, 26, 15.5, 9.5))),
        (LENS | {"k1": "0.1", "k4": "0.0", "p2": "1e-2"}, ("OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0.01))),
    ],
)
def test_intrinsics(read, values: dict[str, Any], expected: tuple[str, tuple[float, ...]]) -> None:
    (camera,) = read([frame(i) for i in range(3)], **values).model.cameras
    assert (camera.model, camera.width, camera.height) == (expected[0], W, H)
    assert camera.params == pytest.approx(expected[1])


MATRIX = [[50.0, 0, 31], [0, 52, 19], [0, 0, 1]]


@pytest.mark.parametrize(
    "spelt",
    [
        {"fx": 50.0, "fy": 52.0, "cx": 31.0, "cy": 19.0, "width": W, "height": H},
        {"intrinsics": LENS},
        {"camera": LENS, "distortion": {"k1": 0.0}, "dist_coeffs": [0.0, 0, 0, 0, 0]},
        {"camera": LENS | {"name": "phone"}},
        {"camera": {"fx": 50.0, "fy": "52", "cx": 31.0, "cy": 19.0, "width": W, "height": H}},
        {"intrinsics": MATRIX},
        {"K": np.ravel(MATRIX).tolist()},
        {"K": np.transpose(MATRIX).ravel().tolist()},  # column by column, as ARKit has it
        {"camera_intrinsics": [50, 52, 31, 19]},
        {"intrinsic_matrix": np.pad(MATRIX, (0, 1)).tolist()},
        {"intrinsics": LENS, "K": None, "fx": None},
        {"fx": 99.0, "K": np.eye(3).tolist()} | LENS,
        {"F_X": 50.0, "focal_length_y": 52.0, "principal_point_x": 31.0, "CY": 19.0},
        {"fl_x": 100.0, "fl_y": 104.0, "cx": 62.0, "cy": 38.0, "image_width": 2 * W, "imageHeight": 2 * H},
        {"camera": LENS | {"camera_type": "perspective", "skew": 0.0}, "radial_distortion": [0, 0], "K1": 0},
    ],
)
def test_intrinsics_in_other_spellings(read, spelt: dict[str, Any]) -> None:
    """Of a frame they go before the file's, too."""
    alone = read([frame(i) for i in range(3)], **spelt)
    (camera,) = alone.model.cameras
    assert (camera.model, camera.params) == ("PINHOLE", pytest.approx((50, 52, 31, 19)))
    mixed = read([frame(0), frame(1, **spelt), frame(2)], fl_x=99.0, cx=1.0, cy=2.0)
    assert mixed.model.cameras[1].params == pytest.approx((50, 52, 31, 19))


@pytest.mark.parametrize(("size", "scale"), [((W // 2, H // 2), 0.5), ((2 * W, 2 * H), 2.0), ((W, H // 2), 1.0)])
def test_pixels_of_the_file_are_of_its_size(read, size: tuple[int, int], scale: float) -> None:
    photos = [photo(0), photo(1, *size), photo(2)]
    own = frame(1, w=size[0], h=size[1])
    known = read([frame(0), own, frame(2)], photos=photos, w=W, h=H, k1=0.1, **LENS)
    camera = known.model.cameras[known.model.images[1].camera]
    assert (camera.width, camera.height) == size
    assert camera.params[:5] == pytest.approx([*(scale * value for value in LENS.values()), 0.1])


def test_a_frames_own_intrinsics_win(read) -> None:
    model = read([frame(0), frame(1, fl_x=70.0), frame(2)], **LENS).model
    assert [camera.params[0] for camera in model.cameras] == [50, 70]
    assert [image.camera for image in model.images] == [0, 1, 0]


ANGLE = 2 * math.atan(0.25)  # of a focal length of 120 across W pixels, of 80 across H


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        ({"camera_angle_x": ANGLE}, ("OPENCV", (120, 120, 31, 19, 0.1, 0, 0, 0))),
        ({"camera_angle_y": ANGLE}, ("OPENCV", (80, 80, 31, 19, 0.1, 0, 0, 0))),
        ({"camera_angle_x": ANGLE, "camera_angle_y": ANGLE}, ("OPENCV", (120, 80, 31, 19, 0.1, 0, 0, 0))),
        ({"x_fov": math.degrees(ANGLE)}, ("OPENCV", (120, 120, 31, 19, 0.1, 0, 0, 0))),
        ({"fl_x": 70.0}, ("OPENCV", (70, 70, 31, 19, 0.1, 0, 0, 0))),
        ({"fl_x": 70.0, "fl_y": None}, ("OPENCV", (70, 70, 31, 19, 0.1, 0, 0, 0))),
        ({"fl_x": None}, ("OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0))),
        ({"cx": 33.0}, ("OPENCV", (50, 52, 33, 20, 0.1, 0, 0, 0))),
        ({"p1": 0.01}, ("OPENCV", (50, 52, 31, 19, 0, 0, 0.01, 0))),
        ({"k1": 0.0}, ("PINHOLE", (50, 52, 31, 19))),
        ({"distortion_params": [0, 0.2, 0, 0, 0, 0]}, ("OPENCV", (50, 52, 31, 19, 0, 0.2, 0, 0))),
        ({"camera_model": "OPENCV_FISHEYE"}, ("OPENCV_FISHEYE", (50, 52, 31, 19, 0, 0, 0, 0))),
        ({"camera_model": "OPENCV"}, ("OPENCV", (50, 52, 31, 19, 0.1, 0, 0, 0))),
    ],
)
def test_a_frame_has_each_group_of_intrinsics_whole(read, own: dict[str, Any], expected: tuple[str, tuple]) -> None:
    known = read([frame(0), frame(1, **own), frame(2)], k1=0.1, camera_model="OPENCV", **LENS)
    camera = known.model.cameras[known.model.images[1].camera]
    assert (camera.model, camera.width, camera.height) == (expected[0], W, H)
    assert camera.params == pytest.approx(expected[1])
    assert known.notes == []


@pytest.mark.parametrize(
    ("own", "shared", "named"),
    [
        ({"fl_x": 70.0, "camera_angle_x": ANGLE}, {}, ["./1", "fl_x", "70", "camera_angle_x", "120"]),
        ({}, {"x_fov": math.degrees(ANGLE)}, ["all frames", "fl_x", "50", "x_fov", "120"]),
        ({"x_fov": 1.1}, {}, ["./1", "x_fov", "1.1", "degrees", "camera_angle_x"]),
        ({"k1": 0.2, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, {}, ["./1", "k1", "distortion_params"]),
        ({}, {"camera_model": "PINHOLE", "is_fisheye": True}, ["all frames", "PINHOLE", "is_fisheye"]),
    ],
)
def test_contradictory_intrinsics_are_named(
    read, own: dict[str, Any], shared: dict[str, Any], named: list[str]
) -> None:
    (note,) = read([frame(0), frame(1, **own), frame(2)], **LENS, **shared).notes
    assert note.code.endswith("-contradicts-itself") and all(part in note.text for part in named)


def test_a_principal_point_far_from_the_middle_is_named(read) -> None:
    """Cropped photos have one, and so have intrinsics of another size."""
    own = frame(1, w=W, h=H, cx=62.0, cy=38.0)
    (note,) = read([frame(0), own, frame(2)], **LENS).notes
    assert note.code == "sfm.frame-contradicts-itself" and "./1" in note.text and "(62, 38)" in note.text
    assert read([frame(0), frame(1, w=W, h=H, cx=40.0, cy=38.0), frame(2)], **LENS).notes == []


@pytest.mark.parametrize(
    ("declared", "model"),
    [
        ({"camera_type": "Fisheye"}, "OPENCV_FISHEYE"),
        ({"camera_model": "opencv_fisheye"}, "OPENCV_FISHEYE"),
        ({"distortion_model": "equidistant"}, "OPENCV_FISHEYE"),
        ({"camera": {"camera_type": "FISHEYE"}}, "OPENCV_FISHEYE"),
        ({"distortion_model": "plumb_bob"}, "OPENCV"),
        ({"camera_model": "PERSPECTIVE"}, "OPENCV"),
        ({"camera_type": "phone"}, "OPENCV"),
        ({"camera_model": "OPENCV", "camera_type": "FISHEYE"}, "OPENCV"),
        ({"distortion_model": "rational_polynomial", "k4": 0.1}, "FULL_OPENCV"),
    ],
)
def test_camera_models_have_other_names(read, declared: dict[str, Any], model: str) -> None:
    (camera,) = read([frame(i) for i in range(3)], k1=0.1, **declared, **LENS).model.cameras
    assert camera.model == model


def test_intrinsics_for_photos_of_several_sizes_have_a_size(read) -> None:
    photos = [photo(0), photo(1, W // 2, H // 2), photo(2)]
    with refused("sfm.shared-pixels", "30×20, 60×40", "w and h are missing"):
        read([frame(0), frame(1, w=W // 2, h=H // 2), frame(2)], photos=photos, **LENS)
    known = read([frame(i) for i in range(3)], photos=photos, w=W, h=H, **LENS)
    own = read(
        [frame(0), frame(1, w=30, h=20, fl_x=25.0, fl_y=26.0, cx=15.5, cy=9.5), frame(2)],
        photos=photos,
        w=W,
        h=H,
        **LENS,
    )
    for one in (known, own):
        camera = one.model.cameras[one.model.images[1].camera]
        assert (camera.width, camera.height, *camera.params) == pytest.approx((30, 20, 25, 26, 15.5, 9.5))
    turned = [photo(0), dataclasses.replace(photo(1, H, W), orientation=6), photo(2)]
    assert len(read([frame(i) for i in range(3)], photos=turned, **LENS).model.images) == 3, "one size as stored"


def test_photos_that_lie_and_stand_share_no_angle(read) -> None:
    photos = [photo(0), photo(1, H, W), photo(2)]
    with refused("sfm.shared-angle", "40×60, 60×40", "camera_angle_x"):
        read([frame(i) for i in range(3)], photos=photos, camera_angle_x=1.0)
    with refused("sfm.frame-intrinsics", "./1", "40×60", "60×40", "cx and cy"):
        read([frame(0), frame(1, w=H, h=W), frame(2)], photos=photos, w=W, h=H, **LENS)
    own = read([frame(0), frame(1, camera_angle_x=0.7), frame(2)], photos=photos, camera_angle_x=1.0).model
    assert own.cameras[own.images[1].camera].params[0] == pytest.approx(H / 2 / math.tan(0.35))


def _with(row: int, column: int, value: float) -> list[list[float]]:
    pose = matrix(1).tolist()
    pose[row][column] = value
    return pose


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transform_matrix": _with(1, 1, math.inf)}, r"its transform_matrix is not 4 × 4"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, r"its transform_matrix is not 4 × 4"),
        ({"transform_matrix": [[1, 0], ["x"]]}, r"its transform_matrix is not a matrix of numbers"),
        ({"transform_matrix": 7}, r"its transform_matrix is not 4 × 4"),
        ({"transform_matrix": (matrix(1) @ np.diag([-1, 1, 1, 1])).tolist()}, r"it mirrors"),
        (
            {"transform_matrix": (matrix(1) @ np.diag([2, 2, 3, 1])).tolist()},
            r"its axes are off by 12°, and it scales by",
        ),
        ({"transform_matrix": matrix(1).round(2).tolist()}, r"no rotation: its axes are off by 0\.\d+°"),
        ({"transform_matrix": np.diag([1, 1, 0, 1]).tolist()}, r"it is no rotation: its determinant is 0"),
        (
            {"transform_matrix": matrix(1).T.tolist()},
            r"the last row .* is 1, 2, -1, 1 .*: it may be trans",
        ),
        ({"camera_angle_x": 40, "fl_x": None}, r"its camera_angle_x is 40; it must be in radians"),
        ({"intrinsics": [[50, 0, 31], [0, 50, 19]]}, r"its intrinsics has 6 numbers"),
        ({"intrinsics": [50, 9, 31, 0, 50, 19, 0, 0, 1]}, r"its intrinsics is no camera matrix .*: 50 9 31; 0 50"),
        ({"fl_x": 0}, r"a focal length of 0 × 0 pixels is .*60×40"),
        ({"fl_x": -50}, r"a focal length of -50 × -50 pixels"),
        ({"fl_x": 1e308}, r"a focal length of 1e\+308 × 1e\+308 pixels"),
        ({"fl_x": 1e-300}, r"a focal length of 1e-300 × 1e-300 pixels"),
        ({"fl_x": 10**400}, r"its fl_x is 10{39}, not a finite number"),
        ({"cx": -1e300}, r"its principal point \(-1e\+300, 20\) is .*60×40"),
        ({"w": 10**30, "h": 10**30}, r"its w and h are 1e\+30 and 1e\+30"),
        ({"transform_matrix": _with(0, 3, 1e300)}, r"its position is 1e\+300 units from the origin"),
        ({"transform_matrix": _with(0, 0, 1e308)}, r"it is no rotation: .*1e\+308"),
        ({"transform_matrix": _with(0, 0, 10**400)}, r"its transform_matrix is not a matrix of numbers"),
        ({"fl_x": math.nan}, r"its fl_x is nan, not a finite number"),
        ({"cx": "31 px"}, r"its cx is '31 px', not a finite number"),
        ({"cx": [31]}, r"its cx is \[31\], not a finite number"),
        ({"k1": "nan"}, r"its k1 is 'nan', not a finite number"),
        ({"k1": True}, r"its k1 is True, not a finite number"),
        ({"w": 0, "h": 0}, r"its w and h are 0 and 0"),
        ({"w": 80, "h": 40}, r"80×40 pixels, .*60×40"),
        ({"k4": 0.1}, r"k4, .*FULL_OPENCV"),
        ({"camera_model": "EQUIRECTANGULAR"}, r"panoramas are not supported"),
        ({"camera_model": "FISHEYE624"}, r"its camera_model is 'FISHEYE624', which is none of SIMPLE_PIN"),
        ({"camera_model": "ORTHOPHOTO"}, r"its camera_model is 'ORTHOPHOTO', which is none of"),
        ({"camera_model": "VR180_L"}, r"its camera_model is 'VR180_L', which is none of"),
        ({"camera_model": "RAD_TAN_THIN_PRISM_FISHEYE"}, r"its camera_model is 'RAD_TAN_THIN_PRISM_FISHEYE', which is"),
        ({"camera_model": ["OPENCV"]}, r"its camera_model is \['OPENCV'\], which is none of"),
        ({"ftheta_p0": 0.0}, r"ftheta_p0.* not supported"),
        ({"latlong": True}, r"latlong.* not supported"),
        ({"equirectangular": True}, r"equirectangular.* not supported"),
        ({"distortion_params": [0.1, 0.2]}, r"its distortion_params are not the six numbers k1, k2, k3, k4"),
        ({"distortion_params": [0.1, 0, 0, 0, 0, None]}, r"its p2 is None, not a finite number"),
        ({"distortion_params": [0, 0, 0, 0.1, 0, 0]}, r"k4, .*FULL_OPENCV"),
        ({"is_fisheye": True, "k5": 0.1}, r"a fisheye with k5 or k6"),
        ({"sx1": 0.1}, r"sx1 or sy1, .*THIN_PRISM_FISHEYE"),
        ({"dist_coeffs": [0.1, 0.0, 0.0, 0.0]}, r"dist_coeffs.*k1, k2, p1, p2"),
        ({"camera": {"distortion": [0.1, 0.0, 0.0, 0.0]}}, r"distortion.*k1, k2, p1, p2"),
        ({"cx": 0.5, "cy": 0.5}, r"principal point \(0\.5, 0\.5\)"),
        ({"cx": 62.0, "cy": 38.0}, r"\(62, 38\) is far from the middle of 60×40 .* about 124×76; write the w and h"),
        ({"cx": 15.0, "cy": 10.0}, r"\(15, 10\) is far from the middle of 60×40 .* about 30×20; write the w and h"),
        ({"k": [0.1, 0.0]}, r"it has k, which is not read; write k1"),
        ({"intrinsics": {"radial_distortion": [0.1]}}, r"it has radial_distortion, which is not read"),
        ({"skew": -2.0}, r"its skew is -2\.0, which no supported camera model has"),
        ({"cx": None, "shift_x": 0.1}, r"its shift_x is 0\.1, which is not read; write cx"),
        ({"resolution": [120, 80]}, r"its resolution is \[120, 80\], which is not read; write w and h"),
        ({"camera_type": "SPHERICAL"}, r"panoramas are not supported"),
        ({"transform_matrix": matrix(1)[:3].T.tolist()}, r"its transform_matrix is 4 × 3: it may be transposed"),
    ],
)
def test_what_is_no_camera_is_refused_by_name(read, changes: dict[str, Any], message: str) -> None:
    lens = {} if None in (changes.get("fl_x", 1), changes.get("cx", 1)) else LENS
    changes = {"fl_x": 50.0} | changes if "shift_x" in changes else changes
    with pytest.raises(StageError, match=message) as raised:
        read([frame(0, fl_x=50.0), frame(1, **changes), frame(2)], **lens)
    assert "frame './1' of transforms.json" in raised.value.what


def test_no_focal_length_at_all_is_refused(read) -> None:
    with refused("sfm.frame-intrinsics", "./0", "transforms.json", "fl_x", "camera_angle_x", "focal_length, lens"):
        read([frame(0, focal_length=35.0, lens="wide")])


@pytest.mark.parametrize("none", [None, np.zeros((4, 4)).tolist(), [math.nan] * 16, _with(0, 3, math.nan)])
def test_frames_without_a_pose_are_left_out_and_named(read, none: Any) -> None:
    known = read([frame(0), frame(1, transform_matrix=none), frame(2)], **LENS)
    assert [image.file for image in known.model.images] == ["a0.png", "a2.png"]
    assert codes(known.notes) == ["sfm.frames-without-pose"] and "ä1.png" in known.notes[0].text
    assert [(file, why.code) for file, why in known.left_out.items()] == [
        ("a1.png", "sfm.unregistered-frame-without-pose")
    ]
    with refused("sfm.no-poses", "transforms.json", "all 3 frames"):
        read([frame(i, transform_matrix=none) for i in range(3)], **LENS)


def test_rounded_rotations_are_projected_and_named(read) -> None:
    tilted = matrix(1)
    tilted[:3, :3] = Rotation.from_euler("xyz", (0.4, -0.7, 1.1)).as_matrix()
    exact = read([frame(0), frame(1, transform_matrix=tilted.tolist()), frame(2)], **LENS)
    rounded = read([frame(0), frame(1, transform_matrix=tilted.round(3).tolist()), frame(2)], **LENS)
    for a, b in zip(exact.model.images, rounded.model.images, strict=True):
        rotation = b.sfm_from_camera[:, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(rotation, a.sfm_from_camera[:, :3], atol=np.radians(0.05))
    assert exact.notes == []
    (note,) = rounded.notes
    assert note.code == "sfm.rounded-rotations" and "./1" in note.text


@pytest.mark.parametrize("scale", [1.05, 0.1, 1000.0])
@pytest.mark.parametrize("frames", [[1], [0, 1, 2]])
def test_the_scale_of_a_matrix_is_left_out_and_named(read, scale: float, frames: list[int]) -> None:
    by = np.diag([scale, scale, scale, 1])
    given = [frame(i, transform_matrix=(matrix(i) @ (by if i in frames else np.eye(4))).tolist()) for i in range(3)]
    known, plain = read(given, **LENS), read([frame(i) for i in range(3)], **LENS)
    for scaled, image in zip(known.model.images, plain.model.images, strict=True):
        np.testing.assert_allclose(scaled.sfm_from_camera, image.sfm_from_camera, atol=1e-12)
    (note,) = known.notes
    assert note.code == "sfm.scaled-matrices"
    assert f" {len(frames)} frame" in note.text and f"{scale:g}" in note.text


OF_OTHERS = {
    "nerfstudio": {
        "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
        "applied_scale": 3.0,
        "ply_file_path": "sparse_pc.ply",
        "orientation_override": "none",
        "fisheye_crop_radius": 20,
    },
    "instant-ngp": {"scale": 0.5, "offset": [0.1, 0.2, 0.3], "aabb_scale": 16, "aabb": [[0, 0, 0], [1, 1, 1]]},
    "Blender": {"locations": [], "fix_premult": True},
}
OF_THEIR_FRAMES = {
    "nerfstudio": {"colmap_im_id": 7, "depth_file_path": "depths/1.png", "mask_path": "masks/1.png"},
    "instant-ngp": {"sharpness": 0.1, "depth_path": "1.png", "rolling_shutter": [0, 0, 0, 0]},
    "Blender": {"rotation": 0.0125, "time": 0.5},
}


@pytest.mark.parametrize("program", OF_OTHERS)
def test_poses_are_the_files_whatever_else_it_holds(read, program: str) -> None:
    known = read([frame(i, **OF_THEIR_FRAMES[program]) for i in range(3)], **LENS, **OF_OTHERS[program])
    plain = read([frame(i) for i in range(3)], **LENS)
    assert known.model.cameras == plain.model.cameras and known.notes == plain.notes == []
    for one, other in zip(known.model.images, plain.model.images, strict=True):
        np.testing.assert_array_equal(one.sfm_from_camera, other.sfm_from_camera)


SIZE = {"w": W, "h": H}
RADIAL = {"k1": 0.1, "k2": 0.02, "k3": 0.003, "k4": 0.0, "p1": 0.01, "p2": -0.01}
BY_CONVERTERS = {  # what nerfstudio's write: the file's values, the frame's, the camera
    "polycam": ({"orientation_override": "none"}, LENS | SIZE, ("PINHOLE", (50, 52, 31, 19))),
    "metashape": (LENS | SIZE | RADIAL, {}, ("FULL_OPENCV", (50, 52, 31, 19, 0.1, 0.02, 0.01, -0.01, 0.003, 0, 0, 0))),
    "realitycapture": (
        SIZE | {"orientation_override": "none"},
        LENS | {key: str(value) for key, value in RADIAL.items()},  # a table's fields, as text
        ("FULL_OPENCV", (50, 52, 31, 19, 0.1, 0.02, 0.01, -0.01, 0.003, 0, 0, 0)),
    ),
}


@pytest.mark.parametrize("program", BY_CONVERTERS)
def test_files_of_nerfstudios_converters_are_read(read, program: str) -> None:
    of_file, of_frame, expected = BY_CONVERTERS[program]
    known = read([frame(i, **of_frame) for i in range(3)], camera_model="OPENCV", **of_file)
    (camera,) = known.model.cameras
    assert (camera.model, camera.width, camera.height) == (expected[0], W, H) and known.notes == []
    assert camera.params == pytest.approx(expected[1])
    for index, image in enumerate(known.model.images):
        np.testing.assert_allclose(image.sfm_from_camera, matrix(index)[:3] * [1, -1, -1, 1], atol=1e-12)


def test_a_matrix_may_be_a_flat_list_of_its_rows(read) -> None:
    plain = read([frame(i) for i in range(3)], **LENS)
    for reshaped in (np.ravel, lambda m: m[None], lambda m: m[:3, :, None]):
        given = read([frame(i, transform_matrix=reshaped(matrix(i)).tolist()) for i in range(3)], **LENS)
        for one, other in zip(given.model.images, plain.model.images, strict=True):
            np.testing.assert_array_equal(one.sfm_from_camera, other.sfm_from_camera)


def test_a_matrix_may_be_homogeneous(read) -> None:
    doubled = read([frame(i, transform_matrix=(2 * matrix(i)).tolist()) for i in range(3)], **LENS)
    plain = read([frame(i) for i in range(3)], **LENS)
    assert doubled.notes == []
    for one, other in zip(doubled.model.images, plain.model.images, strict=True):
        np.testing.assert_allclose(one.sfm_from_camera, other.sfm_from_camera, atol=1e-15)


def test_frames_without_photo_and_photos_without_frame_are_named(read) -> None:
    known = read([frame(0), frame(1), frame(7)], **LENS)
    assert codes(known.notes) == ["sfm.no-photo", "sfm.no-camera"] and "ä2.png" in known.notes[1].text
    assert [entry["registered"] for entry in known.account(PHOTOS)] == [True, True, False]
    assert known.account(PHOTOS)[2]["reason_code"] == "sfm.unregistered-no-imported-pose"


def test_no_frame_with_a_photo_is_an_error(read) -> None:
    with refused("sfm.no-camera-matches", "transforms.json", "./8, ./9"):
        read([frame(8), frame(9)], **LENS)


def test_a_photo_has_one_frame(read) -> None:
    for second in (frame(1, fl_x=51.0), frame(1, transform_matrix=matrix(2).tolist())):
        differs = "fl_x" if "fl_x" in second else "transform_matrix"
        with refused("sfm.two-frames", "transforms.json", "ä1.png", "./1", differs):
            read([frame(1), second], **LENS)


@pytest.mark.parametrize("rounding", [0.0, 1e-12, 1e-7])
def test_frames_that_are_listed_twice_alike_count_once(read, rounding: float) -> None:
    again = frame(1, transform_matrix=(matrix(1) + np.pad([[rounding]], (0, 3))).tolist())
    known = read([frame(0), frame(1), again, frame(2)], **LENS)
    assert [image.file for image in known.model.images] == ["a0.png", "a1.png", "a2.png"]
    assert codes(known.notes) == ["sfm.repeated-frames"]


def test_the_convention_of_poses_may_be_given(tmp_path: Path) -> None:
    poses = [matrix(i) @ np.diag([1, -1, -1, 1]) for i in range(3)]
    frames = [frame(i, transform_matrix=np.linalg.inv(pose).tolist()) for i, pose in enumerate(poses)]
    (tmp_path / "t.json").write_text(json.dumps({**LENS, "frames": frames}))
    convention = PoseConvention("camera-from-world", "opencv")
    known = read_poses(tmp_path / "t.json", PHOTOS, NAMES, convention)
    cameras = [Camera("PINHOLE", W, H, (50.0, 52.0, 31.0, 19.0))]
    inverted = [SparseImage(f"ä{i}.png", 0, np.linalg.inv(pose)[:3]) for i, pose in enumerate(poses)]
    write_model(tmp_path / "model", SparseModel.without_points(cameras, inverted))
    of_colmap = read_poses(tmp_path / "model", PHOTOS, {}, PoseConvention("world-from-camera", None))
    for model in (known.model, of_colmap.model):
        for image, pose in zip(model.images, poses, strict=True):
            np.testing.assert_allclose(image.sfm_from_camera, pose[:3], atol=1e-12)


@pytest.mark.parametrize("with_test", [True, False])
def test_blender_folders_keep_their_split(tmp_path: Path, with_test: bool) -> None:
    for split, indices in (("train", (0, 1)), ("test", (2,))):
        if split == "train" or with_test:
            content = {"camera_angle_x": math.pi / 2, "frames": [frame(i) for i in indices]}
            (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    known = read_poses(tmp_path, PHOTOS, NAMES)
    assert len(known.model.images) == (3 if with_test else 2)
    assert known.test_files == (["a2.png"] if with_test else None)
    (camera,) = known.model.cameras
    assert camera.params == pytest.approx((30, 30, 30, 20))


def test_lenses_that_are_said_to_be_approximations_are_noted(read) -> None:
    note = intrinsics(Camera("FOV", W, H, (50.0, 52.0, 31.0, 19.0, 0.9)))["note"]
    known = read([frame(0, note=note), frame(1, note="by hand"), frame(2, note=note)], **LENS)
    assert codes(known.notes) == ["sfm.approximate-cameras"] and "2 frames" in known.notes[0].text


def colmap_model(folder: Path, names: list[str]) -> SparseModel:
    camera = Camera("RADIAL", W, H, (50.0, 31.0, 19.0, 0.1, 0.0))
    images = [SparseImage(name, 0, matrix(i)[:3] @ np.diag([1.0, -1, -1, 1])) for i, name in enumerate(sorted(names))]
    count = len(names)
    model = SparseModel(
        cameras=[camera],
        images=images,
        xyz=np.array([[0.0, 2, -9], [1, 2, -8]]),
        rgb=np.full((2, 3), 9, np.uint8),
        error_px=np.zeros(2),
        view=np.repeat(np.arange(count), 2),
        point=np.tile([0, 1], count),
        xy=np.tile([[20.0, 10.0], [40.0, 30.0]], (count, 1)),
    )
    write_model(folder, model)
    return model


def test_points_behind_cameras_or_in_them_are_left_out(tmp_path: Path) -> None:
    """COLMAP gives such an observation an error of 1e153 pixels."""
    given = colmap_model(tmp_path, ["ä0.png", "ä1.png"])
    behind = given.images[0].sfm_from_camera @ np.array([0.0, 0, -1, 1])
    harmed = dataclasses.replace(given, xyz=np.stack([behind, given.images[1].sfm_from_camera[:, 3]]))
    write_model(tmp_path, harmed)
    known = read_poses(tmp_path, PHOTOS, {})
    assert known.notes[-1].code == "sfm.points-behind"
    seen = known.model
    depth = [
        ((seen.xyz[p] - seen.images[v].sfm_from_camera[:, 3]) @ seen.images[v].sfm_from_camera[:, 2])
        for v, p in zip(seen.view, seen.point, strict=True)
    ]
    assert len(seen.view) < len(given.view) and all(d > 0 for d in depth)
    assert len(seen.xyz) == len(set(seen.point.tolist())) == len(seen.rgb) == len(seen.error_px)


def test_a_colmap_model_is_matched_by_name(tmp_path: Path) -> None:
    given = colmap_model(tmp_path, ["ä1.png", "elsewhere/ä0.png", "other.png"])
    known = read_poses(tmp_path, PHOTOS, {})
    assert [image.file for image in known.model.images] == ["a0.png", "a1.png"]
    poses = {image.file: image.sfm_from_camera for image in given.images}
    np.testing.assert_allclose(known.model.images[0].sfm_from_camera, poses["elsewhere/ä0.png"], atol=1e-12)
    np.testing.assert_allclose(known.model.images[1].sfm_from_camera, poses["ä1.png"], atol=1e-12)
    assert len(known.model.xyz) == 2
    assert codes(known.notes) == ["sfm.no-photo", "sfm.no-camera"] and "other.png" in known.notes[0].text
    assert [entry["observations"] for entry in known.account(PHOTOS)] == [2, 2, 0]


def test_a_colmap_model_that_was_written_on_windows(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["left\\ä0.png", "right\\ä0.png", "right\\ä1.png"])
    photos = [photo(0, folder="left/"), photo(0, folder="right/"), photo(1, folder="right\\")]
    known = read_poses(tmp_path, photos, {})
    assert [image.file for image in known.model.images] == ["left/a0.png", "right/a0.png", "right\\a1.png"]
    assert known.notes == []


def test_two_images_of_one_name_are_one_or_refused(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["ä0.png", "ä1.png", "ä2.png"])
    text = tmp_path / "text"
    text.mkdir()
    pycolmap.Reconstruction(tmp_path).write_text(text)
    (text / "points3D.txt").unlink()
    lines = (text / "images.txt").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.endswith("ä0.png"))
    _, *rest = lines[first].split()
    (text / "images.txt").write_text("\n".join([*lines, " ".join(["9", *rest]), ""]) + "\n")
    known = read_poses(text, PHOTOS, {})
    assert [image.file for image in known.model.images] == ["a0.png", "a1.png", "a2.png"]
    assert codes(known.notes) == ["sfm.repeated-images", "sfm.no-points"] and "ä0.png" in known.notes[0].text
    moved = [rest[0], *rest[1:4], "7.5", *rest[5:]]
    (text / "images.txt").write_text("\n".join([*lines, " ".join(["9", *moved]), ""]) + "\n")
    with refused("sfm.two-images", "ä0.png", str(text)):
        read_poses(text, PHOTOS, {})


def test_a_colmap_model_of_larger_photos_is_scaled(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["ä0.png", "ä1.png"])
    known = read_poses(tmp_path, [photo(0, W // 2, H // 2), photo(1)], {})
    assert [camera.params for camera in known.model.cameras] == [(25, 15.5, 9.5, 0.1, 0), (50, 31, 19, 0.1, 0)]
    np.testing.assert_array_equal(known.model.xy, [[10, 5], [20, 15], [20, 10], [40, 30]])


def test_a_colmap_model_of_panoramas_is_refused(tmp_path: Path) -> None:
    given = colmap_model(tmp_path, ["ä0.png", "ä1.png"])
    write_model(tmp_path, dataclasses.replace(given, cameras=[Camera("EQUIRECTANGULAR", W, H, (float(W), float(H)))]))
    with refused("sfm.degenerate-camera", "ä0.png", "panoramas"):
        read_poses(tmp_path, PHOTOS, {})


def test_a_name_that_two_photos_share_matches_neither(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["ä0.png", "ä1.png"])
    photos = [photo(0, folder="left/"), photo(0, folder="right/"), photo(1)]
    known = read_poses(tmp_path, photos, {})
    assert [image.file for image in known.model.images] == ["a1.png"]


@pytest.mark.parametrize(
    ("images", "own", "matches"),
    [
        ([], [], {}),
        (["cam0/0.jpg"], ["cam1/0.jpg"], {}),  # a photo of another folder
        (["cam0/0.jpg", "cam1/0.jpg"], ["cam1/0.jpg"], {1: "cam1/0.jpg"}),
        (["cam0/0.jpg", "cam1/0.jpg"], ["0.jpg"], {}),  # whose it is cannot be known
        (["0.jpg"], ["cam0/0.jpg", "cam1/0.jpg"], {}),
        (["cam0/0.jpg", "0.jpg"], ["cam0/0.jpg", "cam1/0.jpg"], {0: "cam0/0.jpg"}),
        (["set/cam0/0.jpg", "1.jpg"], ["cam0/0.jpg", "b/1.jpg"], {0: "cam0/0.jpg", 1: "b/1.jpg"}),
        (["xcam0/0.jpg"], ["cam0/0.jpg"], {}),
        (["i/l/0.jpg", "i/r/0.jpg"], ["l/0.jpg", "r/0.jpg"], {0: "l/0.jpg", 1: "r/0.jpg"}),  # all in a folder more
        (["i/l/0.jpg", "i/l/1.jpg"], ["l/0.jpg", "r/0.jpg", "0.jpg"], {0: "l/0.jpg"}),
        (["l/0.jpg", "r/0.jpg"], ["i/l/0.jpg", "i/r/0.jpg"], {0: "i/l/0.jpg", 1: "i/r/0.jpg"}),
        (["l/0.jpg", "l/1.jpg"], ["r/0.jpg", "r/1.jpg"], {}),
        (["ä.jpg", "a.png"], ["ä.jpg"], {0: "ä.jpg"}),  # a model with both of its names
        (["b/a.png"], ["b/ä.jpg"], {0: "b/ä.jpg"}),
        (["0.jpg", "b/1.JPG", "2"], ["0.png", "b/1.jpg", "2.png"], {0: "0.png", 1: "b/1.jpg", 2: "2.png"}),
        (["b/0.jpg", "1.jpg"], ["0.png", "b/1.png"], {}),  # of another folder as well
        (["i/0.png", "i/b/1.JPG"], ["0.jpg", "b/1.png"], {0: "0.jpg", 1: "b/1.png"}),  # all in one more
        (["0.png", "A"], ["i/0.jpg", "i/a.jpg"], {0: "i/0.jpg"}),
        (["i/A.png", "i/A.png", "i/c.png"], ["a.png", "c.jpg", "c.tif"], {0: "a.png"}),
        (["0.jpg", "1.jpg", "1.jpeg"], ["0.png", "0.tif", "1.png"], {}),
        (["0.jpg", "0.png"], ["0.png"], {1: "0.png"}),
        (["IMG_0.JPG", "B/1.PNG"], ["img_0.jpg", "b/1.png"], {0: "img_0.jpg", 1: "b/1.png"}),
        (["IMG_0.JPG"], ["img_0.jpg", "Img_0.jpg"], {}),
        (["a\u0308.png", "b/o\u0308.jpg"], ["\u00e4.png", "\u00f6.jpg"], {0: "\u00e4.png", 1: "\u00f6.jpg"}),
        (["a%20b/0%2e.jpg", "c%20.png"], ["a b/0..jpg", "c .png"], {0: "a b/0..jpg", 1: "c .png"}),
        (["set%201/a%20b.jpg", "a%20c.jpg"], ["a b.jpg", "a%20c.jpg", "a c.jpg"], {0: "a b.jpg", 1: "a%20c.jpg"}),
        (
            ["IMG.2020.1", "IMG.2020.2"],
            ["IMG.2020.1.jpg", "IMG.2020.2.JPG"],
            {0: "IMG.2020.1.jpg", 1: "IMG.2020.2.JPG"},
        ),
        (["c/a\u0308.jpg", "c/a\u0308.png"], ["c/\u00e4.jpg", "c/\u00e4.png"], {0: "c/\u00e4.jpg", 1: "c/\u00e4.png"}),
    ],
)
def test_images_have_the_photos_of_their_names(images: list[str], own: list[str], matches: dict[int, str]) -> None:
    photos = []
    for name in own:
        file = f"images/{name.replace('ä.jpg', 'a.png')}"
        photos.append(Photo(name, file, W, H, 0, None, None, False, 1.0))
    assert {index: photo.name for index, photo in photos_by_name(images, photos).items()} == matches


def test_cameras_of_photos_with_another_ending_are_taken_and_named(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["ä0.jpg", "a1.png", "ä2.png"])
    known = read_poses(tmp_path, PHOTOS, {})
    assert [image.file for image in known.model.images] == ["a0.png", "a1.png", "a2.png"]
    assert codes(known.notes) == ["sfm.other-spellings"] and "ä0.png (ä0.jpg)" in known.notes[0].text


def test_one_name_that_is_not_clear_leaves_the_other_cameras(tmp_path: Path) -> None:
    colmap_model(tmp_path, ["left/ä0.png", "right/ä0.png", "ä1.png"])
    known = read_poses(tmp_path, PHOTOS, {})
    assert [image.file for image in known.model.images] == ["a1.png"]
    assert known.notes[0].code == "sfm.no-photo" and "left/ä0.png, right/ä0.png" in known.notes[0].text


def test_the_fox_of_instant_ngp(shared_data: Path) -> None:
    content = json.loads((shared_data / "fox/transforms.json").read_text())
    names = {entry["file_path"]: Path(entry["file_path"]).name for entry in content["frames"]}
    photos = [Photo(name, f"images/{name}", 648, 1152, 0, None, None, False, 1.0) for name in names.values()]
    known = read_poses(shared_data / "fox/transforms.json", photos, names)
    assert len(known.model.images) == 50
    assert [(camera.model, camera.params[0]) for camera in known.model.cameras] == [("OPENCV", 825.312)]
