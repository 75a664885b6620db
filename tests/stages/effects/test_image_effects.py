"""What field.json says of images."""

import numpy as np
import pytest

from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.effects.image_effects import learnt_poses

POSE = np.concatenate([np.eye(3), [[1.0], [2.0], [3.0]]], axis=1)


def scene() -> Scene:
    one, other = (View(name, f"images/{name}", 0, POSE, 0.1, 9.0, "train") for name in ("a.png", "b.png"))
    views = one, other, View("c.png", "images/c.png", 0, POSE, 0.1, 9.0, "test")
    camera = Camera("PINHOLE", 8, 8, (8.0, 8.0, 4.0, 4.0))
    return Scene((camera,), views, Similarity(1.0, np.eye(3), np.zeros(3)), True, False, "forward-facing", True)


def test_photos_stand_where_the_field_learnt_that_they_do() -> None:
    quarter = [0.0, 0, np.pi / 2, 0.5, 0, 0]
    moved = learnt_poses({"effects": {"exposure": {}, "pose_refinement": {"b.png": quarter}}}, scene())
    assert moved.views[1].scene_from_camera[:, 3] == pytest.approx([1.5, 2, 3])
    assert moved.views[1].scene_from_camera[:, :3] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]))
    for index in (0, 2):
        assert np.array_equal(moved.views[index].scene_from_camera, POSE)


def test_poses_stay_where_none_were_learnt() -> None:
    same = learnt_poses({"effects": {"exposure": {"a.png": [0.0, 0, 0]}}}, scene())
    assert all(np.array_equal(view.scene_from_camera, POSE) for view in same.views)
