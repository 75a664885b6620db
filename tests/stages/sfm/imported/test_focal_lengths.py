"""Wrong focal lengths of given cameras, told by what verified matches of their photos fit."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.cli.commands import run_command
from stages.sfm.imported.focal_lengths import fitting_focal_factor
from stages.sfm.pose_check import PairMatches
from tests.synthetic_photos import LENS, SyntheticPhotos


def as_given(matches: PairMatches, factor: float) -> PairMatches:
    """The matches as cameras see them whose focal lengths are so many times the true ones."""
    rays = matches.ray_direction * [1, 1, factor]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return matches._replace(ray_direction=rays, focal_px=factor * matches.focal_px)


@pytest.mark.parametrize("factor", [0.45, 0.7, 0.9, 1.1, 1.5, 2.2])
def test_the_factor_of_wrong_focal_lengths_is_found(ring, factor: float) -> None:
    matches, poses = ring
    fit = fitting_focal_factor(as_given(matches, factor), poses)
    assert fit is not None and fit.factor * factor == pytest.approx(1, abs=0.01)
    assert fit.error_px < 1


def test_right_focal_lengths_are_left_alone(ring) -> None:
    matches, poses = ring
    assert fitting_focal_factor(matches, poses) is None
    assert fitting_focal_factor(as_given(matches, 1.01), poses) is None


def test_inexact_poses_are_not_taken_for_focal_lengths(ring) -> None:
    matches, poses = ring
    off = poses.copy()
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.01, (len(poses), 3))).as_matrix()
    off[:, :, :3] = off[:, :, :3] @ turns
    assert fitting_focal_factor(matches, off) is None


def test_a_run_tells_the_right_focal_length(synthetic_photos: SyntheticPhotos, tmp_path: Path, capsys) -> None:
    fx, fy, cx, cy, k1, k2, p1, p2 = LENS.params
    content: dict[str, Any] = {
        "fl_x": 0.8 * fx,
        "fl_y": 0.8 * fy,
        "cx": cx,
        "cy": cy,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
    }
    to_opengl = np.diag([1.0, -1, -1, 1])
    poses = synthetic_photos.truth.poses
    content["frames"] = [
        {"file_path": name, "transform_matrix": (np.vstack([pose[:3], [0, 0, 0, 1]]) @ to_opengl).tolist()}
        for name, pose in poses.items()
    ]
    (tmp_path / "given.json").write_text(json.dumps(content))
    words = ["run", str(synthetic_photos.folder), "--cameras", str(tmp_path / "given.json"), "--until", "sfm"]
    assert run_command([*words, "-o", str(tmp_path / "w.nerf")]) != 0
    told = re.search(r"to about (\d+) px", capsys.readouterr().err)
    assert told and float(told[1]) == pytest.approx(fx, rel=0.02)
