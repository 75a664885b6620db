"""Exported cameras, read by the rules of other programs, see points at the pixels where our cameras see them.

nerfstudio: https://github.com/nerfstudio-project/nerfstudio, nerfstudio_dataparser.py, cameras.py, camera_utils.py.
instant-ngp: https://github.com/NVlabs/instant-ngp, nerf_loader.cu and .h, common_device.cuh.
"""

import json
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
import pytest

from nerf.geometry.scene import Camera, Scene
from stages.io.transforms_export import transforms
from stages.sfm.colmap.cameras import native, project
from stages.sfm.colmap.models import read_model, write_model
from stages.sfm.imported.conventions import inverse
from tests.camera_layouts import ball, ring
from tests.stages.io.test_transforms_export import SCENE_FROM_SFM, scene_of
from tests.stages.sfm.colmap.test_cameras import random_model

POINTS = ball(50)
SIZE = (640, 480)
PERSPECTIVES = [
    Camera("SIMPLE_PINHOLE", *SIZE, (500.0, 310.0, 250.0)),
    Camera("PINHOLE", *SIZE, (500.0, 520.0, 310.0, 250.0)),
    Camera("SIMPLE_RADIAL", *SIZE, (500.0, 310.0, 250.0, -0.1)),
    Camera("RADIAL", *SIZE, (500.0, 310.0, 250.0, -0.1, 0.03)),
    Camera("OPENCV", *SIZE, (500.0, 520.0, 310.0, 250.0, -0.1, 0.03, 0.01, -0.02)),
]
CUBIC = Camera("FULL_OPENCV", *SIZE, (500.0, 520.0, 310.0, 250.0, -0.1, 0.03, 0.01, -0.02, 0.05, 0.0, 0.0, 0.0))
FISHEYES = [
    Camera("SIMPLE_FISHEYE", *SIZE, (500.0, 310.0, 250.0)),
    Camera("FISHEYE", *SIZE, (500.0, 520.0, 310.0, 250.0)),
    Camera("SIMPLE_RADIAL_FISHEYE", *SIZE, (500.0, 310.0, 250.0, -0.1)),
    Camera("RADIAL_FISHEYE", *SIZE, (500.0, 310.0, 250.0, -0.1, 0.03)),
    Camera("OPENCV_FISHEYE", *SIZE, (500.0, 520.0, 310.0, 250.0, -0.1, 0.03, -0.02, 0.01)),
]
IN_BOTH = [(camera,) for camera in PERSPECTIVES + FISHEYES] + [tuple(PERSPECTIVES), tuple(FISHEYES)]


def exported(cameras: tuple[Camera, ...]) -> tuple[Scene, dict[str, Any]]:
    scene = scene_of(cameras, ring(12))
    return scene, json.loads(json.dumps(transforms(scene)))


def true_pixels(scene: Scene) -> dict[str, np.ndarray]:
    """Where COLMAP's cameras see POINTS of the sfm frame, by file."""
    sfm_from_scene = scene.scene_from_sfm.inverse()
    return {
        view.file: project(scene.cameras[view.camera], local(sfm_from_scene.pose(view.scene_from_camera), POINTS))
        for view in scene.views
    }


