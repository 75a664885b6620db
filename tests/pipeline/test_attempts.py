import json
import os
import time
from pathlib import Path

import pytest

from pipeline import attempts


def test_nothing_was_spent_where_nobody_began(tmp_path: Path):
    assert attempts.spent(tmp_path / "none.partial") == 0
    (tmp_path / attempts.NAME).write_text("{")
    assert attempts.spent(tmp_path) == 0


def begin_earlier(folder: Path, seconds: float) -> None:
    """An attempt that began so many seconds of the machine's running time ago."""
    attempts.begin(folder, 100.0)
    value = json.loads((folder / attempts.NAME).read_text())
    (folder / attempts.NAME).write_text(json.dumps(value | {"up": value["up"] - seconds}))


def test_an_attempt_lasts_until_its_last_sign_of_life(tmp_path: Path):
    begin_earlier(tmp_path, 60.0)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/checkpoint").write_text("x")
    last = time.time() + 7
    os.utime(tmp_path / "deep/checkpoint", (last, last))
    assert attempts.spent(tmp_path) == pytest.approx(107, abs=2)


def test_a_clock_that_was_set_back_takes_nothing_away(tmp_path: Path):
    attempts.begin(tmp_path, 100.0)
    os.utime(tmp_path / attempts.NAME, (0, 0))
    assert attempts.spent(tmp_path) == 100


def test_a_clock_that_was_put_forward_is_no_work(tmp_path: Path):
    begin_earlier(tmp_path, 20.0)
    tomorrow = time.time() + 86_400
    os.utime(tmp_path / attempts.NAME, (tomorrow, tomorrow))
    assert attempts.spent(tmp_path) == pytest.approx(120, abs=2)


def test_after_a_restart_of_the_machine_files_alone_tell(tmp_path: Path):
    begin_earlier(tmp_path, -1e6)
    last = time.time() + 7
    os.utime(tmp_path / attempts.NAME, (last, last))
    assert attempts.spent(tmp_path) == pytest.approx(107, abs=2)
