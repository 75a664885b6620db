"""``pipeline doctor --bench``: the rates of this machine, and what training could reach with them."""

import math
import re

import pytest

from nerf import machine_rates
from pipeline import bench, cli, doctor


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SECONDS", 0.01)
    monkeypatch.setattr(machine_rates, "STREAMED", 1 << 20)
    monkeypatch.setattr(machine_rates, "LEAST_STREAMED", 1 << 18)
    monkeypatch.setattr(doctor, "self_test", lambda device: [])


def test_every_rate_has_a_line_with_figures_of_a_computer(quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run_command(["doctor", "--bench"]) == 0
    out = capsys.readouterr().out
    rates = re.findall(r"^  (.+?)  +([\d.]+)(?: +([\d.]+))? (GFLOP/s|million/s|GB/s)$", out, re.M)
    assert [unit for *_, unit in rates] == ["GFLOP/s"] * 2 + ["million/s"] * 2 + ["GB/s"]
    for name, one, every, unit in rates:
        assert 0 < float(one) < 1e6 and math.isfinite(float(one)), (name, unit)
        assert not every or float(every) >= float(one)
    reached = re.findall(r"^ +([\d.]+ ?[kM]?) rays/s  (.+)$", out, re.M)
    assert [name.split(" (")[0] for _, name in reached] == [f"grid field {where}" for where in bench.RAYS] + [
        *bench.PAPER_RAYS
    ]
    assert all(float(speed.rstrip("kM ")) > 0 for speed, _ in reached)


def test_it_is_measured_only_if_asked_for(quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run_command(["doctor"]) == 0
    assert "GFLOP/s" not in (out := capsys.readouterr().out) and "rays/s" not in out
