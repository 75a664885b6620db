"""What `pipeline doctor --bench` says that training could reach: the work of a ray is that of the steps taken here."""

import pytest
import torch

from nerf.grid_training import ADAM_BYTES
from pipeline import bench
from stages.train import PART_SAMPLES
from stages.training_size import SAMPLES_PER_RAY


@pytest.mark.parametrize("space", ["bounded", "contracted"])
def test_the_optimiser_is_shared_by_as_many_rays_as_a_step_has_on_this_machine(
    space: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.device.compute_device", lambda: "cpu")
    works = []
    for count in (1, 4):
        monkeypatch.setattr("stages.device.cores", lambda count=count: count)
        works.append(bench.grid_work(space == "contracted", 20))
    one, four = works
    assert one.bytes == pytest.approx(4 * four.bytes)
    assert (one.products, one.rows) == (four.products, four.rows)
    entries = one.bytes / ADAM_BYTES * PART_SAMPLES[space] / SAMPLES_PER_RAY[space]
    assert 3 * 2**18 < entries / 4 <= 5 * 2**18, "five grids of four features, the coarse ones small"


def test_both_kinds_of_space_have_their_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SECONDS", 1e-3)
    lines = bench.bench_lines(torch.device("cpu"))
    for space, where in bench.WHERE.items():
        (line,) = (line for line in lines if where in line)
        assert f"({SAMPLES_PER_RAY[space]} colours, {bench.DENSITIES[space]} densities a ray)" in line
