"""Capture type and region of captures some of whose cameras are misplaced."""

import dataclasses

import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at
from nerf.geometry.normalisation import normalise
from nerf.geometry.reconstruction import Reconstruction, angles_deg
from tests.nerf.geometry.test_normalisation import region_half


def with_misplaced_group(scene: Reconstruction, share: float) -> Reconstruction:
    """The first photos, and what they see, at 8 times the scale and far off: as a group that joins the rest wrongly."""
    count = int(share * len(scene.centres))
    poses = scene.from_camera.copy()
    poses[:count, :, 3] = 8 * poses[:count, :, 3] + [16.0, 0.0, 3.0]
    theirs = scene.view < count
    far = 8 * scene.points[scene.point[theirs]] + [16.0, 0.0, 3.0]
    point = scene.point.copy()
    point[theirs] = len(scene.points) + np.arange(len(far))
    points = np.concatenate([scene.points, far])
    return dataclasses.replace(scene, from_camera=poses, points=points, point=point)


@pytest.mark.parametrize("share", [0.05, 0.1])
def test_a_misplaced_group_leaves_layout_and_region_as_they_are(share: float) -> None:
    scene = rings(292)
    right, wrong = normalise(scene, None), normalise(with_misplaced_group(scene, share), None)
    assert right.capture_type == wrong.capture_type == "object-centric"
    assert region_half(wrong) == pytest.approx(region_half(right), rel=0.05)
    assert angles_deg(wrong.up.direction, right.up.direction) < 1
    middle = right.scene_from_sfm.points(wrong.scene_from_sfm.inverse().points(np.zeros((1, 3))))
    assert np.linalg.norm(middle) < 0.05


def rings(count: int) -> Reconstruction:
    """Three rings of photos around a table."""
    random = np.random.default_rng(0)
    angle, height = np.linspace(0, 6 * np.pi, count, endpoint=False), np.repeat([0.3, 0.8, 1.4], -(-count // 3))[:count]
    centres = np.stack([2 * np.cos(angle), 2 * np.sin(angle), height], axis=1) + random.normal(0, 0.02, (count, 3))
    turns = look_at(centres - random.normal(0, 0.1, (count, 3)), np.zeros(3))[:, :, :3]
    side = np.linspace(-0.4, 0.4, 8)
    x, y = np.meshgrid(side, side)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return Reconstruction(
        from_camera=np.concatenate([turns, centres[:, :, None]], axis=2),
        ray_directions=np.tile(rays / np.linalg.norm(rays, axis=1, keepdims=True), (count, 1, 1)),
        points=random.normal(0, 0.4, (3000, 3)) * [1, 1, 0.3],
        view=np.repeat(np.arange(count), 60),
        point=random.integers(0, 3000, 60 * count),
    )
