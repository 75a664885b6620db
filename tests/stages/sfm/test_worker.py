"""Which strategies the worker process tries."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stages.sfm import worker
from stages.sfm.colmap.diagnosis import Links
from stages.sfm.retry_strategies import STRATEGIES, Outcome, StrategyLog


@pytest.mark.parametrize("missing", [1, 20])
def test_matches_are_read_only_where_they_decide(missing: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (strategy,) = (one for one in STRATEGIES if one.name == "weaker initial pair")
    read = []
    monkeypatch.setattr(worker, "links", lambda *_: read.append(1) or Links(join=False, planar=False))
    log = StrategyLog(tmp_path / "strategies")
    log.add(Outcome("default", "x.db", groups=[[str(i) for i in range(missing, 100)]], points=500))
    state: Any = SimpleNamespace(log=log, usable=log.best, latest=lambda: tmp_path, job=SimpleNamespace())
    state.job.camera_model, state.files = None, [str(i) for i in range(100)]
    state.photos = [SimpleNamespace(focal_px=None)] * 100
    why = worker._why_useless(strategy, list(range(missing)), state)
    assert ("not worth it for 1 of 100" if missing == 1 else "share too few matches") in str(why)
    assert len(read) == (missing > 1)
