"""The figures of meshes notice what they are meant to notice."""

import numpy as np
import pytest

from benchmarks.mesh_scenes import Plane, Points, SyntheticPhotos
from benchmarks.mesh_truth import compared
from stages.mesh.surface import Surface

SIZE = 2.0


def sheet(height=0.0, waves=0.0, cells=60):
    """A square of side 2 at z = ``height``, with waves of that amplitude."""
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x, y, height + waves * np.sin(20 * x) * np.cos(20 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    a, b, c, d = corner, corner + cells + 1, corner + cells + 2, corner + 1
    return Surface(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


@pytest.fixture(scope="module")
def scene():
    position = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)) * [1, 1, 0]
    points = Points(position, np.tile([0.0, 0, 1], (len(position), 1)))
    everywhere, nowhere = (lambda value: lambda each: np.full(len(each), value))(True), lambda each: each[:, 0] > 9
    plane = Plane(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.9, 0.9, 0.1]))
    poses = np.zeros((0, 3, 4))
    return SyntheticPhotos((8, 8), 8.0, poses, lambda pose: pose, points, points, (plane,), SIZE, everywhere, nowhere)


def test_a_perfect_mesh_has_no_error(scene):
    found = compared(sheet(), scene)
    assert found["chamfer_percent"] < 0.01 and found["f_score"] > 0.999
    assert found["normal_deg"] < 0.1 and found["flatness_percent"] < 1e-3 and found["thin_percent"] is None


@pytest.mark.parametrize("percent", [0.2, 1.0])
def test_a_mesh_beside_its_place_is_told_by_as_much(scene, percent):
    found = compared(sheet(height=percent * SIZE / 100), scene)
    assert found["chamfer_percent"] == pytest.approx(percent, rel=0.05)
    assert (found["f_score"] > 0.99) == (percent < 0.5) and found["flatness_percent"] < 1e-3


def test_waves_are_told_by_flatness_and_normals(scene):
    found = compared(sheet(waves=0.01), scene)
    assert 0.1 < found["flatness_percent"] < 0.5 and found["normal_deg"] > 5


def test_a_missing_half_costs_completeness_alone(scene):
    half = sheet()
    found = compared(half._replace(faces=half.faces[half.vertices[half.faces].max(1)[:, 0] < 0]), scene)
    assert found["to_truth_percent"] < 0.01 and found["to_mesh_percent"] > 10


def test_a_second_sheet_costs_accuracy_alone(scene):
    one, other = sheet(), sheet(height=-0.4)
    both = Surface(
        np.concatenate([one.vertices, other.vertices]), np.concatenate([one.faces, other.faces + len(one.vertices)])
    )
    found = compared(both, scene)
    assert found["to_truth_percent"] == pytest.approx(10, rel=0.05) and found["to_mesh_percent"] < 0.05
