"""A sign of life while a block runs, and none after it."""

import os
import threading
import time
from pathlib import Path

import pytest

from pipeline import heartbeat


def wait_for(file: Path, since: float) -> None:
    until = time.monotonic() + 20
    while not (file.exists() and file.stat().st_mtime > since):
        assert time.monotonic() < until, "it never beat"
        time.sleep(0.005)


def test_it_beats_while_the_block_runs_and_not_after(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "BEAT", 0.01)
    file, threads = tmp_path / heartbeat.NAME, threading.active_count()
    with heartbeat.beating(file):
        for _ in range(2):  # more than once
            wait_for(file, 5.0)
            os.utime(file, (5.0, 5.0))
    os.utime(file, (5.0, 5.0))
    time.sleep(0.05)
    assert file.stat().st_mtime == 5.0 and threading.active_count() == threads


def test_it_ends_with_an_error_and_a_short_block_does_not_wait_for_it(tmp_path: Path) -> None:
    threads, started = threading.active_count(), time.monotonic()
    with pytest.raises(KeyError), heartbeat.beating(tmp_path / heartbeat.NAME):
        raise KeyError
    assert time.monotonic() - started < heartbeat.BEAT and threading.active_count() == threads
    assert not (tmp_path / heartbeat.NAME).exists()


def test_a_place_that_cannot_be_written_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "BEAT", 0.01)
    with heartbeat.beating(tmp_path / "gone" / heartbeat.NAME):
        time.sleep(0.05)
        (tmp_path / "gone").mkdir()
        wait_for(tmp_path / "gone" / heartbeat.NAME, 0.0)
