"""The state that a finished training left, where it is not what more training can begin from."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stages.contract import StageError
from stages.train.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from stages.train.state import TrainingBudget
from tests.refusals import no_note
from tests.stages.train.one_number import run_in


def older_facts(folder: Path) -> None:
    checkpoint = latest_checkpoint(folder / "checkpoints", no_note)
    assert checkpoint is not None
    facts: dict[str, Any] = checkpoint.facts | {"of_another_version": 1}
    save_checkpoint(folder / "checkpoints", Checkpoint(checkpoint.step, checkpoint.tensors, facts))


def older_schedule(folder: Path) -> None:
    (folder / "schedule.json").write_text(json.dumps([[0, 40, 0.0, "begin", "of another version"]]))


def damaged(folder: Path) -> None:
    (folder / "checkpoints/000000040.safetensors").write_bytes(b"")


@pytest.mark.parametrize("more", [1, 20])
@pytest.mark.parametrize(
    ("change", "why"),
    [
        (older_facts, "another version of this program made the training"),
        (older_schedule, "another version of this program made the training"),
        (damaged, "cannot be read, only an earlier one"),
    ],
)
def test_more_is_refused_in_words(
    change: Callable[[Path], None], why: str, more: int, tmp_path: Path, progress: Any
) -> None:
    first = tmp_path / "first"
    run_in(first, progress).train()
    change(first)
    with pytest.raises(StageError, match=f"cannot continue training: .*{why}"):
        run_in(tmp_path / "more", progress, TrainingBudget(more, None, first))
