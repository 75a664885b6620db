"""The stages in the order they run, and how they depend on each other. A new stage is its package and one line here."""

from collections.abc import Mapping, Sequence
from pathlib import Path

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
from stages.contract import Stage, StageConfig

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        ingest.STAGE,
        sfm.STAGE,
        normalise.STAGE,
        scale.STAGE,
        depth.STAGE,
        effects.STAGE,
        train.STAGE,
        evaluate.STAGE,
        render.STAGE,
        mesh.STAGE,
        viewer.STAGE,
        tradeoff.STAGE,
        report.STAGE,
    )
}

SOURCE = next(iter(STAGES))
"""The stage that reads PHOTOS, which its key holds by their content."""


def needed_for(stage: str, options: Mapping[str, StageConfig], stages: Mapping[str, Stage] = STAGES) -> list[str]:
    """``stage`` and everything it depends on under these ``options`` of each stage, in order; a summary is written from
    whatever is there."""
    if stages[stage].summary:
        return [stage]
    wanted = {stage}
    for name in reversed(list(stages)):
        if name in wanted:
            wanted.update(stages[name].inputs_of(options[name]))
    return [name for name in stages if name in wanted]


def up_to(stage: str, options: Mapping[str, StageConfig] | None = None) -> list[str]:
    """All stages from the first to ``stage``, in order; of those on request only ``stage`` itself and what the others
    read by their ``options``."""
    names = list(STAGES)
    asked = [name for name in names[: names.index(stage) + 1] if name == stage or not STAGES[name].on_request]
    read = {one for name in asked if options for one in STAGES[name].more_inputs(options[name])}
    return [name for name in names if name in asked or name in read]


def usual() -> list[str]:
    """The stages that a run has unless it is told otherwise."""
    return up_to(list(STAGES)[-1])


def command_that_makes(stage: str, recorded: Sequence[str] | None, root: Path) -> str:
    """The command that brings ``stage`` up to date in the workspace ``root``, whose last run had the ``recorded``
    stages: that run again, or the stage's own."""
    return f"pipeline {'resume' if stage in (recorded or usual()) else stage} {root}"
