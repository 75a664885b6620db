"""Conventions of given poses, told by what verified matches of their photos agree with."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.sfm.imported.conventions import (
    AXES,
    LEFT_HANDED,
    OF_COLMAP,
    OF_TRANSFORMS,
    RIGHT_HANDED,
    PoseConvention,
    axes_in_words,
    best_fit,
    columns_for,
    fit_of_some,
    found_convention,
    inverse,
    named_axes,
    world_from_camera,
)
from stages.sfm.pose_check import PairMatches, check_poses
from tests.stages.sfm.imported.conftest import PHOTOS

DIRECTIONS = ("world-from-camera", "camera-from-world")


def as_in_a_file(poses: np.ndarray, direction: str, axes: np.ndarray) -> np.ndarray:
    """Matrices of these poses under a convention; ``axes`` take OpenCV's camera axes to the file's."""
    turned = np.concatenate([poses[..., :3] @ axes.T, poses[..., 3:]], axis=-1)
    return inverse(turned) if direction == "camera-from-world" else turned


def agrees(matches: PairMatches, poses: np.ndarray) -> np.ndarray:
    return check_poses(matches, poses).agrees


@pytest.mark.parametrize("read_as", [OF_TRANSFORMS, OF_COLMAP])
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("axes", RIGHT_HANDED + LEFT_HANDED, ids=axes_in_words)
def test_every_convention_is_recognised(ring, direction: str, axes: np.ndarray, read_as: PoseConvention) -> None:
    """Cameras with left-handed axes are proper rotations in a left-handed world alone: Unity's, Unreal's."""
    matches, poses = ring
    world = poses.copy()
    if np.linalg.det(axes) < 0:
        world[:, 1] *= -1
    given = np.stack([world_from_camera(m, read_as) for m in as_in_a_file(world, direction, axes)])
    assert np.linalg.det(given[:, :, :3]) == pytest.approx(1)
    fit = best_fit(matches, given)
    assert fit is not None and fit.agreeing == fit.pairs == len(matches.pairs)
    assert fit.mirrored == (np.linalg.det(axes) < 0) and not fit.scalar_last and not fit.of
    found = found_convention(fit, read_as)
    assert found[0] == direction
    np.testing.assert_array_equal(found[1], axes)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("axes", AXES)
def test_poses_that_are_read_as_they_are_meant_fit(ring, direction: str, axes: str) -> None:
    matches, poses = ring
    convention = PoseConvention(direction, axes)
    given = np.stack([world_from_camera(m, convention) for m in as_in_a_file(poses, direction, AXES[axes])])
    np.testing.assert_allclose(given, poses, atol=1e-12)
    assert check_poses(matches, given).passed.all()
    assert named_axes(AXES[axes]) == axes


def test_poses_of_another_scene_fit_under_no_convention(ring) -> None:
    matches, poses = ring
    others = poses[np.random.default_rng(1).permutation(PHOTOS)]
    assert best_fit(matches, others, of_quaternions=True) is None


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_quaternions_that_end_in_w_are_recognised(ring, direction: str) -> None:
    matches, poses = ring
    of_file = poses if direction == "world-from-camera" else inverse(poses)
    meant = Rotation.from_matrix(of_file[:, :, :3]).as_quat()
    read = Rotation.from_quat(meant, scalar_first=True).as_matrix()
    given = inverse(np.concatenate([read, of_file[:, :, 3:]], axis=2))
    assert best_fit(matches, given) is None
    fit = best_fit(matches, given, of_quaternions=True)
    assert fit is not None and fit.scalar_last and fit.agreeing == fit.pairs == len(matches.pairs)
    assert found_convention(fit, OF_COLMAP) == (direction, pytest.approx(np.eye(3)))


@pytest.mark.parametrize("of", [[3], [2, 5, 6, 9]])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_some_poses_of_another_convention_are_named(ring, of: list[int], direction: str) -> None:
    matches, poses = ring
    given = poses.copy()
    given[of] = as_in_a_file(poses[of], direction, AXES["opengl"])
    fit = fit_of_some(matches, given, agrees(matches, given))
    assert fit is not None and list(fit.of) == of and fit.agreeing == fit.pairs < len(matches.pairs)
    found = found_convention(fit, PoseConvention("world-from-camera", "opencv"))
    assert found[0] == direction and named_axes(found[1]) == "opengl"


def test_a_pose_that_fits_nowhere_is_of_no_convention(ring) -> None:
    matches, poses = ring
    given = poses.copy()
    given[4, :, 3] += 2.0
    assert fit_of_some(matches, given, agrees(matches, given)) is None


@pytest.mark.parametrize("axes", RIGHT_HANDED + LEFT_HANDED, ids=axes_in_words)
@pytest.mark.parametrize("wanted", AXES)
def test_columns_convert_axes(ring, axes: np.ndarray, wanted: str) -> None:
    """And of a left-handed world the negated third row."""
    _, poses = ring
    third_row = np.diag([1, 1, np.linalg.det(axes)])
    given = as_in_a_file(third_row @ poses, "world-from-camera", axes)
    columns = [int(column) for column in columns_for(AXES[wanted], axes).split(", ")]
    taken = third_row @ np.stack([np.sign(c) * given[:, :, abs(c) - 1] for c in columns] + [given[:, :, 3]], axis=2)
    np.testing.assert_allclose(taken, as_in_a_file(poses, "world-from-camera", AXES[wanted]), atol=1e-15)


def test_axes_are_named_by_where_they_point() -> None:
    assert axes_in_words(AXES["opencv"]) == "x right, y down, z forward"
    assert axes_in_words(AXES["opengl"]) == "x right, y up, z back"
    assert len({axes_in_words(axes) for axes in RIGHT_HANDED + LEFT_HANDED}) == 48
