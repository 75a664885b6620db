import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.scene import Camera, Scene, Similarity, View


def turned(angle: float, scale: float, translation: list[float]) -> Similarity:
    """A turn about (1, 2, 2)/3 by ``angle`` (Rodrigues), with scale and translation."""
    x, y, z = 1 / 3, 2 / 3, 2 / 3
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return Similarity(scale, rotation, np.array(translation, float))


SIMILARITIES = st.builds(
    turned, st.floats(-4, 4), st.floats(1e-3, 1e3), st.lists(st.floats(-100, 100), min_size=3, max_size=3)
)
POINTS = np.random.default_rng(0).normal(size=(7, 3))


@given(SIMILARITIES)
def test_the_inverse_undoes_it(similarity: Similarity) -> None:
    np.testing.assert_allclose(similarity.inverse().points(similarity.points(POINTS)), POINTS, atol=1e-9)


@given(SIMILARITIES)
def test_distances_scale_alike(similarity: Similarity) -> None:
    moved = similarity.points(POINTS)
    ratios = np.linalg.norm(moved[1:] - moved[0], axis=-1) / np.linalg.norm(POINTS[1:] - POINTS[0], axis=-1)
    np.testing.assert_allclose(ratios, similarity.scale, rtol=1e-6)


@given(SIMILARITIES)
def test_its_matrix_does_the_same(similarity: Similarity) -> None:
    homogeneous = np.concatenate([POINTS, np.ones((7, 1))], axis=1)
    np.testing.assert_allclose((homogeneous @ similarity.matrix().T)[:, :3], similarity.points(POINTS), atol=1e-9)


@given(SIMILARITIES, SIMILARITIES)
def test_a_pose_stays_rigid_and_sees_the_same_directions(similarity: Similarity, pose: Similarity) -> None:
    """The point one unit ahead of the camera stays on its optical axis, at the scale's distance."""
    moved = similarity.pose(pose.matrix()[:3] / np.array([pose.scale] * 3 + [1.0]))
    np.testing.assert_allclose(moved[:, :3] @ moved[:, :3].T, np.eye(3), atol=1e-12)
    ahead = similarity.points(pose.translation + pose.rotation[:, 2])
    np.testing.assert_allclose(moved[:, 3] + similarity.scale * moved[:, 2], ahead, atol=1e-9)


def scene() -> Scene:
    first, second = turned(0.3, 1.0, [0.1, 1 / 3, 2]), turned(-0.3, 1.0, [0, 0, 1])
    return Scene(
        cameras=(Camera("OPENCV", 640, 480, (500.5, 501.5, 320.0, 240.0, 0.1, -0.01, 1e-4, 0.0)),),
        views=(
            View("Straße 1.jpg", "images/0000.jpg", 0, first.matrix()[:3], 0.5, 7.0, "test"),
            View("b.jpg", "images/0001.jpg", 0, second.matrix()[:3], 0.25, 9.125, "train"),
        ),
        scene_from_sfm=turned(1.0, 0.3, [1, 2, 3]),
        bounded=False,
        has_alpha=True,
        capture_type="inside-out",
        up_known=True,
        backdrop=(1.0, 1 / 3, 0.0),
    )


def test_json_gives_back_every_bit() -> None:
    text = json.dumps(scene().to_json())
    again = Scene.from_json(json.loads(text))
    assert json.dumps(again.to_json()) == text
    assert again.cameras == scene().cameras
    assert np.array_equal(again.views[0].scene_from_camera, scene().views[0].scene_from_camera)
    assert np.array_equal(again.scene_from_sfm.rotation, scene().scene_from_sfm.rotation)
    assert (again.bounded, again.has_alpha, again.capture_type, again.up_known) == (False, True, "inside-out", True)
    assert again.backdrop == scene().backdrop
    assert Scene.from_json(json.loads(text) | {"backdrop": None}).backdrop is None


def test_another_version_is_refused() -> None:
    with pytest.raises(ValueError, match=r"scene.json has version 5, this program reads version 4"):
        Scene.from_json(scene().to_json() | {"version": 5})


def test_views_of_a_split() -> None:
    assert [view.name for view in scene().of_split("train")] == ["b.jpg"]
    assert [view.name for view in scene().of_split("test")] == ["Straße 1.jpg"]
