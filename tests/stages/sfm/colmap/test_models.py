"""A model of cameras that were held in several ways, turned upright."""

import numpy as np
import pycolmap

from stages.sfm.colmap.adjustment.observations import observations, residuals
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.colmap.models import turned_upright
from tests.stages.sfm.colmap.adjustment.lens_scene import HEIGHT, WIDTH, lens, photographed

LENS = lens("OPENCV", 900, 910, 460, 290, 0.02, -0.01, 0.003, -0.002)
TURNS = {"02.jpg": 1, "03.jpg": 2, "04.jpg": 3, "05.jpg": 1}


def errors(model: "pycolmap.Reconstruction") -> np.ndarray:
    """How far each observation is off, in the order of images and points."""
    seen = observations(model)
    return np.linalg.norm(residuals(model, seen), axis=1)


def test_a_model_turned_upright_sees_the_same_points() -> None:
    model = photographed(LENS, photos=6)
    for point_id in model.point3D_ids():
        model.point3D(point_id).color = np.array([point_id % 251, 7, 9], np.uint8)
    upright = turned_upright(model, TURNS)
    assert sorted(camera.width for camera in upright.cameras.values()) == sorted([WIDTH, HEIGHT, WIDTH, HEIGHT])
    assert [upright.image(i).name for i in sorted(upright.reg_image_ids())] == [f"{i:02d}.jpg" for i in range(1, 7)]
    assert upright.image(2).camera_id == upright.image(5).camera_id != upright.image(4).camera_id
    np.testing.assert_allclose(np.sort(errors(upright)), np.sort(errors(model)), atol=1e-6)
    centres = [[m.image(i).projection_center() for i in range(1, 7)] for m in (model, upright)]
    np.testing.assert_allclose(centres[1], centres[0], atol=1e-9)
    colours = [sorted(tuple(m.point3D(i).color) for i in m.point3D_ids()) for m in (model, upright)]
    assert colours[1] == colours[0] and upright.num_points3D() == model.num_points3D()


def test_places_in_a_photo_turn_with_it() -> None:
    model = photographed(LENS, photos=6)
    upright = turned_upright(model, TURNS)
    size = (HEIGHT, WIDTH)
    turn = pixel_map((WIDTH, HEIGHT), 1, *size)
    before = np.array([point.xy for point in model.image(2).points2D])
    after = np.array([point.xy for point in upright.image(2).points2D])
    np.testing.assert_allclose(after, before @ turn[:, :2].T + turn[:, 2], atol=1e-9)
    assert (after < size).all() and (after > 0).all()
