"""The time that structure-from-motion took counts over all its runs, whatever ended them."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import stages.sfm.job as job_module
from stages import sfm
from stages.contract import run_stage
from stages.sfm import worker_process
from stages.sfm.job import PHASE_SECONDS, Job, JobState, PhaseTimer
from stages.sfm.retry_strategies import MAX_SECONDS_LIMIT, TIME_GIVEN, Outcome
from tests.refusals import refused
from tests.stages.sfm.sfm_inputs import SMALL, ingested
from tests.synthetic_photos import SyntheticPhotos


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Lets time pass at once."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_a_phase_goes_on_counting_unless_it_begins_anew(tmp_path: Path, wait: Callable[[float], None]) -> None:
    clock = PhaseTimer(tmp_path / "clock.json")
    assert (clock.total, clock.earlier) == (0, 0)
    wait(1)
    clock.begin("default: features", from_zero=False)
    wait(10)
    assert clock.end() == 10
    clock.begin("default: matching", from_zero=False)
    wait(100)
    clock.save()
    wait(5)  # of these nobody knows
    again = PhaseTimer(tmp_path / "clock.json")
    assert again.earlier == again.total == 111
    again.begin("default: features", from_zero=False)
    assert again.end() == 10
    again.begin("default: matching", from_zero=False)
    wait(20)
    assert again.end() == 120
    for _ in range(2):
        again.begin("default: mapping", from_zero=True)
        wait(7)
        assert again.end() == 7
    assert (again.total, again.earlier) == (145, 111)


def work(folder: Path, seconds: float | None, max_seconds: float) -> JobState:
    search = {"max_image_size": 800, "max_features": 500, "matcher": "exhaustive", "neighbours": 3, "max_strategies": 7}
    given = {"seed": 0, "camera_model": None, "camera_params": None, "seconds": seconds, "max_seconds": max_seconds}
    paths = {"folder": str(folder), "images": str(folder), "database": str(folder / "x.db")}
    return JobState(Job(**paths, photos=[], **search, **given), lambda **message: None)


@pytest.mark.parametrize(
    ("seconds", "max_seconds", "left", "limit"),
    [
        (500.0, 1000.0, 500 - 300 - 50, TIME_GIVEN),
        (None, 1000.0, 1000 - 50, MAX_SECONDS_LIMIT),
        (5000.0, 1000.0, 1000 - 50, MAX_SECONDS_LIMIT),
        (1200.0, 1000.0, 1200 - 300 - 50, TIME_GIVEN),
    ],
)
def test_the_time_given_is_for_all_runs_together(
    tmp_path: Path, wait: Callable[[float], None], seconds: float | None, max_seconds: float, left: float, limit: str
) -> None:
    first = work(tmp_path, seconds, max_seconds)
    wait(300)
    first.timer.save()
    second = work(tmp_path, seconds, max_seconds)
    wait(50)
    assert second.left() == (left, limit)


@pytest.mark.parametrize(("fits", "missing"), [(True, [3]), (False, [0, 1, 2, 3])])
def test_a_misfit_registers_no_image(tmp_path: Path, fits: bool, missing: list[int]) -> None:
    state = work(tmp_path, None, 900.0)
    state.files = ["a", "b", "c", "d"]
    state.log.outcomes = [Outcome("default", "matches.db", [["a", "b", "c"]], points=500, fits=fits)]
    assert state.missing() == missing


def test_a_resumed_run_knows_its_earlier_time(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = sorted(synthetic_photos.folder.iterdir())[:6]
    folders = ingested(tmp_path / "ingest", {file.name: np.asarray(Image.open(file)) for file in pictures})
    killed = (
        "import os, time, stages.sfm.worker as c, stages.sfm.job as job\n"
        "import stages.sfm.extraction_and_matching as matching\n"
        "job.SAVE_INTERVAL_SECONDS = 0.1\n"
        "matching.match_pairs = lambda *_: (time.sleep(3), os.kill(os.getpid(), 9))\n"
        "c.main()"
    )
    told = (
        "import stages.sfm.worker as c, stages.sfm.retry_strategies as a\n"
        "add = a.StrategyLog.add\n"
        "a.StrategyLog.add = lambda journal, tried: (print(tried.seconds, file=c.sys.stderr), add(journal, tried))\n"
        "c.main()"
    )
    with monkeypatch.context() as patched:
        patched.setattr(worker_process, "COMMAND", ["-c", killed])
        with refused("sfm.worker-killed", "SIGKILL", "matching"):
            run_stage(sfm.STAGE, SMALL, folders, tmp_path / "sfm", progress)
    total, phases = json.loads((tmp_path / "sfm/strategies" / PHASE_SECONDS).read_text())
    assert phases["default: matching"] > 2 and total > phases["default: matching"] + phases["default: features"]
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", told])
    run_stage(sfm.STAGE, SMALL, folders, tmp_path / "sfm", progress)
    log = (tmp_path / "sfm/sfm.log").read_text()
    seconds = json.loads(next(line for line in log.splitlines() if line.startswith("{'features'")).replace("'", '"'))
    assert seconds["features"] >= phases["default: features"]
    assert seconds["matching"] >= phases["default: matching"]


def test_features_do_not_take_memory_while_mapping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_module, "read_vocabulary", lambda *_: np.zeros((2, 128), np.float32))
    state = work(tmp_path, None, 60)
    state.begin("matching")
    features = state.features(state.database)
    assert state.features(state.database) is features
    state.end("matching")
    state.begin("mapping")
    assert state.features(state.database) is not features
