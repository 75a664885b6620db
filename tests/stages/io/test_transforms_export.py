import math
from dataclasses import replace

import numpy as np
import pytest

from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.io.colmap_files import PARAMETERS
from stages.io.transforms_export import intrinsics, transforms
from stages.sfm.imported.transforms_intrinsics import read_intrinsics
from tests.camera_layouts import ring

TURN = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
SCENE_FROM_SFM = Similarity(0.25, TURN, np.array([1.0, -2.0, 0.5]))
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0))


def scene_of(cameras: tuple[Camera, ...], sfm_poses: np.ndarray) -> Scene:
    views = tuple(
        View(
            f"IMG {i}.jpg",
            f"images/{i}.png",
            i % len(cameras),
            SCENE_FROM_SFM.pose(pose),
            0.5,
            9.0,
            "train" if i else "test",
        )
        for i, pose in enumerate(sfm_poses)
    )
    return Scene(cameras, views, SCENE_FROM_SFM, False, False, "object-centric", True)


def test_poses_are_opengl_and_in_the_sfm_frame() -> None:
    poses = ring(5)
    content = transforms(scene_of((PINHOLE,), poses))
    for pose, frame in zip(poses, content["frames"], strict=True):
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, 3], pose[:, 3], atol=1e-12)
        np.testing.assert_allclose(matrix[:3, 0], pose[:, 0], atol=1e-12)  # right
        np.testing.assert_allclose(matrix[:3, 1], -pose[:, 1], atol=1e-12)  # up
        np.testing.assert_allclose(matrix[:3, 2], -pose[:, 2], atol=1e-12)  # backward
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


def test_names_split_and_shared_intrinsics() -> None:
    content = transforms(scene_of((PINHOLE,), ring(4)))
    assert [frame["file_path"] for frame in content["frames"]] == [f"images/{i}.png" for i in range(4)]
    assert [frame["photo"] for frame in content["frames"]] == [f"IMG {i}.jpg" for i in range(4)]
    assert content["test_filenames"] == ["images/0.png"]
    assert content["train_filenames"] == [f"images/{i}.png" for i in (1, 2, 3)]
    assert (content["fl_x"], content["fl_y"], content["cx"], content["cy"]) == PINHOLE.params
    assert (content["w"], content["h"], content["camera_model"]) == (640, 480, "OPENCV")
    assert set(content["frames"][0]) == {"file_path", "photo", "transform_matrix"}


@pytest.mark.parametrize("without", [0, 1, 4])
def test_masks_are_named_where_every_photo_has_one(without: int) -> None:
    scene = scene_of((PINHOLE, PINHOLE), ring(4))
    views = [replace(view, mask=f"masks/{i}.png" if i >= without else None) for i, view in enumerate(scene.views)]
    frames = transforms(replace(scene, views=tuple(views)))["frames"]
    expected = [None if without else f"masks/{i}.png" for i in range(4)]
    assert [frame.get("mask_path") for frame in frames] == expected


def test_different_cameras_stand_in_their_frames() -> None:
    other = Camera("OPENCV", 320, 240, (250.0, 251.0, 160.0, 120.0, 0.1, -0.02, 0.003, 0.004))
    content = transforms(scene_of((PINHOLE, other), ring(4)))
    assert "fl_x" not in content
    assert [frame["w"] for frame in content["frames"]] == [640, 320, 640, 320]
    assert [content["frames"][1][key] for key in ("k1", "k2", "p1", "p2")] == [0.1, -0.02, 0.003, 0.004]


def test_fisheyes_are_declared_where_other_programs_look() -> None:
    """instant-ngp asks for ``is_fisheye`` beside the terms, nerfstudio for one ``camera_model`` at the top."""
    fisheyes = tuple(Camera("OPENCV_FISHEYE", 8, 6, (f, 6.0, 4.0, 3.0, 0.1, 0.0, 0.0, 0.0)) for f in (5.0, 5.5))
    content = transforms(scene_of(fisheyes, ring(4)))
    assert content["camera_model"] == "OPENCV_FISHEYE" and "fl_x" not in content
    assert all(frame["is_fisheye"] is True and "k1" in frame for frame in content["frames"])
    assert transforms(scene_of(fisheyes[:1], ring(4)))["is_fisheye"] is True
    mixed = transforms(scene_of((fisheyes[0], PINHOLE), ring(4)))
    assert "camera_model" not in mixed
    assert ["is_fisheye" in frame for frame in mixed["frames"]] == [True, False, True, False]


