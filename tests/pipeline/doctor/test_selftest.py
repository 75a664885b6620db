"""``pipeline doctor --selftest``: the table is whole, and what is off is said and ends in exit code 1."""

from importlib.metadata import version

import pytest

from pipeline import doctor
from pipeline.cli import commands
from pipeline.doctor import selftest
from pipeline.doctor.numerics import matrix
from pipeline.doctor.numerics.matrix import CASES
from pipeline.engine import machine


def test_every_formula_has_a_line_for_each_backend(capsys: pytest.CaptureFixture[str]) -> None:
    assert selftest.numerical_matrix("cpu") == []
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "numerical self-test on cpu: worst errors in float32 against float64"
    of_cases = [line for line in lines if line.startswith("  ok ")]
    assert len(of_cases) == sum(2 if case.kernels else 1 for case in CASES) == len(lines) - 3
    assert all(any(case.formula[:50] in line for line in of_cases) for case in CASES)
    assert lines[-1].startswith(f"{len(CASES)} formulas, {len(CASES)} within their limits, ")


def test_without_warp_torch_alone_is_measured(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("stages.hardware.backend.why_not_warp", lambda device: "it is not there")
    monkeypatch.setattr(matrix, "CASES", [case for case in CASES if case.kernels][:1])
    assert selftest.numerical_matrix("cpu") == []
    assert " torch " in (out := capsys.readouterr().out) and " warp " not in out


def test_a_failed_selftest_is_told_and_exits_with_one(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    case = next(case for case in CASES if "contraction" in case.formula)
    off = case._replace(function=lambda backend, x: case.function(backend, x) * 1.001)
    monkeypatch.setattr(matrix, "CASES", [case, off])
    monkeypatch.setattr(doctor, "self_test", lambda device: [])
    assert commands.run_command(["doctor", "--selftest"]) == 1
    out = capsys.readouterr().out
    where = "nerf/geometry/space_maps/contraction.py: contract"
    assert f"problem: self-test: {case.formula} ({where}) is off by more than its limit" in out
    assert "\n  FAILED " in out and "2 formulas, 1 within their limits" in out


def test_the_matrix_is_measured_only_if_asked_for(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "self_test", lambda device: [])
    monkeypatch.setattr(doctor, "numerical_matrix", lambda device: ["the matrix was measured"])
    assert commands.run_command(["doctor"]) == 0 and "matrix" not in capsys.readouterr().out
    assert commands.run_command(["doctor", "--selftest"]) == 1
    assert "problem: the matrix was measured" in capsys.readouterr().out


@pytest.mark.parametrize(
    "why, line", [(None, "hash-grid field: warp"), ("it is old", "hash-grid field: torch, because it is old")]
)
def test_doctor_names_the_kernels_that_train_would_choose(why, line, monkeypatch, capsys) -> None:
    monkeypatch.setattr(doctor, "self_test", lambda device: [])
    monkeypatch.setattr(doctor, "why_not_warp", lambda device: why)
    assert commands.run_command(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert line in lines
    assert f"  {'warp-lang':<32} {version('warp-lang')}" in lines


def test_manifests_know_the_version_of_warp() -> None:
    assert machine.facts()["warp-lang"] == version("warp-lang")
