from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stages.contract import Note
from stages.sfm.colmap.adjustment import uncertainty
from stages.sfm.colmap.adjustment.camera_model_selection import CameraModels
from stages.sfm.colmap.adjustment.final_bundle_adjustment import _finished
from stages.sfm.colmap.adjustment.observations import MIN_NOISE_PX, noise_px, observations
from stages.sfm.colmap.adjustment.uncertainty import _error_px, pose_uncertainty_px
from tests.stages.sfm.colmap.adjustment.lens_scene import adjust, lens, photographed

CAMERA = lens("SIMPLE_RADIAL", 800, 450, 300, -0.1)
PHOTOS, POINTS = 6, 80


def moved_px(found, truth) -> np.ndarray:
    """By image: mean squared pixels by which true points move as poses are the found ones, in the best frame."""
    seen = observations(truth)
    points = np.array([truth.point3D(i).xyz for i in seen.point])
    camera = truth.camera(1)

    def shifts(change: np.ndarray) -> np.ndarray:
        world = np.exp(change[6]) * (Rotation.from_rotvec(change[:3]).apply(points) + change[3:6])
        out = np.empty_like(seen.xy)
        for i in np.unique(seen.image).tolist():
            mine = seen.of_image(i)
            ours, true = (model.image(i).cam_from_world().matrix() for model in (found, truth))
            out[mine] = camera.img_from_cam(world[mine] @ ours[:, :3].T + ours[:, 3])
            out[mine] -= camera.img_from_cam(points[mine] @ true[:, :3].T + true[:, 3])
        return out

    best = least_squares(lambda change: shifts(change).ravel(), np.zeros(7)).x
    square = (shifts(best) ** 2).sum(axis=1)
    return np.array([square[seen.of_image(i)].mean() for i in np.unique(seen.image).tolist()])


def test_it_is_how_far_poses_spread_over_repeated_noise() -> None:
    truth = photographed(CAMERA, photos=PHOTOS, points=POINTS, noise=0)
    spread, foretold = [], []
    for seed in range(25):
        random = np.random.default_rng(seed)
        model = photographed(CAMERA, photos=PHOTOS, points=POINTS, noise=0)
        for image_id in model.reg_image_ids():
            for keypoint in model.image(image_id).points2D:
                keypoint.xy = keypoint.xy + random.normal(0, 0.5, 2)
        adjust(model, intrinsics=False)
        spread.append(moved_px(model, truth))
        foretold.append(list(pose_uncertainty_px(model, 0.5).values()))
    ratio = np.mean(foretold, axis=0) / np.sqrt(np.mean(spread, axis=0))
    assert (ratio > 0.7).all()
    assert (ratio < 1.3).all()
    assert 0.8 < ratio.mean() < 1.1  # a robust adjustment of so few points leaves residuals that look too good
    assert 0.05 < np.mean(foretold) < 0.5


def test_it_does_not_depend_on_where_the_world_is() -> None:
    model = photographed(CAMERA, photos=PHOTOS, points=POINTS)
    here = pose_uncertainty_px(model, 0.5)
    rotation = pycolmap.Rotation3d(Rotation.from_rotvec([0.5, -1.0, 2.0]).as_quat())
    model.transform(pycolmap.Sim3d(7.0, rotation, np.array([3.0, -2.0, 11.0])))
    there = pose_uncertainty_px(model, 0.5)
    assert list(here) == list(range(1, PHOTOS + 1))
    assert there == pytest.approx(here, rel=1e-5)


def test_more_points_tell_poses_better() -> None:
    few, many = (photographed(CAMERA, photos=PHOTOS, points=n, seed=1) for n in (60, 240))
    ratio = np.mean(list(pose_uncertainty_px(few, 0.5).values())) / np.mean(
        list(pose_uncertainty_px(many, 0.5).values())
    )
    assert 1.5 < ratio < 2.6  # about the root of four times as many


def test_a_photo_that_sees_next_to_nothing_has_none() -> None:
    model = photographed(CAMERA, photos=PHOTOS, points=POINTS)
    while model.image(3).num_points3D > 5:
        keypoint = next(k for k, point in enumerate(model.image(3).points2D) if point.has_point3D())
        model.delete_observation(3, keypoint)
    assert sorted(pose_uncertainty_px(model, 0.5)) == [1, 2, 4, 5, 6]


def test_mismatches_count_by_their_pull() -> None:
    random = np.random.default_rng(0)
    residual = random.normal(0, 0.5, (200_000, 2))
    gaussian = _error_px(residual, 0.5, 0, 0)
    assert gaussian == pytest.approx(0.5 / 0.929**0.5, rel=0.01)  # soft-L1 at one sigma is 93 % efficient
    residual[::20] *= 100
    assert gaussian < _error_px(residual, 0.5, 0, 0) < 1.2 * gaussian


@pytest.mark.parametrize("how", ["foreseen", "met"])
def test_lack_of_room_is_told_and_the_model_stands(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = photographed(CAMERA, photos=PHOTOS, points=POINTS)
    room = 6 * (6 * PHOTOS) ** 2 * 8
    monkeypatch.setattr(uncertainty, "available_bytes", lambda: room)
    assert len(pose_uncertainty_px(model, 0.5)) == PHOTOS
    if how == "foreseen":
        monkeypatch.setattr(uncertainty, "available_bytes", lambda: room - 1)
        words = "0 MB are free"
    else:
        monkeypatch.setattr(uncertainty, "_whitened_covariance", Mock(side_effect=MemoryError()))
        words = "memory ran out"
    finished = _finished(model, CameraModels(0.5, notes=[Note("sfm.camera-kept", "")]), {})
    assert finished.model is model and finished.uncertainty_px == {}
    assert finished.notes[1].code == "sfm.uncertainty-memory" and words in finished.notes[1].text


def test_where_nothing_was_seen_nothing_is_known() -> None:
    model = photographed(CAMERA, photos=PHOTOS, points=POINTS)
    for point_id in list(model.point3D_ids()):
        model.delete_point3D(point_id)
    assert pose_uncertainty_px(model, 0.5) == {}
    assert noise_px(model, observations(model)) == MIN_NOISE_PX
