"""The stages in the order they run, and how they depend on each other. A new stage is its package and one line here."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from stages import (
    depth,
    effects,
    evaluate,
    ingest,
    mesh,
    normalise,
    render,
    report,
    scale,
    sfm,
    tradeoff,
    train,
    viewer,
)
from stages.contract import StageConfig, declared, inputs_of

STAGES: dict[str, ModuleType] = {
    module.__name__.rpartition(".")[2]: module
    for module in (
        ingest,
        sfm,
        normalise,
        scale,
        depth,
        effects,
        train,
        evaluate,
        render,
        mesh,
        viewer,
        tradeoff,
        report,
    )
}

SOURCE = next(iter(STAGES))
"""The stage that reads PHOTOS, which its key holds by their content."""


def is_summary(stage: str, stages: Mapping[str, ModuleType] = STAGES) -> bool:
    """Whether ``stage`` shows the whole run, from whatever is there."""
    return declared(stages[stage], "SUMMARY")


def is_on_request(stage: str) -> bool:
    """Whether ``stage`` runs only where it is named."""
    return declared(STAGES[stage], "ON_REQUEST")


def needed_for(stage: str, options: Mapping[str, StageConfig], stages: Mapping[str, ModuleType] = STAGES) -> list[str]:
    """``stage`` and everything it depends on under these ``options`` of each stage, in order; a summary is written from
    whatever is there."""
    if is_summary(stage, stages):
        return [stage]
    wanted = {stage}
    for name in reversed(list(stages)):
        if name in wanted:
            wanted.update(inputs_of(stages[name], options[name]))
    return [name for name in stages if name in wanted]


def up_to(stage: str, options: Mapping[str, StageConfig] | None = None) -> list[str]:
    """All stages from the first to ``stage``, in order; of those on request only ``stage`` itself and what the others
    read by their ``options``."""
    names = list(STAGES)
    asked = [name for name in names[: names.index(stage) + 1] if name == stage or not is_on_request(name)]
    read = {one for name in asked if options for one in declared(STAGES[name], "more_inputs")(options[name])}
    return [name for name in names if name in asked or name in read]


def usual() -> list[str]:
    """The stages that a run has unless it is told otherwise."""
    return up_to(list(STAGES)[-1])


def command_that_makes(stage: str, recorded: Sequence[str] | None, root: Path) -> str:
    """The command that brings ``stage`` up to date in the workspace ``root``, whose last run had the ``recorded``
    stages: that run again, or the stage's own."""
    return f"pipeline {'resume' if stage in (recorded or usual()) else stage} {root}"
