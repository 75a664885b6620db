import pytest

from stages.io.amounts import (
    bytes_in_words,
    counted,
    duration,
    duration_option,
    least_duration,
    rough_duration,
    short_count,
)


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


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.01, "1 s"), (40.2, "40 s"), (95.0, "2 min"), (2713.0, "45 min"), (7300.0, "2 h 2 min")]
)
def test_times_are_said_roughly(seconds: float, words: str) -> None:
    assert rough_duration(seconds) == words


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "1 s"), (40.2, "41 s"), (60.0, "1 min"), (60.4, "1 min 10 s"), (700.0, "12 min"), (3601.0, "1 h 1 min")],
)
def test_time_needed_is_rounded_up(seconds: float, words: str) -> None:
    assert least_duration(seconds) == words


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1s"), (75.3, "75s"), (180.02, "3m"), (599.7, "10m"), (754.0, "13m"), (3600.0, "1h"), (5430.0, "1h30m")],
)
def test_times_as_options(seconds: float, words: str) -> None:
    assert duration_option(seconds) == words


def test_bytes() -> None:
    assert (bytes_in_words(2**30 * 1.26), bytes_in_words(2**20 * 40)) == ("1.3 GB", "40 MB")


def test_one_thing_is_not_several() -> None:
    assert [counted(number, "test photo") for number in (0, 1, 2)] == ["0 test photos", "1 test photo", "2 test photos"]
    assert (counted(1), counted(1234)) == ("1 photo", "1,234 photos")
    assert [counted(number, "file is", "files are") for number in (1, 2)] == ["1 file is", "2 files are"]
