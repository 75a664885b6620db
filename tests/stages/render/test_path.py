"""Paths for photos that were taken from near and far, with lenses to match, or that were held sideways."""

from dataclasses import replace

import numpy as np

from stages.render.path import default_path, make_path, median_camera
from tests.camera_layouts import ring, wall
from tests.refusals import refused
from tests.stages.render.test_render import CAMERA, scene_with


def test_a_near_far_path_follows_poses_and_lenses() -> None:
    test, near, far = ring(1), ring(3, radius=1.5, arc_deg=40.0), ring(4, radius=7.5, arc_deg=20.0)
    scene = scene_with(np.concatenate([test, near, far]))
    lenses = CAMERA, replace(CAMERA, params=(600.0, 600.0, *CAMERA.params[2:]))
    views = tuple(
        replace(view, camera=int(index > 3), near=2.0 if index > 3 else 0.6) for index, view in enumerate(scene.views)
    )
    scene = replace(scene, cameras=lenses, views=views)
    assert default_path(scene) == "interpolated" and default_path(scene_with(ring(24))) == "orbit"
    path = make_path(scene, "interpolated", 24)
    focals = np.array([camera.params[0] for camera in path.cameras])
    away = np.linalg.norm(path.poses[:, :, 3], axis=1)
    assert focals[away.argmin()] < 220 and focals[away.argmax()] > 450
    assert {(camera.width, camera.height, camera.params[2:]) for camera in path.cameras} == {(160, 120, (80.0, 60.0))}


def test_photos_of_one_focal_length_share_their_median() -> None:
    scene = scene_with(ring(7))
    cameras = tuple(replace(CAMERA, params=(f, f, *CAMERA.params[2:])) for f in (145.0, 150.0, 155.0))
    views = tuple(replace(view, camera=index % 3) for index, view in enumerate(scene.views))
    scene = replace(scene, cameras=cameras, views=views)
    assert set(make_path(scene, "orbit", 9).cameras) == {median_camera(scene)}


def test_a_few_photos_held_sideways_do_not_tilt_a_spiral() -> None:
    poses = wall()
    poses[:5, :, :2] = np.stack([poses[:5, :, 1], -poses[:5, :, 0]], axis=2)
    scene = scene_with(poses, "forward-facing")
    assert default_path(scene) == "spiral"
    path = make_path(scene, "spiral", 30).poses
    assert (np.abs(path[:, 2, 0]) < 1e-9).all() and (path[:, 2, 1] < -0.9).all()


def test_photos_from_one_place_have_no_orbit_but_a_path() -> None:
    poses = ring(6)
    poses[:, :, 3] = 0.25
    with refused("render.no-orbit"):
        make_path(scene_with(poses), "orbit", 9)
    assert np.isfinite(make_path(scene_with(poses), "interpolated", 9).poses).all()
