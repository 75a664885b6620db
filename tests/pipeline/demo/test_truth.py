import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.synthetic.scenes import ring_of_cameras, still_life
from pipeline.demo.truth import Truth, compare_with_truth, seen
from stages.io.transforms_export import transforms
from tests.refusals import refused

LENS = Camera("OPENCV", 480, 360, (500.0, 502.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0))
SFM_FROM_TRUTH = Similarity(3.7, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -2.0, 9.0]))


def truth_of(count: int) -> Truth:
    return Truth(LENS, {f"{i:02d}.jpg": pose for i, pose in enumerate(ring_of_cameras(count))}, seed=0)


def write_output(folder: Path, poses: dict[str, np.ndarray], camera: Camera = LENS) -> Path:
    """What a run would leave that found ``poses``, given in the truth's frame, in a frame of its own."""
    views = [
        View(name, name, 0, SFM_FROM_TRUTH.pose(pose), near=1.0, far=9.0, split="train") for name, pose in poses.items()
    ]
    own = Similarity(1.0, np.eye(3), np.zeros(3))
    scene = Scene(
        (camera,), tuple(views), own, bounded=True, has_alpha=False, capture_type="object-centric", up_known=True
    )
    (folder / "transforms.json").write_text(json.dumps(transforms(scene)))
    return folder


def test_the_truth_has_no_error(tmp_path: Path):
    truth = truth_of(12)
    found = compare_with_truth(write_output(tmp_path, dict(truth.poses)), truth)
    assert found.rotation_deg.shape == found.position_percent.shape == (12,)
    assert found.rotation_deg.max() < 1e-5
    assert found.position_percent.max() < 1e-9
    assert found.focal_percent == pytest.approx(0, abs=1e-12)
    assert found.mesh is None
    assert found.holds()
    assert found.lines()[0].startswith("cameras    12/12 registered · rotation off by 0.000°, at worst 0.000° · ")
    assert found.lines()[1] == "promise    every camera within 0.5° and 1%: kept"


def test_a_turned_camera_and_a_wrong_focal_length_are_measured(tmp_path: Path):
    truth = truth_of(12)
    turn = Rotation.from_rotvec(np.radians([0.0, 2.0, 0.0])).as_matrix()
    poses = dict(truth.poses)
    poses["04.jpg"] = np.concatenate([poses["04.jpg"][:, :3] @ turn, poses["04.jpg"][:, 3:]], axis=1)
    longer = Camera("SIMPLE_PINHOLE", 480, 360, (501.0 * 1.03, 240.0, 180.0))
    found = compare_with_truth(write_output(tmp_path, poses, longer), truth)
    assert found.rotation_deg[4] == pytest.approx(2.0, abs=1e-6)
    assert np.delete(found.rotation_deg, 4).max() < 1e-5
    assert found.focal_percent == pytest.approx(3.0)
    assert not found.holds()
    assert "NOT kept" in found.lines()[1]


def test_a_displaced_camera_is_measured_in_percent_of_the_table(tmp_path: Path):
    truth = truth_of(40)
    poses = dict(truth.poses)
    poses["07.jpg"] = poses["07.jpg"] + np.array([[0, 0, 0, 0.06], [0, 0, 0, 0], [0, 0, 0, 0]])
    found = compare_with_truth(write_output(tmp_path, poses), truth)
    assert 2.7 < found.position_percent[7] < 3.0, "3 % of the diameter, of which the alignment takes up a little"
    assert 0 < np.delete(found.position_percent, 7).max() < 0.3


def test_a_missing_camera_breaks_the_promise(tmp_path: Path):
    truth = truth_of(12)
    poses = {name: pose for name, pose in truth.poses.items() if name != "03.jpg"}
    found = compare_with_truth(write_output(tmp_path, poses), truth)
    assert len(found.rotation_deg) == 11
    assert not found.holds()


def write_mesh(folder: Path, level: float) -> None:
    """The surface where the true signed distance is ``level``, in the frame of the run."""
    axes = [torch.arange(low, high, 0.04) for low, high in ((-1.2, 1.2), (-1.2, 1.2), (-0.3, 1.2))]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    distance = still_life().distance(grid.reshape(-1, 3)).reshape(grid.shape[:-1])
    vertices, faces, *_ = marching_cubes(distance.numpy(), level, spacing=(0.04,) * 3)
    vertices = SFM_FROM_TRUTH.points(vertices + grid[0, 0, 0].numpy())
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "mesh.ply")


def test_mesh_distance_is_in_percent_of_the_table(tmp_path: Path):
    truth = truth_of(12)
    write_output(tmp_path, dict(truth.poses))
    write_mesh(tmp_path, 0.0)
    exact = compare_with_truth(tmp_path, truth).mesh
    write_mesh(tmp_path, 0.06)
    thick = compare_with_truth(tmp_path, truth).mesh
    assert exact and thick
    assert 0 < exact.accuracy < 0.1
    assert 0.1 < exact.completeness < 0.4, "no less than the spacing of the samples allows"
    assert 2.9 < thick.accuracy < 3.1, "0.06 of a diameter of 2 is 3 %"
    assert 2.5 < thick.completeness < 3.6
    assert thick.chamfer == pytest.approx((thick.accuracy + thick.completeness) / 2)


def test_only_unoccluded_faces_are_seen():
    scene = still_life()
    points, normals = scene.surface_points(4000, seed=0)
    above = torch.tensor([[0.0, 0.0, 4.0]])
    visible = seen(scene, points, normals, above)
    top = (points[:, 2].abs() < 1e-5) & (points[:, :2].norm(dim=-1) < 0.95)
    assert 0.7 < visible[top].float().mean() < 1, "the table's top, but for what stands on it"
    under = normals[:, 2] < -0.999
    assert under.sum() > 1000, "the table's underside"
    assert not visible[under].any()
    below = torch.tensor([[0.0, 0.0, -4.0]])
    assert seen(scene, points, normals, below)[under].all()
    both = seen(scene, points, normals, torch.cat([above, below]))
    assert torch.equal(both, visible | seen(scene, points, normals, below))


def test_truth_survives_writing_and_a_broken_file_is_named(tmp_path: Path):
    truth = truth_of(3)
    truth.write(tmp_path / "truth.json")
    again = Truth.read(tmp_path / "truth.json")
    assert again.to_json() == truth.to_json()
    assert again.camera == LENS
    (tmp_path / "truth.json").write_text("{")
    with refused("io.damaged-json", "truth.json"):
        Truth.read(tmp_path / "truth.json")
