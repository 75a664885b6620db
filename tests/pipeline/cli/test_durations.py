"""Durations as people write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cli.durations import seconds_from
from pipeline.cli.options import UsageError
from stages.io.amounts import duration_option


@given(st.integers(0, 99), st.integers(0, 59), st.integers(0, 59))
def test_parts_add_up(hours: int, minutes: int, seconds: int):
    written = "".join(f"{n}{unit}" for n, unit in ((hours, "h"), (minutes, "m"), (seconds, "s")) if n)
    if written:
        assert seconds_from(written) == 3600 * hours + 60 * minutes + seconds


@given(st.floats(0.5, 1e6))
def test_what_is_proposed_can_be_given(seconds: float):
    assert seconds_from(duration_option(seconds)) == pytest.approx(seconds, abs=0.5 if seconds < 599 else 30.5)


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("10m", 600), ("1h30m", 5400), ("2.5m", 150), (" 0.5S ", 0.5), ("1h1s", 3601)]
)
def test_examples(text: str, seconds: float):
    assert seconds_from(text) == seconds


@pytest.mark.parametrize("text", ["", "10", "10 m", "m", "-5m", "30m1h", "1h2h", "5x", "1e3s", "inf", "nans", ".5m"])
def test_what_is_no_duration_is_refused_with_examples(text: str):
    with pytest.raises(UsageError, match=r"not a duration; write it like 90s, 10m or 1h30m"):
        seconds_from(text)


@pytest.mark.parametrize("text", ["0s", "0h0m", "0.0m"])
def test_no_time_is_refused(text: str):
    with pytest.raises(UsageError, match="not above 0"):
        seconds_from(text)
