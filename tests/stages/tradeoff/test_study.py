from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from stages.tradeoff.plots import Row, write_sheet
from stages.tradeoff.schedule import REDUCED, Run
from stages.tradeoff.study import ablation_differences, ablation_sentence

LEFT_OUT = "no positional encoding"


def result(variant: str, seed: int, psnr: float | None, steps: int = 1000) -> tuple[Run, Mapping[str, Any]]:
    return Run(variant, "bounded", 4.0, steps, seed, 0.0), {"psnr": psnr, "failed": None if psnr else "it diverged"}


def test_differences_are_taken_seed_by_seed() -> None:
    results = [result(REDUCED, 0, 20.0), result(REDUCED, 1, 21.0), result(LEFT_OUT, 0, 17.0), result(LEFT_OUT, 1, 18.2)]
    results += [result(REDUCED, 0, 25.0, steps=2000), result("no view dependence", 0, 19.9)]
    view, encoding = sorted(ablation_differences(results), key=lambda part: part.seeds)
    assert (encoding.difference, encoding.std) == (pytest.approx(-2.9), pytest.approx(0.2 / 2**0.5))
    assert encoding.words == "−2.90 ± 0.14 dB"
    assert (view.variant, view.words, view.std) == ("no view dependence", "−0.10 dB", None)
    assert ablation_sentence(results, (640, 480)) == (
        "Against the complete reduced method, seed by seed, of 2 seeds (± their standard deviation): no positional "
        "encoding −2.90 ± 0.14 dB; no view dependence −0.10 dB; 1,000 steps each, trained on photos at a "
        "quarter of the resolution, scored at 640 × 480."
    )


def test_without_its_counterpart_a_training_tells_no_difference() -> None:
    assert ablation_differences([result(REDUCED, 0, None), result(LEFT_OUT, 0, 17.0)]) == []
    assert ablation_sentence([result(REDUCED, 0, 20.0), result(LEFT_OUT, 1, 17.0)], (640, 480)) is None


def test_the_line_stands_under_the_pictures(tmp_path: Path) -> None:
    Image.new("RGB", (60, 20), "red").save(tmp_path / "strip.png")
    rows = [Row("photo", (), tmp_path / "strip.png"), Row("grid", ("20.0 dB",), tmp_path / "strip.png")]
    sizes = []
    for line in ("", "a line that says what each part is worth " * 5):
        write_sheet(rows, line, tmp_path / "sheet.png")
        with Image.open(tmp_path / "sheet.png") as sheet:
            sizes.append(sheet.size)
    assert sizes[0][0] == sizes[1][0] and sizes[0][1] < sizes[1][1]
