import re
from pathlib import Path

import numpy as np
import pytest

from nerf.geometry.scene import Camera
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.adjustment.intrinsics import why_degenerate
from stages.sfm.colmap.cameras import camera_rays, is_valid, native, project, ray_directions, rescaled
from stages.sfm.colmap.models import read_model, write_model
from tests.refusals import refused

W, H = 60, 40


def lens(model: str, *params: float) -> Camera:
    return Camera(model, W, H, tuple(map(float, params)))


CAMERAS = [
    lens("SIMPLE_PINHOLE", 50, 31, 19),
    lens("PINHOLE", 50, 52, 31, 19),
    lens("SIMPLE_RADIAL", 50, 31, 19, -0.1),
    lens("RADIAL", 50, 31, 19, -0.1, 0.03),
    lens("OPENCV", 50, 52, 31, 19, -0.1, 0.03, 0.001, -0.002),
    lens("FULL_OPENCV", 50, 52, 31, 19, -0.1, 0.03, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0),
    lens("OPENCV_FISHEYE", 50, 52, 31, 19, 0.05, 0.01, 0.0, 0.0),
    lens("SIMPLE_RADIAL_FISHEYE", 50, 31, 19, 0.05),
    lens("THIN_PRISM_FISHEYE", 50, 52, 31, 19, 0.05, 0.01, 0.001, 0.001, 0.0, 0.0, 0.001, 0.001),
    lens("EQUIRECTANGULAR", W, H),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("size", [(W, H), (30, 20), (41, 26), (1, 1)])
def test_rays_project_back_to_the_pixel_centres(camera: Camera, size: tuple[int, int]) -> None:
    rays = camera_rays(camera, *size)
    assert rays.shape == (size[1], size[0], 3)
    assert rays.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    x, y = np.meshgrid((np.arange(size[0]) + 0.5) * W / size[0], (np.arange(size[1]) + 0.5) * H / size[1])
    np.testing.assert_allclose(project(camera, rays.reshape(-1, 3)), np.stack([x, y], -1).reshape(-1, 2), atol=1e-3)


def test_rays_of_a_pinhole_are_what_they_should_be() -> None:
    rays = camera_rays(CAMERAS[1], 30, 10)  # half as wide, a quarter as high
    expected = np.array([(2 * 7.5 - 31) / 50, (4 * 3.5 - 19) / 52, 1.0])
    np.testing.assert_allclose(rays[3, 7], expected / np.linalg.norm(expected), atol=1e-7)


@pytest.mark.parametrize("k", [-2.0, -0.9])
def test_distortion_that_cannot_be_undone_is_refused_with_its_share(k: float) -> None:
    with refused("sfm.no-ray", "SIMPLE_RADIAL"):
        camera_rays(lens("SIMPLE_RADIAL", 30.0, 30.0, 20.0, k), W, H)


def test_rays_lie_before_a_fold_beyond_the_corners() -> None:
    """The lens that the 34 photos of LLFF's flower call for: two angles have the radius of a corner."""
    focal, *terms = 48.4, 0.73858, -3.44092, 13.11131, -16.31588
    rays = camera_rays(lens("OPENCV_FISHEYE", focal, focal, W / 2, H / 2, *terms), W, H)
    x, y = np.meshgrid(np.arange(W) + 0.5 - W / 2, np.arange(H) + 0.5 - H / 2)
    angle = np.linspace(0, np.radians(40), 10_001)  # up to the fold, at 40.7 degrees
    radius = focal * angle * np.polyval([*terms[::-1], 1], angle**2)
    expected = np.interp(np.hypot(x, y), radius, angle)
    np.testing.assert_allclose(np.arccos(rays[..., 2].astype(float)), expected, atol=2e-4)
    np.testing.assert_allclose(np.arctan2(rays[..., 1], rays[..., 0]), np.arctan2(y, x), atol=1e-5)


@pytest.mark.parametrize(("model", "focals", "terms"), [("SIMPLE_FISHEYE", 1, 0), ("OPENCV_FISHEYE", 2, 4)])
def test_a_fisheye_of_180_degrees_is_to_be_cropped(model: str, focals: int, terms: int) -> None:
    def cropped_to(side: int) -> Camera:
        """Of a lens whose circle is 100 pixels across."""
        return Camera(model, side, side, (50 / (np.pi / 2),) * focals + (side / 2, side / 2) + (0.0,) * terms)

    with refused("sfm.no-ray", model) as raised:
        camera_rays(cropped_to(100), 100, 100)
    assert "beyond 90°" in raised.value.why
    assert "crop" in raised.value.hint
    assert re.match(r"it looks beyond 90° .* at \d+\.\d% of the pixels", str(why_degenerate(native(cropped_to(100)))))
    assert camera_rays(cropped_to(70), 70, 70)[..., 2].min() > 0
    assert why_degenerate(native(cropped_to(70))) is None


def test_points_behind_the_camera_project_nowhere() -> None:
    pixels = project(CAMERAS[4], np.array([[0.0, 0.0, 1.0], [0.1, 0.1, -1.0], [0.0, 0.0, -2.0]]))
    np.testing.assert_allclose(pixels[0], (31, 19), atol=1e-9)
    assert np.isnan(pixels[1:]).all()


def test_what_projects_into_the_image_is_seen_there() -> None:
    """A barrel distortion folds back: far beyond the corners, points have pixels of the image."""
    camera, points = lens("SIMPLE_RADIAL", 50, 31, 19, -0.2), np.random.default_rng(0).normal(size=(4000, 3))
    unguarded, pixels = np.asarray(native(camera).img_from_cam(points)), project(camera, points)
    inside, folded = (((at > 0) & (at < (W, H))).all(axis=1) for at in (pixels, unguarded))
    assert 100 < inside.sum() < folded.sum()
    directions = points[inside] / np.linalg.norm(points[inside], axis=1, keepdims=True)
    np.testing.assert_allclose(ray_directions(camera, pixels[inside]), directions, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS[:-1], ids=lambda camera: camera.model)
def test_points_a_little_beside_the_image_have_pixels(camera: Camera) -> None:
    pixels = project(camera, camera_rays(camera, W, H)[[0, -1], :].reshape(-1, 3) * [1.05, 1.05, 1])
    assert np.isfinite(pixels).all()
    assert ((pixels < 0) | (pixels > (W, H))).any()


def test_a_camera_with_the_wrong_number_of_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match="OPENCV takes fx, fy, cx, cy, k1, k2, p1, p2, got 2 numbers"):
        camera_rays(lens("OPENCV", 50.0, 50.0), W, H)


