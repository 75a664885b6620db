"""The time that structure-from-motion took counts over all its runs, whatever ended them."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages import sfm
from stages.contract import StageError
from stages.sfm import clock as sfm_clock
from stages.sfm import process as sfm_process
from stages.sfm.clock import Clock
from stages.sfm.retry_strategies import GIVEN, GIVEN_UP, NO_TIME, OUT_OF_TIME, left_out_for_time
from stages.sfm.work import Job, Work
from tests.stages.sfm.sfm_inputs import SMALL, ingested
from tests.synthetic_photos import SyntheticPhotos


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Lets time pass at once."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_a_phase_goes_on_counting_unless_it_begins_anew(tmp_path: Path, wait: Callable[[float], None]) -> None:
    clock = Clock(tmp_path / "clock.json")
    assert (clock.total, clock.earlier) == (0, 0)
    wait(1)
    clock.begin("first: features", anew=False)
    wait(10)
    assert clock.end() == 10
    clock.begin("first: matching", anew=False)
    wait(100)
    clock.keep()
    wait(5)  # of these nobody knows
    again = Clock(tmp_path / "clock.json")
    assert again.earlier == again.total == 111
    again.begin("first: features", anew=False)
    assert again.end() == 10
    again.begin("first: matching", anew=False)
    wait(20)
    assert again.end() == 120
    for _ in range(2):
        again.begin("first: mapping", anew=True)
        wait(7)
        assert again.end() == 7
    assert (again.total, again.earlier) == (145, 111)


def work(folder: Path, seconds: float | None, max_seconds: float) -> Work:
    search = {"max_image_size": 800, "max_features": 500, "matcher": "exhaustive", "neighbours": 3, "attempts": 7}
    given = {"seed": 0, "camera_model": None, "camera_params": None, "seconds": seconds, "max_seconds": max_seconds}
    paths = {"folder": str(folder), "images": str(folder), "database": str(folder / "x.db")}
    return Work(Job(**paths, photos=[], **search, **given), lambda **message: None)


@pytest.mark.parametrize(
    ("seconds", "max_seconds", "left", "limit"),
    [
        (500.0, 1000.0, 500 - 300 - 50, GIVEN),
        (None, 1000.0, 1000 - 50, GIVEN_UP),
        (5000.0, 1000.0, 1000 - 50, GIVEN_UP),
        (1200.0, 1000.0, 1200 - 300 - 50, GIVEN),
    ],
)
def test_the_time_given_is_for_all_runs_together(
    tmp_path: Path, wait: Callable[[float], None], seconds: float | None, max_seconds: float, left: float, limit: str
) -> None:
    first = work(tmp_path, seconds, max_seconds)
    wait(300)
    first.clock.keep()
    second = work(tmp_path, seconds, max_seconds)
    wait(50)
    assert second.left() == (left, limit)


def test_attempts_left_out_for_time_are_counted() -> None:
    reasons = [None, f"{NO_TIME} {GIVEN}", f"{NO_TIME} {GIVEN_UP}", f"it {OUT_OF_TIME}", "it ended the program"]
    assert left_out_for_time([{"passed": reason} for reason in reasons]) == 3


def test_a_run_that_goes_on_knows_what_the_one_before_it_took(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = sorted(synthetic_photos.folder.iterdir())[:6]
    folders = ingested(tmp_path / "ingest", {file.name: np.asarray(Image.open(file)) for file in pictures})
    killed = (
        "import os, time, stages.sfm.worker as c, stages.sfm.clock as clock, stages.sfm.matching as matching\n"
        "clock.BEAT = 0.1\n"
        "matching.match_pairs = lambda *_: (time.sleep(3), os.kill(os.getpid(), 9))\n"
        "c.main()"
    )
    told = (
        "import stages.sfm.worker as c, stages.sfm.retry_strategies as a\n"
        "add = a.Journal.add\n"
        "a.Journal.add = lambda journal, tried: (print(tried.seconds, file=c.sys.stderr), add(journal, tried))\n"
        "c.main()"
    )
    with monkeypatch.context() as patched:
        patched.setattr(sfm_process, "CHILD", ["-c", killed])
        with pytest.raises(StageError, match="was ended by SIGKILL while matching"):
            sfm.run(SMALL, folders, tmp_path / "sfm", progress)
    total, phases = json.loads((tmp_path / "sfm/attempts" / sfm_clock.NAME).read_text())
    assert phases["first: matching"] > 2 and total > phases["first: matching"] + phases["first: features"]
    monkeypatch.setattr(sfm_process, "CHILD", ["-c", told])
    sfm.run(SMALL, folders, tmp_path / "sfm", progress)
    log = (tmp_path / "sfm/sfm.log").read_text()
    seconds = json.loads(next(line for line in log.splitlines() if line.startswith("{'features'")).replace("'", '"'))
    assert seconds["features"] >= phases["first: features"]
    assert seconds["matching"] >= phases["first: matching"]
    assert not (tmp_path / "sfm/attempts").exists()
