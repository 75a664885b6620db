"""Which strategies the worker process tries."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stages.contract import Note
from stages.sfm import worker
from stages.sfm.colmap.unregistered_images import Links
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


def test_photos_added_to_a_model_change_nothing_else() -> None:
    why, conflict = Note("sfm.x", "why"), {"group": 1, "photos": ["a"], "others": ["c", "d"]}
    before = Outcome(
        "default", "x.db", [["a", "b"], ["c", "d"]], 90, 0.4, conflict, {}, {"tried": 3}, {"c": why, "e": why}
    )
    found = Outcome("missing photos", "missing.db", [["a", "b", "c"]], 95, 0.5)
    after = worker._added_to(before, found)
    assert after.groups == [["a", "b", "c"], ["c", "d"]] and after.match_graph == {"tried": 3}
    assert after.conflict == conflict | {"others": ["d"]} and after.excluded == {"e": why}
    assert after.rank > before.rank
    none = worker._added_to(before, Outcome("missing photos", "missing.db", [["a", "b"]], 99, 0.3))
    assert none.rank <= before.rank and none.conflict == conflict
