import time

import pytest

from stages.io.live_line import live_line


def test_it_speaks_while_busy_and_at_the_end(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.io.live_line.PERIOD_SECONDS", 0.01)
    with live_line(progress, lambda: ("working", 0.5)):
        deadline = time.monotonic() + 5
        while not progress.updates and time.monotonic() < deadline:
            time.sleep(0.01)
        spoken = len(progress.updates)
    assert spoken > 0
    assert len(progress.updates) > spoken
    assert set(progress.updates) == {("working", 0.5)}


def test_an_error_in_the_block_gets_out_and_silences_it(progress) -> None:
    with pytest.raises(KeyError), live_line(progress, lambda: ("working", None)):
        raise KeyError("x")
    spoken = len(progress.updates)
    assert spoken == 1