def local(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of the world in the frame of a camera."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


def ray_plane(points: np.ndarray, fisheye: bool) -> np.ndarray:
    """Of points before a camera (z > 0): the tangent of the angle to its axis in their direction, or the angle."""
    across = np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    return points[:, :2] / across * np.arctan2(across, points[:, 2:]) if fisheye else points[:, :2] / points[:, 2:]


def distorted(uv: np.ndarray, k: list[float], p1: float, p2: float) -> np.ndarray:
    u, v = uv.T
    r2 = u * u + v * v
    radial = 1 + sum(term * r2 ** (i + 1) for i, term in enumerate(k))
    across, down = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + 2 * p2 * u * v
    return np.stack([across, down + p1 * (r2 + 2 * v * v)], axis=1)


def nerfstudio_pixels(content: dict[str, Any]) -> dict[str, np.ndarray]:
    """A number that stands at the top counts for all frames, distortion as soon as one of its terms does; the camera
    model stands at the top or is a perspective. Axes are OpenGL's, pixel centres at +0.5. Poses are the file's where
    they are neither oriented, centred nor scaled, and ``applied_transform`` and ``applied_scale`` undo nothing."""
    assert not {"applied_transform", "applied_scale", "orientation_override"} & content.keys()
    fisheye = {"OPENCV": False, "OPENCV_FISHEYE": True}[content.get("camera_model", "OPENCV")]
    found = {}
    for frame in content["frames"]:
        fx, fy, cx, cy = (float((content if key in content else frame)[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
        terms = content if {"k1", "k2", "k3", "p1", "p2"} & content.keys() else frame
        k, (p1, p2) = [terms.get(f"k{i}", 0.0) for i in range(1, 5)], [terms.get(f"p{i}", 0.0) for i in (1, 2)]
        points = local(np.array(frame["transform_matrix"]), POINTS) * [1, -1, -1]
        found[frame["file_path"]] = distorted(ray_plane(points, fisheye), k, p1, p2) * [fx, fy] + [cx, cy]
    return found


def instant_ngp_pixels(content: dict[str, Any]) -> dict[str, np.ndarray]:
    """Points go into the unit cube by ``scale`` and ``offset``, y, z and x in this order, and so do poses. A frame's
    numbers overrule the top's. A lens has four terms, k1, k2, p1 and p2, or k1 to k4 of a fisheye; where all of them
    are 0 as floats of 32 bits, it is a pinhole."""
    to_cube = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    scale, offset = content["scale"], np.array(content["offset"])
    found = {}
    for frame in content["frames"]:
        focal, centre, terms, fisheye = np.zeros(2), np.full(2, 0.5), np.zeros(4), False
        for values in (content, frame):
            for name, place in {"k1": 0, "k2": 1, "k3": 2, "k4": 3, "p1": 2, "p2": 3}.items():
                terms[place] = values.get(name, terms[place])
                fisheye |= bool(values.get("is_fisheye") and name in values and np.float32(terms[place]))
            if "fl_x" in values:
                focal = np.array([values["fl_x"], values.get("fl_y", values["fl_x"])])
            if "cx" in values:
                centre = np.array([values["cx"] / values["w"], values["cy"] / values["h"]])
        pose = np.array(frame["transform_matrix"])[:3] * [1, -1, -1, 1]
        pose[:, 3] = pose[:, 3] * scale + offset
        uv = ray_plane(local(to_cube @ pose, (POINTS * scale + offset) @ to_cube.T), fisheye)
        k1, k2, *others = terms.tolist()
        uv = distorted(uv, [k1, k2, *others], 0, 0) if fisheye else distorted(uv, [k1, k2], *others)
        found[frame["file_path"]] = uv * focal + centre * SIZE
    return found


def assert_seen_alike(found: dict[str, np.ndarray], scene: Scene) -> None:
    true = true_pixels(scene)
    assert found.keys() == true.keys() and len(true) == 12
    for file, pixels in true.items():
        assert np.isfinite(pixels).all() and np.ptp(pixels, axis=0).min() > 100
        np.testing.assert_allclose(found[file], pixels, rtol=0, atol=1e-6)


@pytest.mark.parametrize("cameras", [*IN_BOTH, (CUBIC,), (CUBIC, PERSPECTIVES[0])], ids=lambda c: c[-1].model)
def test_nerfstudio_sees_what_was_exported(cameras: tuple[Camera, ...]) -> None:
    scene, content = exported(cameras)
    assert_seen_alike(nerfstudio_pixels(content), scene)


@pytest.mark.parametrize("cameras", [*IN_BOTH, (PERSPECTIVES[4], FISHEYES[1])], ids=lambda c: c[-1].model)
def test_instant_ngp_sees_what_was_exported(cameras: tuple[Camera, ...]) -> None:
    scene, content = exported(cameras)
    assert_seen_alike(instant_ngp_pixels(content), scene)


def test_nerfstudio_finds_every_photo_in_one_split() -> None:
    scene, content = exported((PERSPECTIVES[0],))
    files = {PurePosixPath(frame["file_path"]) for frame in content["frames"]}
    train, val, test = (set(map(PurePosixPath, content[f"{split}_filenames"])) for split in ("train", "val", "test"))
    assert train | test == files and not train & test and val == test
    assert all(PurePosixPath(view.file) in (train if view.split == "train" else test) for view in scene.views)


def test_poses_come_back_from_the_scene_frame() -> None:
    scene, content = exported((PERSPECTIVES[0],))
    for view, frame in zip(scene.views, content["frames"], strict=True):
        pose = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(SCENE_FROM_SFM.pose(pose[:3]), view.scene_from_camera, atol=1e-12)


def test_colmap_reads_the_model_that_was_written(tmp_path: Path) -> None:
    given = random_model()
    write_model(tmp_path, given)
    model = pycolmap.Reconstruction(tmp_path)
    assert model.num_reg_images() == len(given.images) and model.num_points3D() == len(given.xyz)
    for index, image in enumerate(given.images):
        read = model.find_image_with_name(image.file)
        own = model.camera(read.camera_id)
        params = tuple(map(float, own.params))
        assert Camera(own.model.name, own.width, own.height, params) == given.cameras[image.camera]
        np.testing.assert_allclose(read.cam_from_world().matrix(), inverse(image.sfm_from_camera), atol=1e-6)
        mine = given.view == index
        np.testing.assert_array_equal([point.xy for point in read.points2D], given.xy[mine])
        seen = [model.point3D(point.point3D_id) for point in read.points2D]
        np.testing.assert_allclose([point.xyz for point in seen], given.xyz[given.point[mine]], atol=1e-6)
        assert [tuple(point.color) for point in seen] == [tuple(rgb) for rgb in given.rgb[given.point[mine]]]


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_poses_of_a_two_camera_rig_are_its_images(write: str, tmp_path: Path) -> None:
    """COLMAP 4 writes what rigs and frames say of poses into images, too: rigs and frames are not read."""
    model = pycolmap.Reconstruction()
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, i) for i in (1, 2)]
    for i in (1, 2):
        model.add_camera(native(PERSPECTIVES[i], i))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.6, 0.0, 0.8]), [-0.2, 0.0, 0.1]))
    model.add_rig(rig)
    for number, pose in enumerate(ring(3), 1):
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(inverse(pose))
        for i, sensor in enumerate(sensors, 1):
            frame.add_data_id(pycolmap.data_t(sensor, 10 * number + i))
        model.add_frame(frame)
        for i in (1, 2):
            name = f"{'left' if i == 1 else 'right'}/{number}.png"
            model.add_image(pycolmap.Image(name=name, camera_id=i, image_id=10 * number + i, frame_id=number))
        model.register_frame(number)
    getattr(model, write)(tmp_path)
    read = read_model(tmp_path)
    assert [image.file for image in read.images] == [f"{side}/{i}.png" for side in ("left", "right") for i in (1, 2, 3)]
    for image in read.images:
        native_pose = model.find_image_with_name(image.file).cam_from_world().inverse().matrix()
        np.testing.assert_allclose(image.sfm_from_camera, native_pose, atol=1e-12)
        assert read.cameras[image.camera] == PERSPECTIVES[1 if image.file.startswith("left") else 2]
