import os
import time
from pathlib import Path

import pytest

from pipeline import attempts


def test_nothing_was_spent_where_nobody_began(tmp_path: Path):
    assert attempts.spent(tmp_path / "none.partial") == 0
    (tmp_path / attempts.NAME).write_text("{")
    assert attempts.spent(tmp_path) == 0


def test_an_attempt_lasts_until_its_last_sign_of_life(tmp_path: Path):
    attempts.begin(tmp_path, 100.0)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/checkpoint").write_text("x")
    last = time.time() + 7
    os.utime(tmp_path / "deep/checkpoint", (last, last))
    assert attempts.spent(tmp_path) == pytest.approx(107, abs=2)


def test_a_clock_that_was_set_back_takes_nothing_away(tmp_path: Path):
    attempts.begin(tmp_path, 100.0)
    os.utime(tmp_path / attempts.NAME, (0, 0))
    assert attempts.spent(tmp_path) == 100
