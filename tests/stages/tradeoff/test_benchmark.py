"""One training of a study: what is kept of it, and where it is scored."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.contract import StageError
from stages.io.files import read_json
from stages.tradeoff.benchmark import (
    RUN_FAILURES,
    Benchmark,
    figures_file,
    make_benchmark,
    read_figures,
    train_and_score,
)
from stages.tradeoff.schedule import Run
from tests.refusals import refused
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed

RUN = Run("grid", "bounded", 1.0, 100, 0, 1.0)
NO_BENCHMARK: Any = None


@pytest.fixture
def diverging(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverges(*_: object) -> None:
        raise StageError(RUN_FAILURES[0], "training diverged", "it was told to", "Do not tell it to.")

    monkeypatch.setattr("stages.tradeoff.benchmark.run_stage", diverges)


@pytest.mark.usefixtures("diverging")
@pytest.mark.parametrize("content", [b"", bytes(100), b'{"failed": nul'], ids=["empty", "zeros", "cut off"])
def test_figures_that_cannot_be_read_are_found_anew(content: bytes, tmp_path: Path, progress: Any) -> None:
    file = figures_file(RUN, tmp_path)
    file.write_bytes(content)
    assert read_figures(file) is None
    figures = train_and_score(RUN, NO_BENCHMARK, {}, tmp_path, progress)
    assert figures["failed"] == "training diverged: it was told to"
    assert read_figures(file) == read_json(file) == figures


@pytest.mark.usefixtures("diverging")
def test_a_full_disk_leaves_no_figures(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        train_and_score(RUN, NO_BENCHMARK, {}, tmp_path, progress)
    assert not figures_file(RUN, tmp_path).exists()
    assert (tmp_path / RUN.name).is_dir(), "the training goes on from there"


def masked_benchmark(folder: Path, unmasked: tuple[slice, slice]) -> Benchmark:
    """Of photos of which masks leave only a part."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[unmasked] = 255
    inputs, scene = photographed(folder, mask=mask)
    return make_benchmark(inputs["ingest"], scene, 1.0, 6, 1.0)


def test_tiles_lie_where_masks_leave_something(tmp_path: Path) -> None:
    crops = masked_benchmark(tmp_path, (slice(10, 14), slice(0, 4))).crops
    assert len(crops) == 2
    assert all(crop.mask is not None and len(crop.mask) == 16 and crop.mask.sum() == 16 for crop in crops)


def test_masks_that_leave_nothing_are_said(tmp_path: Path) -> None:
    with refused("tradeoff.no-pixels-to-score") as caught:
        masked_benchmark(tmp_path, (slice(0, 0), slice(0, 0)))
    assert "masks leave almost nothing" in caught.value.why
