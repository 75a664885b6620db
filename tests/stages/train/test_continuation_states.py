"""The state that a finished training left, where it is not what more training can begin from."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stages.train.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from stages.train.state import TrainingBudget
from tests.refusals import no_note, refused
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
    ("change", "code"),
    [(older_facts, "other-version"), (older_schedule, "other-version"), (damaged, "earlier-state")],
)
def test_more_is_refused_in_words(
    change: Callable[[Path], None], code: str, more: int, tmp_path: Path, progress: Any
) -> None:
    first = tmp_path / "first"
    run_in(first, progress).train()
    change(first)
    with refused(f"train.{code}"):
        run_in(tmp_path / "more", progress, TrainingBudget(more, None, first))
