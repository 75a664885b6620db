"""One training of a study: what is kept of it, and where it is scored."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import train
from stages.contract import StageError
from stages.io.files import read_json
from stages.tradeoff import trial as tradeoff_trial
from stages.tradeoff.runs import Arm
from stages.tradeoff.trial import ENOUGH, OWN_FAULTS, Exam, figures_file, kept, make_exam, run_arm
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed

ARM = Arm("grid", "bounded", 1.0, 100, 0, 1.0)
NO_EXAM: Any = None


@pytest.fixture
def diverging(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverges(*_: object) -> None:
        raise StageError(OWN_FAULTS[0], "training diverged", "it was told to", "Do not tell it to.")

    monkeypatch.setattr(train, "run", diverges)


@pytest.mark.usefixtures("diverging")
@pytest.mark.parametrize("content", [b"", bytes(100), b'{"failed": nul'], ids=["empty", "zeros", "cut off"])
def test_figures_that_cannot_be_read_are_found_anew(content: bytes, tmp_path: Path, progress: Any) -> None:
    file = figures_file(ARM, tmp_path)
    file.write_bytes(content)
    assert kept(file) is None
    figures = run_arm(ARM, NO_EXAM, {}, tmp_path, progress)
    assert figures["failed"] == "training diverged: it was told to"
    assert kept(file) == read_json(file) == figures


@pytest.mark.usefixtures("diverging")
def test_a_full_disk_leaves_no_figures(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        run_arm(ARM, NO_EXAM, {}, tmp_path, progress)
    assert not figures_file(ARM, tmp_path).exists()
    assert (tmp_path / ARM.name).is_dir(), "the training goes on from there"


def masked_exam(folder: Path, used: tuple[slice, slice]) -> Exam:
    """Six windows of photos of which masks leave only a part."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[used] = 255
    inputs, scene = photographed(folder, mask=mask)
    return make_exam(inputs["ingest"], scene, 1.0, 6, 1.0)


def test_windows_lie_where_masks_leave_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff_trial, "WINDOW", 4)
    windows = masked_exam(tmp_path, (slice(10, 14), slice(3, 8))).windows
    shares = [float(window.used.float().mean()) for window in windows if window.used is not None]
    assert len(shares) == 6 and min(shares) >= ENOUGH
    corners = {(window.photo, *window.rays.directions[0, 0].tolist()) for window in windows}
    assert len(corners) == 6, "none is looked at twice"


def test_where_masks_leave_too_little_the_best_places_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tradeoff_trial, "WINDOW", 4)
    monkeypatch.setattr(tradeoff_trial, "THINNED", 1)
    windows = masked_exam(tmp_path, (slice(8, 9), slice(8, 11))).windows
    assert [int(window.used.sum()) for window in windows if window.used is not None] == [3] * 6


def test_masks_that_leave_nothing_are_said(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="nothing to score a study by") as caught:
        masked_exam(tmp_path, (slice(0, 0), slice(0, 0)))
    assert "masks leave next to nothing" in caught.value.why
