"""Matching into COLMAP's database, on features that a synthetic scene of points would have."""

from pathlib import Path
from threading import get_ident

import numpy as np
import pycolmap
import pytest

from stages.hardware import cluster
from stages.sfm.colmap.database import matching
from stages.sfm.colmap.database.features import Features
from stages.sfm.colmap.database.matching import match_pairs, verify_again
from stages.sfm.pairs.pair_selection import exhaustive
from tests.stages.sfm.colmap.conftest import COUNT

PAIRS = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]


def copy_of(database: Path, name: str) -> Path:
    copy = database.with_name(name)
    for part in ("", "-wal", "-shm"):
        if (source := database.with_name(database.name + part)).exists():
            copy.with_name(copy.name + part).write_bytes(source.read_bytes())
    return copy


def found(database: Path) -> dict[tuple[int, int], tuple[bytes, bytes, int]]:
    """Matches, verified matches and kind of geometry of every pair that was tried."""
    result = {}
    with pycolmap.Database.open(database) as db:
        for i, j in PAIRS:
            if db.exists_two_view_geometry(i + 1, j + 1):
                geometry = db.read_two_view_geometry(i + 1, j + 1)
                verified = geometry.inlier_matches.tobytes()
                result[i, j] = db.read_matches(i + 1, j + 1).tobytes(), verified, int(geometry.config)
    return result


def test_a_list_of_pairs_gives_what_all_pairs_give(database: Path) -> None:
    some = np.array([[0, 1], [1, 4], [2, 3], [0, 5]])
    everything, listed = copy_of(database, "all.db"), copy_of(database, "some.db")
    match_pairs(everything, exhaustive(COUNT), 0, 0.8)
    match_pairs(listed, some, 0, 0.8)
    every = found(everything)
    assert list(every) == PAIRS
    assert found(listed) == {pair: every[pair] for pair in map(tuple, some.tolist())}
    verified = {pair: len(inliers) // 8 for pair, (_, inliers, _) in every.items()}
    assert all(verified[i, i + 1] > 50 for i in range(COUNT - 2))
    assert all(verified[i, COUNT - 1] == 0 for i in range(COUNT - 1)), "too few matches are no geometry"


def test_verified_matches_are_those_of_colmaps_own_verification(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    ours = found(database)
    with pycolmap.Database.open(database) as db:
        for i, j in PAIRS:
            db.delete_two_view_geometry(i + 1, j + 1)
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{i}.png {j}.png\n" for i, j in PAIRS))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    pycolmap.verify_matches(database, listed, options)
    theirs = found(database)
    assert {pair: rest for pair, (_, *rest) in ours.items()} == {pair: rest for pair, (_, *rest) in theirs.items()}


@pytest.mark.parametrize(("ratio", "trials"), [(0.8, 10_000), (0.9, matching.RELAXED_TRIALS)])
def test_verification_of_relaxed_matches_ends_sooner(
    ratio: float, trials: int, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    allowed, real = set[int](), matching._verified
    monkeypatch.setattr(matching, "_verified", lambda *args: allowed.add(args[-1].ransac.max_num_trials) or real(*args))
    match_pairs(database, exhaustive(COUNT), 0, ratio)
    assert allowed == {trials}


def test_the_number_of_cores_changes_nothing(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for cores in (1, 4):
        monkeypatch.setattr(matching, "processors", lambda cores=cores: cores)
        copy = copy_of(database, f"{cores}.db")
        match_pairs(copy, exhaustive(COUNT), 0, 0.8)
        results.append(found(copy))
    assert results[0] == results[1]


def verified_again(database: Path) -> dict[tuple[int, int], tuple[bytes, bytes, int]]:
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        verify_again(db, seed=0)
    return found(database)


@pytest.mark.parametrize("cores", [1, 2, 4])
def test_verifying_again_gives_the_same_on_any_number_of_cores(
    cores: int, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    before, threads, real = found(database), set(), matching._verified
    monkeypatch.setattr(matching, "BLOCK_SIZE", 4)
    monkeypatch.setattr(matching, "processors", lambda: cores)
    monkeypatch.setattr(matching, "_verified", lambda *args: threads.add(get_ident()) or real(*args))
    assert verified_again(database) == before and list(before) == PAIRS
    assert get_ident() not in threads and len(threads) <= cores
    with pycolmap.Database.open(database) as db:
        camera = db.read_camera(1)
        camera.params = [3 * camera.params[0], *camera.params[1:]]
        camera.has_prior_focal_length = True
        db.update_camera(camera)
    monkeypatch.setattr(matching, "_on_own_cores", lambda _, work, blocks: map(work, blocks))
    alone = verified_again(copy_of(database, "alone.db"))
    monkeypatch.undo()
    assert verified_again(database) == alone != before


def test_a_cluster_verifies_the_same(database: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    before = found(database)
    monkeypatch.setattr(matching, "_on_own_cores", lambda *_: pytest.fail("verified here"))
    with cluster.joined(ray_cluster):
        assert verified_again(database) == before


@pytest.mark.parametrize("words", [None, np.random.default_rng(1).integers(0, 60, (8, 128)).astype(np.float32)])
def test_a_cluster_finds_the_same_matches(
    words: np.ndarray | None, database: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matching, "BLOCK_SIZE", 4)
    here = copy_of(database, "here.db")
    match_pairs(here, exhaustive(COUNT), 0, 0.8, features=Features(words))
    monkeypatch.setattr(matching, "_on_own_cores", lambda *_: pytest.fail("matched here"))
    with cluster.joined(ray_cluster):
        match_pairs(database, exhaustive(COUNT), 0, 0.8, features=Features(words))
    assert list(found(here)) == PAIRS and found(database) == found(here)


def test_only_what_is_missing_is_matched(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = copy_of(database, "whole.db")
    match_pairs(whole, exhaustive(COUNT), 0, 0.8)
    match_pairs(database, exhaustive(COUNT)[::2], 0, 0.8)
    told, tried, real = [], [], matching._match
    monkeypatch.setattr(matching, "_match", lambda *args: tried.append(args) or real(*args))
    match_pairs(database, exhaustive(COUNT), 0, 0.8, lambda pairs, seconds: told.append((pairs, seconds)))
    assert len(tried) == 7  # 8 of 15 were there
    assert [pairs for pairs, _ in told] == [7] and told[0][1] > 0
    assert found(database) == found(whole)
    match_pairs(database, exhaustive(COUNT), 0, 0.8, lambda pairs, seconds: told.append((pairs, seconds)))
    assert len(tried) == 7 and len(told) == 1


def test_the_first_block_is_spread_over_all_pairs() -> None:
    pairs = [(i, j) for i in range(40) for j in range(i + 1, 40)]
    order = matching._spread(pairs)
    assert sorted(order) == pairs
    firsts = [i for i, _ in order[: matching.BLOCK_SIZE]]
    assert min(firsts) == 0 and max(firsts) > 30
    assert matching._spread([]) == []
