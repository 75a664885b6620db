"""A ring of cameras and the matches of their photos."""

from itertools import combinations

import numpy as np
import pytest

from nerf.synthetic.scenes import ring_of_cameras
from stages.sfm.pose_check import PairMatches

PHOTOS, FOCAL_PX = 12, 800.0


@pytest.fixture(scope="module")
def ring() -> tuple[PairMatches, np.ndarray]:
    """A ring of cameras around points that all of them see, and their poses."""
    random, poses = np.random.default_rng(0), ring_of_cameras(PHOTOS)[:, :3]
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
        pair_noise_px=np.full(len(pairs), np.nan),
    )
    return matches, poses
