import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera
from stages.depth.rectification import (
    CannotRectify,
    Pixels,
    Rectified,
    Viewpoint,
    coordinates,
    rectify,
    resampled,
)
from stages.sfm.colmap.cameras import camera_rays, project
from tests.stages.depth.walls import FISHEYE, PINHOLE

BARREL = Camera("OPENCV", 240, 180, (250.5, 249.75, 120.6, 89.65, -0.085, 0.032, 0.0011, -0.0008))
FORWARD = np.array([0.0, 1.0, 0.0])


def viewpoint(centre: list[float], camera: Camera = PINHOLE, aim: np.ndarray = FORWARD, roll: float = 0) -> Viewpoint:
    pose = look_at(np.array([centre], float), np.array(centre) + aim)[0]
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    pose = np.concatenate([pose[:, :3] @ turn, pose[:, 3:]], axis=1)
    return Viewpoint(camera, pose, camera_rays(camera, camera.width, camera.height))


def plane_position(pair: Rectified, photo: Viewpoint, points: np.ndarray) -> np.ndarray:
    local = (points - photo.scene_from_camera[:, 3]) @ pair.scene_from_rectified
    return pair.focal_px * local[:, :2] / local[:, 2:]


@pytest.mark.parametrize("camera", [PINHOLE, BARREL, FISHEYE])
@pytest.mark.parametrize("offset", [(0.3, 0, 0), (-0.2, 0.02, 0.2), (0, 0, 0.3)])
def test_a_point_lies_in_one_row_disparity_tells_depth(camera: Camera, offset: tuple[float, float, float]) -> None:
    one, other = viewpoint([0, -3, 0], camera), viewpoint([offset[0], -3 + offset[1], offset[2]], camera, roll=0.4)
    pair = rectify(one, other, (2.0, 5.0), 512)
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))
    left, right = (plane_position(pair, photo, points) for photo in (one, other))
    depth = (points - one.scene_from_camera[:, 3]) @ pair.scene_from_rectified[:, 2]
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-9
    assert np.allclose(left[:, 0] - right[:, 0], pair.focal_px * pair.baseline / depth)


@pytest.mark.parametrize("camera", [PINHOLE, BARREL, FISHEYE])
def test_resampled_pixels_are_those_of_their_directions(camera: Camera) -> None:
    one, other = viewpoint([0, -3, 0], camera, roll=0.7), viewpoint([0.3, -3, 0.1], camera)
    pair = rectify(one, other, (2.0, 5.0), 512)
    x = np.tile(np.arange(camera.width, dtype=np.uint8), (camera.height, 1))  # each pixel tells its column
    got = resampled(pair, one, Pixels(x, np.ones(x.shape, bool)), (pair.left, pair.width))
    across, down = np.meshgrid(*pair.plane)
    rectified = np.stack([across, down, np.full(across.shape, pair.focal_px)], axis=-1)
    local = rectified @ pair.scene_from_rectified.T @ one.scene_from_camera[:, :3]
    at = project(camera, local.reshape(-1, 3)).reshape((*across.shape, 2))[..., 0] - 0.5
    inner = got.used & (at > 1) & (at < camera.width - 2)
    assert 0.3 < inner.mean() <= 1
    assert np.abs(got.grey.astype(float) - at)[inner].max() < 0.6  # rounded to whole columns


def test_photo_pixels_find_their_place_on_the_plane() -> None:
    one, other = viewpoint([0, -3, 0], BARREL), viewpoint([0.3, -3, 0.1], BARREL)
    pair = rectify(one, other, (2.0, 5.0), 512)
    points = one.scene_from_camera[:, 3] + 2 * one.ray_directions.reshape(-1, 3) @ one.scene_from_camera[:, :3].T
    x, y = coordinates(pair, one)
    assert np.abs(np.stack([x.ravel(), y.ravel()], axis=1) - plane_position(pair, one, points)).max() < 1e-2


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (viewpoint([0, -3, 0]), "one place"),
        (viewpoint([0, -2.5, 0]), "along the line"),
        (viewpoint([0.3, -3, 0], aim=-FORWARD), "along the line"),
        (viewpoint([0.3, -3, 0], aim=np.array([1, 0.2, 0])), "too different"),
    ],
)
def test_pairs_without_a_common_plane_are_refused(other: Viewpoint, why: str) -> None:
    with pytest.raises(CannotRectify, match=why):
        rectify(viewpoint([0, -3, 0]), other, (2.0, 5.0), 512)


def test_what_distortion_folds_back_is_not_used() -> None:
    folding = Camera("SIMPLE_RADIAL", 240, 180, (230.0, 120.0, 90.0, -0.35))
    one, other = viewpoint([0, -3, 0], folding), viewpoint([0.3, -3, 0], folding)
    pair = rectify(one, other, (2.0, 5.0), 512)
    ones = Pixels(np.zeros((180, 240), np.uint8), np.ones((180, 240), bool))
    wide = resampled(pair, one, ones, (-1000, 2000)).used
    tangent = np.abs(np.arange(-1000, 1000)[wide.any(axis=0)]).max() / pair.focal_px
    assert 0.5 < tangent < np.sqrt(1 / (3 * 0.35)) + 0.05, "beyond that radius the model turns back"
