"""How the worker matches: which features are compared, and how many pairs a relaxed ratio test takes."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.sfm import matching
from stages.sfm.colmap.database.matching import RELAXED_RATIO, STRICT_RATIO
from stages.sfm.matching import relaxed_pairs
from stages.sfm.retry_strategies import STRATEGIES

BY_NAME = {strategy.name: strategy for strategy in STRATEGIES}


def state_of(photos: int, matcher: str) -> Any:
    said = SimpleNamespace(begin=lambda *_, **__: None, end=lambda _: None)
    job = SimpleNamespace(matcher=matcher, neighbours=30, seed=0)
    return SimpleNamespace(photos=[None] * photos, job=job, features=lambda _: "indexed", **vars(said))


@pytest.mark.parametrize("ratio", [STRICT_RATIO, RELAXED_RATIO])
@pytest.mark.parametrize(("matcher", "features"), [("exhaustive", None), ("retrieval", "indexed")])
def test_chosen_pairs_are_compared_by_the_inverted_file(
    matcher: str, features: str | None, ratio: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(matching, "match_pairs", lambda *args: given.extend(args))
    matching._match(tmp_path / "m.db", np.array([[0, 1]]), ratio, state_of(2, matcher))
    assert given[3] == ratio and given[5] == features


@pytest.mark.parametrize(
    ("name", "photos", "matcher", "missing", "matched", "pairs"),
    [
        ("relaxed ratio test", 16, "exhaustive", 8, 120, 120 - 28),
        ("relaxed ratio test", 107, "retrieval", 67, 1230, 2820 - 230),  # 230 are between registered photos
        ("relaxed ratio test", 300, "retrieval", 30, 6000, 30 * 200),
        ("missing photos", 300, "retrieval", 2, 6000, 2 * 60),
    ],
)
def test_pairs_of_a_relaxed_ratio_test_are_foreseen(
    name: str, photos: int, matcher: str, missing: int, matched: int, pairs: int
) -> None:
    assert relaxed_pairs(BY_NAME[name], missing, matched, state_of(photos, matcher)) == pytest.approx(pairs, rel=0.1)
