"""What the lengths of viewer.html are compared with."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.viewer_page import true_points
from nerf.geometry.scene import Camera, Similarity
from nerf.synthetic.scenes import ring_of_cameras
from pipeline.demo.truth import Truth

SCALE = 0.4
ASIDE = 0.003  # radians by which a principal point that is off turns every camera


def test_known_points_lie_on_the_rays_of_the_page() -> None:
    """Also where every camera is turned a little, as a principal point that is off turns them."""
    poses = {str(number): pose for number, pose in enumerate(ring_of_cameras(6))}
    truth = Truth(Camera("PINHOLE", 4, 3, (4.0, 4.0, 2.0, 1.5)), poses, seed=0)
    scene_from_truth = Similarity(SCALE, ring_of_cameras(1, seed=1)[0, :, :3], np.array([0.1, 0.2, 0.3]))
    turn = np.array([[np.cos(ASIDE), 0, np.sin(ASIDE)], [0, 1, 0], [-np.sin(ASIDE), 0, np.cos(ASIDE)]])
    seen = {name: scene_from_truth.pose(pose) for name, pose in poses.items()}
    views: Any = [
        SimpleNamespace(name=name, scene_from_camera=np.c_[pose[:, :3] @ turn, pose[:, 3]])
        for name, pose in seen.items()
    ]
    directions = np.array([[0.0, 0.0, 1.0], [0.06, 0.08, np.sqrt(0.99)]])
    scene: Any = SimpleNamespace(views=views)
    known, scale = true_points(truth, scene, views[0], directions)
    away = scene_from_truth.points(known) - views[0].scene_from_camera[:, 3]
    shown = away @ views[0].scene_from_camera[:, :3]
    np.testing.assert_allclose(shown / np.linalg.norm(shown, axis=1, keepdims=True), directions, atol=1e-5)
    np.testing.assert_allclose(scale, 1 / SCALE, rtol=1e-6)
