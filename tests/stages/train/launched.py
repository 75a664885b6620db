"""The command ``pipeline`` as torchrun starts it in a test, with a training in the place of its command line:
``-m tests.stages.train.launched FOLDER``, where FOLDER holds finished stages."""

import sys
from pathlib import Path

from pipeline.__main__ import main
from pipeline.cli import commands
from tests.conftest import RecordedProgress
from tests.stages.train.test_train import trained

SETTINGS = {"field": "grid", "steps": 24, "checkpoint_seconds": 1e-9, "grid": {"micro_batches": 2}}


def train() -> None:
    """Instead of the words of a user."""
    folder = Path(sys.argv[1])
    inputs = {name: folder / name for name in ("ingest", "normalise", "effects")}
    result = trained(folder / "launched", inputs, RecordedProgress(), **SETTINGS)
    print(result.facts["ranks"]["size"], "ranks")


if __name__ == "__main__":
    commands.main = train
    main()
