from pathlib import Path

import numpy as np
import pytest
import trimesh

from nerf.geometry.scene import Similarity
from stages.depth.consistency import DepthMap
from stages.depth.photos import TrainingPhotos, read_training_photos
from stages.depth.point_cloud import PointCloud, fuse, normals, ply_bytes
from tests.stages.depth.walls import FISHEYE, PINHOLE, WallScene, cameras_before, wall

TURN_DEG = 25.0


def true_map(scene: WallScene, view: int) -> DepthMap:
    distance = scene.distances(view, scene.camera.width, scene.camera.height)
    known = np.isfinite(distance)
    return DepthMap(np.where(known, distance, 0).astype(np.float32), np.where(known, 1e-3, 0), known.astype(np.uint8))


def a_wall(camera=PINHOLE) -> WallScene:
    return WallScene([wall((0, 0.5, 0), (1.2, 0.8), TURN_DEG, seed=1)], cameras_before(), camera=camera)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE])
def test_normals_of_a_wall_are_exact_in_any_camera(camera, tmp_path: Path) -> None:
    scene = a_wall(camera)
    photos = read_training_photos(scene.write(tmp_path), 1.0)
    depth = true_map(scene, 0)
    found = normals(photos.viewpoints[0], depth) @ photos.poses[0][:, :3].T
    expected = np.array([np.sin(np.radians(TURN_DEG)), -np.cos(np.radians(TURN_DEG)), 0])
    known = depth.distance > 0
    inner = known & np.roll(known, 4, 0) & np.roll(known, -4, 0) & np.roll(known, 4, 1) & np.roll(known, -4, 1)
    assert inner.sum() > 1000
    assert (found[inner] @ expected).min() > 0.999
    assert np.allclose(np.linalg.norm(found, axis=2), 1, atol=1e-5)


@pytest.fixture(scope="module")
def fused(tmp_path_factory: pytest.TempPathFactory) -> tuple[WallScene, TrainingPhotos, PointCloud, list[DepthMap]]:
    scene = a_wall()
    photos = read_training_photos(scene.write(tmp_path_factory.mktemp("wall")), 1.0)
    maps = [true_map(scene, view) for view in range(len(scene.poses))]
    astray = maps[2].distance.copy()
    astray[60:80, 100:140] *= 0.7  # what no other photo has there
    maps[2] = maps[2]._replace(distance=astray)
    cloud = fuse(photos, maps.__getitem__, sum(int(m.views.sum()) for m in maps), lambda share: None)
    return scene, photos, cloud, maps


def test_each_piece_of_surface_comes_once_and_where_it_is(fused) -> None:
    scene, _, cloud, maps = fused
    (one,) = scene.walls
    normal = np.cross(one.across, one.down)
    off = (cloud.points - one.centre) @ normal / np.linalg.norm(normal)
    assert np.abs(off).max() < 1e-3, "and nothing of what one photo alone has"
    largest = max(int(depth.views.sum()) for depth in maps)
    assert 0.9 * largest < len(cloud.points) < 1.6 * largest
    assert cloud.confidence.min() >= 2 and cloud.confidence.max() == len(maps)


def test_points_have_the_colours_of_the_photos(fused) -> None:
    scene, _, cloud, _ = fused
    (one,) = scene.walls
    at = cloud.points - one.centre
    u, v = (at @ axis / (axis @ axis) for axis in (one.across, one.down))
    rows, columns = one.picture.shape
    painted = one.picture[
        np.clip(((v + 1) / 2 * rows), 0, rows - 1).astype(int),
        np.clip(((u + 1) / 2 * columns), 0, columns - 1).astype(int),
    ]
    assert np.corrcoef(painted, cloud.colours[:, 0])[0, 1] > 0.9


def test_a_limit_of_points_thins_them_evenly(fused, monkeypatch) -> None:
    _, photos, cloud, maps = fused
    most = len(cloud.points) // 3
    monkeypatch.setattr("stages.depth.point_cloud.MAX_POINTS", most)
    known = sum(int((m.distance > 0).sum()) for m in maps)
    fewer = fuse(photos, maps.__getitem__, known, lambda share: None)
    assert len(fewer.points) == pytest.approx(most, rel=0.15)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_ply_is_read_back_as_it_was(offset: float, fused, tmp_path: Path) -> None:
    cloud = fused[2]
    moved = Similarity(2.0, np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.array([offset, 0, 0]))
    path = tmp_path / "points.ply"
    path.write_bytes(ply_bytes(cloud, moved))
    loaded = trimesh.load(path)
    assert isinstance(loaded, trimesh.PointCloud)
    assert np.abs(np.asarray(loaded.vertices) - moved.points(cloud.points)).max() < (1e-6 if offset == 0 else 0.1)
    assert np.array_equal(np.asarray(loaded.colors)[:, :3], cloud.colours)
    written = loaded.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(written["confidence"].ravel(), cloud.confidence)
    assert np.allclose(
        np.stack([written[f"n{a}"].ravel() for a in "xyz"], axis=1), cloud.normals @ moved.rotation.T, atol=1e-6
    )
    if offset:
        assert written["x"].dtype == np.float64
