"""The stages in the order they run, and how they depend on each other."""

from collections.abc import Mapping
from types import ModuleType

from stages import effects, evaluate, ingest, mesh, normalise, render, report, sfm, train

STAGES: dict[str, ModuleType] = {
    "ingest": ingest,
    "sfm": sfm,
    "normalise": normalise,
    "effects": effects,
    "train": train,
    "evaluate": evaluate,
    "render": render,
    "mesh": mesh,
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
    "report": 18,
}


def needed_for(stage: str, stages: Mapping[str, ModuleType] = STAGES) -> list[str]:
    """``stage`` and everything it depends on, in order; the report is written from whatever is there."""
    if stage == "report":
        return [stage]
    wanted = {stage}
    for name in reversed(list(stages)):
        if name in wanted:
            wanted.update(stages[name].NEEDS)
    return [name for name in stages if name in wanted]


def up_to(stage: str) -> list[str]:
    """All stages from the first to ``stage``, in order."""
    names = list(STAGES)
    return names[: names.index(stage) + 1]