def test_rescaling_scales_lengths_in_pixels_and_nothing_else() -> None:
    assert rescaled(CAMERAS[4], 2 * W, 3 * H).params == (100, 156, 62, 57, -0.1, 0.03, 0.001, -0.002)


@pytest.mark.parametrize("focal", [0.0, -5.0, np.nan, np.inf])
def test_a_camera_needs_a_positive_focal_length(focal: float) -> None:
    assert is_valid(CAMERAS[3])
    assert not is_valid(lens("SIMPLE_PINHOLE", focal, 30.0, 20.0))


def random_model(seed: int = 0, views: int = 5, points: int = 30) -> SparseModel:
    """Cameras in front of a cloud of points, each point seen by at least two of them."""
    random = np.random.default_rng(seed)
    cameras = [lens("PINHOLE", 50, 52, 31, 19), lens("RADIAL", 60, 30, 20, 0.1, 0.0)]
    images = []
    for index in range(views):
        rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
        pose = np.concatenate([rotation * np.linalg.det(rotation), random.normal(size=(3, 1))], axis=1)
        images.append(SparseImage(f"{index:02d}.jpg", index % 2, pose))
    sees = random.uniform(size=(views, points)) < 0.5
    sees[:2] = True
    view, point = np.nonzero(sees)
    xy = random.uniform(0, H, (len(view), 2))
    rgb = random.integers(0, 256, (points, 3)).astype(np.uint8)
    return SparseModel(cameras, images, random.normal(size=(points, 3)), rgb, np.zeros(points), view, point, xy)


def test_a_model_survives_the_disk(tmp_path: Path) -> None:
    model = random_model()
    write_model(tmp_path / "a", model)
    write_model(tmp_path / "b", model)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"]
    assert all((tmp_path / "a" / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in names)
    again = read_model(tmp_path / "a")
    assert again.cameras == model.cameras
    assert [(image.file, image.camera) for image in again.images] == [(i.file, i.camera) for i in model.images]
    for mine, theirs in zip(model.images, again.images, strict=True):
        np.testing.assert_allclose(theirs.sfm_from_camera, mine.sfm_from_camera, atol=1e-12)
    for name in ("xyz", "rgb", "view", "point", "xy"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))


def test_errors_are_the_mean_distance_to_the_projections(tmp_path: Path) -> None:
    pose = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
    moved = pose + np.array([0, 0, 0, 1.0])[None] * np.array([[1.0], [0], [0]])
    images = [SparseImage("a.jpg", 0, pose), SparseImage("b.jpg", 0, moved)]
    seen = np.array([[31.0 + 3, 19 + 4], [31.0 - 50 / 2, 19]])  # five pixels off in the first, exact in the second
    xyz, rgb, point = np.array([[0, 0, 2.0]]), np.zeros((1, 3), np.uint8), np.zeros(2, int)
    model = SparseModel([CAMERAS[1]], images, xyz, rgb, np.zeros(1), np.arange(2), point, seen)
    write_model(tmp_path, model)
    np.testing.assert_allclose(read_model(tmp_path).error_px, [2.5])


def test_cameras_alone_are_a_model_too(tmp_path: Path) -> None:
    model = random_model()
    write_model(tmp_path, SparseModel.without_points(model.cameras, model.images))
    again = read_model(tmp_path)
    assert (len(again.images), len(again.xyz), len(again.view)) == (5, 0, 0)
    assert again.xy.shape == (0, 2)


def test_a_damaged_model_is_an_error_that_names_it(tmp_path: Path) -> None:
    sparse = tmp_path / "sparse"
    with refused("sfm.damaged-model", "sparse"):
        read_model(sparse)
    write_model(sparse, random_model())
    (sparse / "images.bin").write_bytes((sparse / "images.bin").read_bytes()[:100])
    with refused("sfm.damaged-model", "sparse"):
        read_model(sparse)


def test_restricting_to_everything_changes_nothing() -> None:
    model = random_model()
    same = model.restricted(range(5), [np.eye(2, 3)] * 5, model.cameras, model.images)
    for name in ("xyz", "rgb", "error_px", "view", "point", "xy"):
        np.testing.assert_array_equal(getattr(same, name), getattr(model, name))


def test_restricting_keeps_what_the_kept_images_see() -> None:
    model = random_model()
    wider = np.diag([2.0, 1.0, 0.0])[:2]
    part = model.restricted([3, 1], [wider, np.eye(2, 3)], model.cameras, [model.images[3], model.images[1]])
    for new, old, scale in ((0, 3, (2, 1)), (1, 1, (1, 1))):
        mine, theirs = part.view == new, model.view == old
        np.testing.assert_array_equal(part.xyz[part.point[mine]], model.xyz[model.point[theirs]])
        np.testing.assert_array_equal(part.xy[mine], model.xy[theirs] * scale)
    assert set(part.point) == set(range(len(part.xyz)))
