"""The stages in the order they run, and how they depend on each other. A new stage is its package and one line here."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from stages import depth, effects, evaluate, ingest, mesh, normalise, render, report, sfm, tradeoff, train, viewer
from stages.contract import declared

STAGES: dict[str, ModuleType] = {
    module.__name__.rpartition(".")[2]: module
    for module in (ingest, sfm, normalise, depth, effects, train, evaluate, render, viewer, mesh, tradeoff, report)
}

SOURCE = next(iter(STAGES))
"""The stage that reads PHOTOS, which its key holds by their content."""


def is_summary(stage: str, stages: Mapping[str, ModuleType] = STAGES) -> bool:
    """Whether ``stage`` shows the whole run, from whatever is there."""
    return declared(stages[stage], "SUMMARY")


def is_on_request(stage: str) -> bool:
    """Whether ``stage`` runs only where it is named."""
    return declared(STAGES[stage], "ON_REQUEST")


def needed_for(stage: str, stages: Mapping[str, ModuleType] = STAGES) -> list[str]:
    """``stage`` and everything it depends on, in order; a summary is written from whatever is there."""
    if is_summary(stage, stages):
        return [stage]
    wanted = {stage}
    for name in reversed(list(stages)):
        if name in wanted:
            wanted.update(stages[name].INPUTS)
    return [name for name in stages if name in wanted]


def up_to(stage: str) -> list[str]:
    """All stages from the first to ``stage``, in order, of those on request only ``stage`` itself."""
    names = list(STAGES)
    return [name for name in names[: names.index(stage) + 1] if name == stage or not is_on_request(name)]


def usual() -> list[str]:
    """The stages that a run has unless it is told otherwise."""
    return up_to(list(STAGES)[-1])


def command_that_makes(stage: str, recorded: Sequence[str] | None, root: Path) -> str:
    """The command that brings ``stage`` up to date in the workspace ``root``, whose last run had the ``recorded``
    stages: that run again, or the stage's own."""
    return f"pipeline {'resume' if stage in (recorded or usual()) else stage} {root}"
