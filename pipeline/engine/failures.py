"""What ends a stage, as something a user can act on."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stages.contract import Stage, StageError
from stages.io.files import read_json, write_durably

FAILURE = "failure.json"  # in a partial folder: what ended the last attempt at the stage, or at its plan


class StageFailed(Exception):
    """A stage ended with a StageError; carries both so that the caller can word it and choose the exit code."""

    def __init__(self, stage: str, error: StageError) -> None:
        super().__init__(f"{stage}: {error}")
        self.stage, self.error = stage, error


@contextmanager
def worded(stage: Stage[Any]) -> Iterator[None]:
    """Whatever a user can act on becomes a StageFailed."""
    try:
        yield
    except StageError as error:
        raise StageFailed(stage.name, error) from error
    except OSError as error:
        raise StageFailed(stage.name, _disk_error(error)) from error
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        hint = f"Close other programs, or give {stage.less_memory}." if stage.less_memory else "Close other programs."
        why = str(error).splitlines()[0] if str(error) else f"{stage.name} needs more memory than there is"
        raise StageFailed(stage.name, StageError("pipeline.out-of-memory", "out of memory", why, hint)) from error


def _is_out_of_memory(error: Exception) -> bool:
    """torch says it with a RuntimeError, on the CPU and on GPUs in different words."""
    return isinstance(error, MemoryError) or any(
        words in str(error) for words in ("not enough memory", "out of memory", "can't allocate memory")
    )


def _disk_error(error: OSError) -> StageError:
    """An OSError in words; finished stages are never touched by it."""
    what = f"cannot read or write {error.filename}" if error.filename else "a file could not be read or written"
    hint = "Free disk space or check permissions, then run again: finished stages are kept."
    return StageError("pipeline.disk", what, error.strerror or str(error), hint)


@contextmanager
def recorded(stage: Stage[Any], partial: Path) -> Iterator[None]:
    """What ``stage`` fails of, raised as StageFailed, is written into a partial folder, for ``status``; that of an
    earlier attempt goes."""
    file = partial / FAILURE
    file.unlink(missing_ok=True)
    try:
        with worded(stage):
            yield
    except StageFailed as failure:
        with suppress(OSError):  # the failure itself matters more
            partial.mkdir(parents=True, exist_ok=True)
            write_durably(file, json.dumps({"code": failure.error.code, "what": failure.error.what}).encode())
        raise


def last_failure(partial: Path) -> str | None:
    """What the last attempt at a stage failed of; None where it was interrupted."""
    try:
        return str(read_json(partial / FAILURE)["what"])
    except (StageError, KeyError, TypeError):
        return None
