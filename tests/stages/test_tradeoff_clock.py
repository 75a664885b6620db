import time
from pathlib import Path

import pytest

from stages import tradeoff_clock
from stages.files import read_json


def test_the_seconds_of_earlier_attempts_count(tmp_path: Path) -> None:
    file = tmp_path / "clock.json"
    with pytest.raises(KeyboardInterrupt), tradeoff_clock.counted(file):
        time.sleep(0.1)
        raise KeyboardInterrupt
    with tradeoff_clock.counted(file) as spent:
        assert 0.1 <= spent() < 5
        time.sleep(0.1)
    assert 0.2 <= read_json(file) < 5


def test_what_is_counted_is_kept_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff_clock, "BEAT", 0.02)
    file = tmp_path / "clock.json"
    with tradeoff_clock.counted(file):
        deadline = time.monotonic() + 10
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert 0 < read_json(file) < 10, "a kill now would lose no more than a beat"
