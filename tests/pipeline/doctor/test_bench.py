"""``pipeline doctor --bench``: the rates of this machine, and what training could reach with them."""

import math
import re

import pytest

from nerf.training.hash_grid_trainer import ADAM_BYTES
from pipeline import doctor
from pipeline.cli import commands
from pipeline.doctor import bench
from stages.effects.decisions import Space
from stages.train.fields.hash_grid import MICRO_BATCH_SAMPLES, SAMPLES_PER_RAY


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SECONDS", 0.01)
    monkeypatch.setattr(bench, "measure_copy", lambda device, seconds: 5e9)  # by itself it takes half a second
    monkeypatch.setattr(doctor, "self_test", lambda device: [])


def test_every_rate_has_a_line_with_figures_of_a_computer(quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.run_command(["doctor", "--bench"]) == 0
    out = capsys.readouterr().out
    rates = re.findall(r"^  (.+?)  +([\d.]+)(?: +([\d.]+))? (GFLOP/s|million/s|GB/s)$", out, re.M)
    assert [unit for *_, unit in rates] == ["GFLOP/s"] * 2 + ["million/s"] * 2 + ["GB/s"]
    for name, one, every, unit in rates:
        assert 0 < float(one) < 1e6 and math.isfinite(float(one)), (name, unit)
        assert not every or float(every) >= float(one)
    reached = re.findall(r"^ +([\d.]+ ?[kM]?) rays/s  (.+)$", out, re.M)
    for space, where in bench.WHERE.items():
        (name,) = (name for _, name in reached if where in name)
        assert f"({SAMPLES_PER_RAY[space]} colours, {bench.DENSITIES[space]} densities a ray)" in name
    assert len(reached) == len(bench.WHERE) + len(bench.VANILLA_RAYS)
    assert all(float(speed.rstrip("kM ")) > 0 for speed, _ in reached)


def test_it_is_measured_only_if_asked_for(quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.run_command(["doctor"]) == 0
    assert "GFLOP/s" not in (out := capsys.readouterr().out) and "rays/s" not in out


@pytest.mark.parametrize("space", ["bounded", "contracted"])
def test_the_optimisers_share_follows_the_rays_per_step(space: Space, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.fields.hash_grid.compute_device", lambda: "cpu")
    works = []
    for count in (1, 4):
        monkeypatch.setattr("stages.train.fields.hash_grid.cores", lambda count=count: count)
        works.append(bench.grid_work(space, 20))
    one, four = works
    assert one.streamed_bytes == pytest.approx(4 * four.streamed_bytes)
    assert (one.matmul_flops, one.gathered_rows) == (four.matmul_flops, four.gathered_rows)
    entries = one.streamed_bytes / ADAM_BYTES * MICRO_BATCH_SAMPLES[space] / SAMPLES_PER_RAY[space]
    assert 3 * 2**18 < entries / 4 <= 5 * 2**18, "five grids of four features, the coarse ones small"
