import time

import pytest

from stages.live_line import duration, live_line, short_count


def test_it_speaks_while_the_block_is_busy_and_once_more_at_the_end(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.live_line.PERIOD_SECONDS", 0.01)
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


@pytest.mark.parametrize(
    ("count", "text"),
    [(7, "7"), (950, "950"), (9_400, "9.4 k"), (24_000, "24 k"), (999_000, "999 k"), (2_400_000, "2.4 M")],
)
def test_short_counts(count: float, text: str) -> None:
    assert short_count(count) == text


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.04, "0 s"),
        (0.42, "0.4 s"),
        (3.0, "3 s"),
        (9.96, "10 s"),
        (58.4, "58 s"),
        (59.7, "1 min"),
        (61.2, "1 min 1 s"),
        (200, "3 min 20 s"),
        (3599.6, "1 h"),
        (3900, "1 h 5 min"),
    ],
)
def test_durations(seconds: float, words: str):
    assert duration(seconds) == words
