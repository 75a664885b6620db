import os
import time
from pathlib import Path

import pytest

from stages.io import stopwatch
from stages.io.files import read_json
from stages.io.stopwatch import elapsed, live_line, write_elapsed


def test_the_seconds_of_earlier_attempts_count(tmp_path: Path) -> None:
    file = tmp_path / "clock.json"
    with pytest.raises(KeyboardInterrupt), stopwatch.counting(file):
        time.sleep(0.1)
        raise KeyboardInterrupt
    with stopwatch.counting(file) as spent:
        assert 0.1 <= spent() < 5
        time.sleep(0.1)
    assert 0.2 <= read_json(file) < 5


def test_what_is_counted_is_kept_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopwatch, "BEAT", 0.02)
    file = tmp_path / "clock.json"
    with stopwatch.counting(file):
        deadline = time.monotonic() + 10
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert 0 < read_json(file) < 10, "a kill now would lose no more than a beat"
    file.unlink()
    time.sleep(0.05)
    assert not file.exists(), "not once after the block"


def test_kept_time_counts_whatever_file_times_say(tmp_path: Path) -> None:
    file = tmp_path / "clock.json"
    write_elapsed(file, 100.0)
    for day in (0.0, time.time() + 86_400):
        os.utime(file, (day, day))
        with stopwatch.counting(file) as spent:
            assert 100 <= spent() < 105
    assert 100 <= elapsed(file) < 105


@pytest.mark.parametrize("content", [b"", b"{", b'{"spent": 1.0}', b"null", b"-3"])
def test_nothing_is_spent_without_a_start_or_number(tmp_path: Path, content: bytes) -> None:
    assert elapsed(tmp_path / "none.partial/attempts.json") == 0
    (tmp_path / "attempts.json").write_bytes(content)
    assert elapsed(tmp_path / "attempts.json") == 0


def test_a_place_that_cannot_be_written_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopwatch, "BEAT", 0.01)
    with stopwatch.counting(tmp_path / "gone/clock.json") as spent:
        time.sleep(0.05)
        assert spent() > 0.04


def test_a_live_line_speaks_while_busy_and_at_the_end(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.io.stopwatch.LIVE_PERIOD", 0.01)
    with live_line(progress, lambda: ("working", 0.5)):
        deadline = time.monotonic() + 5
        while not progress.updates and time.monotonic() < deadline:
            time.sleep(0.01)
        spoken = len(progress.updates)
    assert spoken > 0
    assert len(progress.updates) > spoken
    assert set(progress.updates) == {("working", 0.5)}


def test_an_error_gets_out_and_silences_the_live_line(progress) -> None:
    with pytest.raises(KeyError), live_line(progress, lambda: ("working", None)):
        raise KeyError("x")
    spoken = len(progress.updates)
    assert spoken == 1
