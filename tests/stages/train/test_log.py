import json
import sys
from pathlib import Path

import pytest

from stages.contract import StageError
from stages.train.state import TrainingLog

POINT = {"step": 3, "seconds": 0.5, "train_psnr": 20.0, "probe_psnr": None}


def test_events_are_appended_line_by_line_over_restarts(tmp_path: Path) -> None:
    TrainingLog(tmp_path, tensorboard=False).event("schedule-revised", 1, total_steps=9)
    TrainingLog(tmp_path, tensorboard=False).point(POINT)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert lines == [{"event": "schedule-revised", "step": 1, "total_steps": 9}, {"event": "evaluated", **POINT}]


def test_tensorboard_is_asked_for_in_words_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(StageError) as failure:
        TrainingLog(tmp_path, tensorboard=True)
    assert str(failure.value) == (
        "cannot write TensorBoard files: the tensorboard package is not installed. "
        "Install it with `pip install tensorboard`, or leave out --train.tensorboard."
    )
