"""How the worker matches: how features are compared, and how many pairs a relaxed ratio test takes."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.sfm import extraction_and_matching
from stages.sfm.retry_strategies import STRATEGIES

BY_NAME = {strategy.name: strategy for strategy in STRATEGIES}


def state_of(photos: int, matcher: str) -> Any:
    job = SimpleNamespace(matcher=matcher, neighbours=30, max_image_size=1600, max_features=4096)
    databases = {"database": Path("m.db"), "latest": lambda: Path("m.db"), "sibling": Path}
    return SimpleNamespace(job=job, photos=[None] * photos, files=[""] * photos, **databases)


@pytest.mark.parametrize(
    ("matcher", "name", "compared"),
    [
        ("exhaustive", "default", "exactly"),
        ("retrieval", "default", "by the inverted file"),
        ("exhaustive", "relaxed ratio test", "exactly"),
        ("retrieval", "relaxed ratio test", "by the inverted file"),
        ("exhaustive", "more features", "by the inverted file"),
    ],
)
def test_many_pairs_or_features_are_compared_by_the_inverted_file(
    matcher: str, name: str, compared: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[bool] = []
    monkeypatch.setattr(extraction_and_matching, "_extract", lambda *_: None)
    monkeypatch.setattr(extraction_and_matching, "_match_all", lambda _, exact, __: given.append(exact))
    monkeypatch.setattr(extraction_and_matching, "_match", lambda _, __, ___, exact, ____: given.append(exact))
    monkeypatch.setattr(extraction_and_matching, "matched_pairs", lambda _: np.array([[0, 1], [0, 2], [1, 2]]))
    monkeypatch.setattr(extraction_and_matching, "copy_without_matches_of", lambda *_: None)
    extraction_and_matching.match_photos(BY_NAME[name], [2], state_of(3, matcher))
    assert given == [compared == "exactly"]


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
    assert extraction_and_matching.relaxed_pairs(
        BY_NAME[name], missing, matched, state_of(photos, matcher)
    ) == pytest.approx(pairs, rel=0.1)
