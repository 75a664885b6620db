"""Pieces of a walk, made from true poses and tracks: joined where they agree about the photos that they share."""

from collections.abc import Iterable

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from nerf.geometry.alignment import fit_poses
from nerf.geometry.scene import Similarity
from stages.sfm.colmap.joining import MIN_SHARED, Piece, join, join_pieces
from stages.sfm.colmap.model_comparison import compare_models

PHOTOS, FOCAL_PX, NOISE_PX = 24, 400.0, 0.3
STEP, DOOR = 0.2, 1.5  # between photos, along a wall that is 1.3 to 1.8 away; between doors that look alike


@pytest.fixture(scope="module")
def walk() -> pycolmap.Reconstruction:
    return walk_along(1.3)


def walk_along(wall: float) -> pycolmap.Reconstruction:
    """Photos 1 to 24 along a line, that turn from side to side; true poses, noise in what they see."""
    random, model = np.random.default_rng(0), pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=480, height=360, params=[FOCAL_PX, 240, 180, 0])
    )
    size = wall / 1.3
    xyz = random.uniform((-size, -0.8 * size, wall), (STEP * PHOTOS + size, 0.8 * size, wall + 0.5), (1500, 3))
    tracks = [pycolmap.Track() for _ in xyz]
    for image_id in range(1, PHOTOS + 1):
        turn = Rotation.from_euler("yx", [12 * np.sin(image_id), 3 * np.cos(image_id)], degrees=True).as_matrix()
        centre = np.array([STEP * image_id, 0.04 * np.sin(2 * image_id), 0.04 * np.cos(3 * image_id)])
        pose = np.concatenate([turn, -(turn @ centre)[:, None]], axis=1)
        there = xyz @ pose[:, :3].T + pose[:, 3]
        xy = FOCAL_PX * there[:, :2] / there[:, 2:] + (240, 180)
        seen = np.flatnonzero((there[:, 2] > 0) & ((xy > 0) & (xy < (480, 360))).all(axis=1))
        xy = xy[seen] + random.normal(0, NOISE_PX, (len(seen), 2))
        for keypoint, point in enumerate(seen.tolist()):
            tracks[point].add_element(image_id, keypoint)
        places = pycolmap.Point2DList([pycolmap.Point2D(one) for one in xy])
        image = pycolmap.Image(name=f"{image_id:02}.jpg", camera_id=1, image_id=image_id, points2D=places)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for point, track in zip(xyz, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    model.update_point_3d_errors()
    return model


def piece(walk: pycolmap.Reconstruction, images: Iterable[int], seed: int = 0) -> pycolmap.Reconstruction:
    """Only some photos, in a frame and scale of their own, each pose off by a little and points by as much."""
    random, model = np.random.default_rng(seed), pycolmap.Reconstruction(walk)
    for image_id in set(walk.reg_image_ids()).difference(images):
        model.deregister_frame(image_id)
    for image_id in model.reg_image_ids():
        move(model, [image_id], random.normal(0, 0.0002, 3), random.normal(0, 0.0003, 3))
    turn = pycolmap.Rotation3d(random.uniform(-2, 2, 3))
    model.transform(pycolmap.Sim3d(random.uniform(0.2, 5), turn, random.uniform(-9, 9, 3)))
    return model


def move(model: pycolmap.Reconstruction, images: Iterable[int], turn: np.ndarray, shift: np.ndarray) -> None:
    """Move photos in the model's frame, turned about the first of them, with the points that they alone see."""
    images = list(images)
    middle = model.image(images[0]).projection_center()
    rotation = pycolmap.Rotation3d(turn)
    moved = pycolmap.Rigid3d(rotation, middle + shift - rotation.matrix() @ middle)
    for image_id in images:
        frame = model.frame(model.image(image_id).frame_id)
        frame.rig_from_world = model.image(image_id).cam_from_world() * moved.inverse()
    for point in model.points3D.values():
        if {element.image_id for element in point.track.elements} <= set(images):
            point.xyz = moved * point.xyz


def pieces_of(*models: pycolmap.Reconstruction) -> list[Piece]:
    return [Piece(model, sorted(model.reg_image_ids())) for model in models]


def test_pieces_that_share_photos_become_one(walk: pycolmap.Reconstruction) -> None:
    pieces = piece(walk, range(1, 11), 1), piece(walk, range(8, 19), 2), piece(walk, range(16, 25), 3)
    joined = join_pieces(pieces_of(*pieces), camera_is_known=False)
    assert joined is not None and joined.num_reg_images() == PHOTOS
    compared = compare_models(walk, joined)
    assert compared["agree"] == PHOTOS and compared["centre"] < 0.002 and compared["degrees"] < 0.2
    assert joined.compute_mean_reprojection_error() < 1.5 * NOISE_PX
    assert abs(joined.camera(1).mean_focal_length() / FOCAL_PX - 1) < 0.02
    assert joined.num_points3D() > 0.95 * walk.num_points3D(), "those that two pieces have are one"
    assert joined.compute_num_observations() > 0.95 * walk.compute_num_observations()
    assert [model.num_reg_images() for model in pieces] == [10, 11, 9], "the pieces stay as they were"


def test_only_what_hangs_together_is_joined(walk: pycolmap.Reconstruction) -> None:
    model = piece(walk, range(10, 25))
    move(model, range(20, 25), np.radians([0.0, 20.0, 0.0]), np.zeros(3))
    joined = join_pieces(
        [Piece(piece(walk, range(1, 15)), range(1, 15)), Piece(model, range(10, 20))], camera_is_known=False
    )
    assert joined is not None and sorted(joined.reg_image_ids()) == [*range(1, 20)]


def test_known_cameras_stay(walk: pycolmap.Reconstruction) -> None:
    pieces = pieces_of(piece(walk, range(1, 15)), piece(walk, range(10, 25)))
    joined = join_pieces(pieces, camera_is_known=True)
    assert joined is not None and list(joined.camera(1).params) == list(walk.camera(1).params)


def test_images_that_a_model_lacks_bring_their_cameras(walk: pycolmap.Reconstruction) -> None:
    base, other = piece(walk, range(1, 15)), piece(walk, range(10, 25))
    base.tear_down()  # as COLMAP leaves it: what is not registered is not there
    assert base.num_images() == 14
    joined = join(base, other)
    assert joined is not None and joined.num_reg_images() == joined.num_images() == PHOTOS
    assert [joined.image(i).name for i in (1, 24)] == ["01.jpg", "24.jpg"]


@pytest.mark.parametrize("shared", [0, 1, 2, 3])
def test_fewer_than_three_photos_join_nothing(walk: pycolmap.Reconstruction, shared: int) -> None:
    pieces = piece(walk, range(1, 13), 1), piece(walk, range(13 - shared, 25), 2)
    assert (join(*pieces) is not None) == (shared >= MIN_SHARED)


def test_a_piece_with_nothing_to_add_is_left(walk: pycolmap.Reconstruction) -> None:
    assert join_pieces(pieces_of(piece(walk, range(1, 13)), piece(walk, range(5, 12))), camera_is_known=False) is None
    assert join_pieces(pieces_of(piece(walk, range(1, 4))), camera_is_known=False) is None


@pytest.mark.parametrize(
    ("moved", "turn_deg", "steps"),
    [
        (range(12, 25), 0.0, (DOOR / STEP, 0, 0)),  # it went on a door farther
        (range(12, 25), 180.0, (0, 0, 2 * 1.5 / STEP)),  # at the other of two façades
        (range(12, 25), 3.0, (0, 0, 0)),  # it took the wrong of two poses of a plane
        (range(14, 25), 3.0, (0, 0, 0)),  # and that only at the last photo that both have
        (range(12, 25), 0.0, (0.2, 0, 0)),  # its scale changed on the way
        (range(12, 14), 0.0, (0, 0.1, 0)),
    ],
)  # fmt: skip
def test_pieces_that_disagree_about_a_photo_are_not_joined(
    walk: pycolmap.Reconstruction, moved: range, turn_deg: float, steps: tuple[float, float, float]
) -> None:
    base, other = piece(walk, range(1, 15), 1), pycolmap.Reconstruction(walk)
    move(other, moved, np.radians([0.0, turn_deg, 0.0]), STEP * np.array(steps))
    other = piece(other, range(10, 25), 2)
    assert join(base, other) is None and join(other, base) is None


def test_photos_of_what_is_far_away_join_nothing() -> None:
    far = walk_along(40.0)
    assert join(piece(far, range(1, 15), 1), piece(far, range(12, 25), 2)) is None
    assert join(piece(far, range(1, 21), 1), piece(far, range(5, 25), 2)) is None


def test_poses_on_a_line_tell_a_similarity() -> None:
    random = np.random.default_rng(0)
    turns = Rotation.random(4, random).as_matrix()
    poses = np.concatenate([turns, np.outer(np.arange(4.0), [1, 2, 3])[:, :, None]], axis=2)
    other = Similarity(2.5, Rotation.from_rotvec([0.3, -2, 1]).as_matrix(), np.array([5.0, -4, 3]))
    found = fit_poses(np.array([other.pose(pose) for pose in poses]), poses)
    assert found is not None
    np.testing.assert_allclose(found.matrix(), other.matrix(), atol=1e-12)


def test_photos_in_one_position_tell_no_scale() -> None:
    poses = np.concatenate([Rotation.random(4, np.random.default_rng(0)).as_matrix(), np.ones((4, 3, 1))], axis=2)
    assert fit_poses(poses, poses) is None
