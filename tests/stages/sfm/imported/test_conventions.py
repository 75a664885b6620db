"""Conventions of given poses, told by what verified matches of their photos agree with."""

from itertools import combinations

import numpy as np
import pytest

from nerf.synthetic.scenes import ring_of_cameras
from stages.sfm.geometry_check import PairMatches, check_poses
from stages.sfm.imported.conventions import (
    AXES,
    OF_COLMAP,
    OF_TRANSFORMS,
    PoseConvention,
    _right_handed,
    axes_in_words,
    best_fit,
    found_convention,
    inverse,
    named_axes,
    world_from_camera,
)

PHOTOS, FOCAL_PX = 12, 800.0
DIRECTIONS = ("world-from-camera", "camera-from-world")
TURNS = list(_right_handed())


@pytest.fixture(scope="module")
def ring() -> tuple[PairMatches, np.ndarray]:
    """A ring of cameras around points that all of them see, and their poses."""
    random, poses = np.random.default_rng(0), np.stack(ring_of_cameras(PHOTOS))[:, :3]
    points = random.uniform(-0.3, 0.3, (60, 3))
    rays = np.einsum("pji,pkj->pki", poses[:, :, :3], points[None] - poses[:, None, :, 3])
    rays = rays / rays[..., 2:] + np.pad(random.normal(0, 0.4 / FOCAL_PX, (PHOTOS, 60, 2)), ((0, 0), (0, 0), (0, 1)))
    pairs = np.array([(a, b) for a, b in combinations(range(PHOTOS), 2) if b - a < 4])
    matches = PairMatches(
        pairs=pairs,
        weight=np.full(len(pairs), 60.0),
        pair=np.repeat(np.arange(len(pairs)), 60),
        keypoint=(60 * pairs[:, None] + np.arange(60)[None, :, None]).reshape(-1, 2),
        photo=np.repeat(np.arange(PHOTOS), 60),
        ray_direction=(rays / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3),
        focal_px=np.full(PHOTOS, FOCAL_PX),
    )
    return matches, poses


def as_in_a_file(poses: np.ndarray, direction: str, axes: np.ndarray) -> np.ndarray:
    """Matrices of these poses under a convention; ``axes`` take OpenCV's camera axes to the file's."""
    turned = np.concatenate([poses[..., :3] @ axes.T, poses[..., 3:]], axis=-1)
    return inverse(turned) if direction == "camera-from-world" else turned


@pytest.mark.parametrize("read_as", [OF_TRANSFORMS, OF_COLMAP])
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("axes", TURNS, ids=axes_in_words)
def test_every_convention_is_recognised(ring, direction: str, axes: np.ndarray, read_as: PoseConvention) -> None:
    matches, poses = ring
    given = np.stack([world_from_camera(m, read_as) for m in as_in_a_file(poses, direction, axes)])
    fit = best_fit(matches, given)
    assert fit is not None and fit.agreeing == fit.pairs == len(matches.pairs)
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
    assert best_fit(matches, poses[np.random.default_rng(1).permutation(PHOTOS)]) is None


def test_axes_are_named_by_where_they_point() -> None:
    assert axes_in_words(AXES["opencv"]) == "x right, y down, z forward"
    assert axes_in_words(AXES["opengl"]) == "x right, y up, z back"
    assert len({axes_in_words(axes) for axes in TURNS}) == 24