def test_the_region_lies_in_instant_ngps_unit_cube() -> None:
    content = transforms(scene_of((PINHOLE,), ring(4)))
    centre = SCENE_FROM_SFM.inverse().points(np.zeros(3))
    np.testing.assert_allclose(content["scale"] * centre + content["offset"], 0.5)
    assert content["scale"] * 0.9 / SCENE_FROM_SFM.scale == pytest.approx(0.45)
    assert math.log2(content["aabb_scale"]).is_integer()


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        (Camera("SIMPLE_RADIAL", 8, 6, (5.0, 4.0, 3.0, 0.1)), {"fl_x": 5.0, "fl_y": 5.0, "cx": 4.0, "k1": 0.1}),
        (Camera("RADIAL", 8, 6, (5.0, 4.0, 3.0, 0.1, 0.2)), {"fl_y": 5.0, "k1": 0.1, "k2": 0.2}),
        (
            Camera("FULL_OPENCV", 8, 6, tuple(map(float, range(1, 13)))),
            {"camera_model": "FULL_OPENCV", "k2": 6.0, "p1": 7.0, "k3": 9.0, "k4": 10.0, "k6": 12.0},
        ),
        (
            Camera("FULL_OPENCV", 8, 6, (*map(float, range(1, 10)), 0.0, 0.0, 0.0)),
            {"camera_model": "OPENCV", "p1": 7.0, "k3": 9.0, "k4": 0.0},
        ),
        (
            Camera("OPENCV_FISHEYE", 8, 6, (5.0, 6.0, 4.0, 3.0, 0.1, 0.2, 0.3, 0.4)),
            {"camera_model": "OPENCV_FISHEYE", "fl_y": 6.0, "k3": 0.3, "k4": 0.4},
        ),
    ],
)
def test_camera_models_under_the_formats_names(camera: Camera, expected: dict[str, object]) -> None:
    values = intrinsics(camera)
    assert values.items() >= expected.items()
    assert "f" not in values
    assert "note" not in values


@pytest.mark.parametrize(
    "camera",
    [
        Camera("OPENCV", 60, 40, (50.0, 52.0, 31.0, 19.0, 0.1, 0.01, 0.02, 0.03)),
        Camera("FULL_OPENCV", 60, 40, (50.0, 52.0, 31.0, 19.0, 0.1, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07)),
        Camera("FULL_OPENCV", 60, 40, (50.0, 52.0, 31.0, 19.0, 0.1, 0.01, 0.02, 0.03, 0.04, 0.0, 0.0, 0.0)),
        Camera("OPENCV_FISHEYE", 60, 40, (50.0, 52.0, 31.0, 19.0, 0.1, 0.01, 0.02, 0.03)),
    ],
)
def test_a_lens_comes_back_as_it_was_written(camera: Camera) -> None:
    assert read_intrinsics(intrinsics(camera), 1, 1) == camera


def test_an_unknown_model_is_exported_as_the_nearest() -> None:
    values = intrinsics(Camera("FOV", 8, 6, (5.0, 6.0, 4.0, 3.0, 0.9)))
    assert (values["camera_model"], values["fl_x"], values["cy"]) == ("OPENCV", 5.0, 3.0)
    assert values["note"] == "approximation: FOV with parameters [5.0, 6.0, 4.0, 3.0, 0.9] has no counterpart here"


@pytest.mark.parametrize("model", sorted(PARAMETERS.keys() - {"EQUIRECTANGULAR"}))
def test_every_lens_that_colmap_has_is_written(model: str) -> None:
    count = PARAMETERS[model]
    values = intrinsics(Camera(model, 8, 6, tuple(float(i + 1) for i in range(count))))
    shared_focal = model.startswith(("SIMPLE", "RADIAL"))
    assert (values["fl_x"], values["fl_y"]) == (1.0, 1.0 if shared_focal else 2.0)
    assert (values["cx"], values["cy"]) == ((2.0, 3.0) if shared_focal else (3.0, 4.0))
    assert ("FISHEYE" in model) == (values["camera_model"] == "OPENCV_FISHEYE")


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(ValueError, match="camera model EQUIRECTANGULAR has no counterpart"):
        intrinsics(Camera("EQUIRECTANGULAR", 8, 4, ()))
