"""The stages in the order they run, and how they depend on each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from stages import effects, evaluate, ingest, mesh, normalise, render, report, sfm, tradeoff, train

STAGES: dict[str, ModuleType] = {
    "ingest": ingest,
    "sfm": sfm,
    "normalise": normalise,
    "effects": effects,
    "train": train,
    "evaluate": evaluate,
    "render": render,
    "mesh": mesh,
    "tradeoff": tradeoff,
    "report": report,
}

EXIT_CODES = {
    "ingest": 10,
    "sfm": 11,
    "normalise": 12,
    "effects": 13,
    "train": 14,
    "evaluate": 15,
    "render": 16,
    "mesh": 17,
    "tradeoff": 19,
    "report": 18,
}

ON_REQUEST = ("tradeoff",)
"""Stages that take long and that nothing needs: they run where they are named."""


def needed_for(stage: str, stages: Mapping[str, ModuleType] = STAGES) -> list[str]:
    """``stage`` and everything it depends on, in order; the report is written from whatever is there."""
    if stage == "report":
        return [stage]
    wanted = {stage}
    for name in reversed(list(stages)):
        if name in wanted:
            wanted.update(stages[name].INPUTS)
    return [name for name in stages if name in wanted]


def up_to(stage: str) -> list[str]:
    """All stages from the first to ``stage``, in order, of those ON_REQUEST only ``stage`` itself."""
    names = list(STAGES)
    return [name for name in names[: names.index(stage) + 1] if name == stage or name not in ON_REQUEST]


def usual() -> list[str]:
    """The stages that a run has unless it is told otherwise."""
    return up_to(list(STAGES)[-1])


def command_that_makes(stage: str, recorded: Sequence[str] | None, root: Path) -> str:
    """The command that brings ``stage`` up to date in the workspace ``root``, whose last run had the ``recorded``
    stages: that run again, or the stage's own."""
    return f"pipeline {'resume' if stage in (recorded or usual()) else stage} {root}"
