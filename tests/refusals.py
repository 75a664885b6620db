"""Errors and notes told by their codes: how they are worded is no matter of the tests that meet them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from pipeline.engine.failures import StageFailed
from stages.contract import Note, StageError


def error_of(caught: pytest.ExceptionInfo[Any]) -> StageError:
    """The StageError that was raised, by itself or as the end of a stage."""
    error = caught.value.error if isinstance(caught.value, StageFailed) else caught.value
    assert isinstance(error, StageError)
    return error


@contextmanager
def refused(code: str, *values: object) -> Iterator[pytest.ExceptionInfo[Any]]:
    """The block ends with the StageError of this code, whose sentences name all the ``values``."""
    with pytest.raises((StageError, StageFailed)) as caught:
        yield caught
    error = error_of(caught)
    assert error.code == code, str(error)
    said = f"{error.what}\n{error.why}\n{error.hint}"
    assert [value for value in values if str(value) not in said] == [], said


def codes(notes: Iterable[Note]) -> list[str]:
    """Of each note its code."""
    return [note.code for note in notes]


def no_note(code: str, text: str) -> None:
    """A ``note`` of a test in which there is nothing to say."""
    pytest.fail(f"{code}: {text}")


def unheard(code: str, text: str) -> None:
    """A ``note`` of a test that is about other things."""
