"""Figures are printed as a table and kept with where they come from."""

import json
from pathlib import Path

import pytest

from benchmarks.record import Record, cell, column


def test_figures_are_printed_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    record = Record(tmp_path / "runs.json")
    record.add(set="fox", psnr=30.126, train_seconds=180, steps=3810)
    record.add(set="fern", psnr=[24.5, 0.25], train_seconds=None, steps=None)
    assert capsys.readouterr().out.splitlines() == [
        "| set | PSNR (dB) | train (s) | steps |",
        "|---|---|---|---|",
        "| fox | 30.13 | 180 | 3,810 |",
        "| fern | 24.50 ± 0.25 |  |  |",
    ]
    kept = json.loads((tmp_path / "runs.json").read_text("utf-8"))
    assert kept["figures"] == record.figures
    assert all(kept[name] for name in ("command", "date", "machine", "commit"))


@pytest.mark.parametrize(
    ("key", "heading"),
    [("psnr", "PSNR (dB)"), ("centres_mm", "centres (mm)"), ("lego_400", "lego_400"), ("off_percent", "off (%)")],
)
def test_headings_name_units(key: str, heading: str):
    assert column(key)[0] == heading


def test_absent_figures_leave_a_cell_empty():
    assert (cell("ssim", None), cell("front", False), cell("ssim", 0.97)) == ("", "", "0.970")
