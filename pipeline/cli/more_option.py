"""``--more 10m``: the recorded options, with training going on from the end of the finished one."""

import re
from typing import Any

from pipeline.cli.durations import seconds_from
from pipeline.cli.options import UsageError
from pipeline.engine.manifest_file import BadManifest, Manifest
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import command_that_makes
from pipeline.engine.workspace import Workspace
from stages.contract import StageError
from stages.train.continuation import training_name

_STEPS = re.compile(r"(\d+) ?steps?")


def with_more(settings: Settings, workspace: Workspace, text: str) -> Settings:
    """``settings`` with so much more training on top of the finished one, or of the one that an interrupted training
    goes on from, so that the same words take that up again.

    Raises UsageError for what is no duration or for a second budget, StageError where nothing is finished.
    """
    train = settings.train
    budgets = {"steps": train.steps, "seconds": train.seconds, "preset": train.preset}
    recorded = workspace.read_run()
    for name, value in budgets.items():
        if value is not None and value != recorded.options["train"][name]:
            raise UsageError(f"--more and --train.{name} both set the training time; give one")
    key = recorded.keys.get("train")
    command = command_that_makes("train", recorded.stages, workspace.root)
    finished = None if key is None else _finished(workspace, key, command)
    after = training_name(finished.key, finished.outputs_digest) if finished else train.after
    if after is None:
        raise StageError(
            "pipeline.nothing-to-continue",
            f"cannot continue the training in {workspace.root}",
            "no training is finished there",
            f"Run this first: {command}",
        )
    return settings.model_copy(update={"train": train.model_copy(update={"after": after, **_budget(text)})})


def _budget(text: str) -> dict[str, Any]:
    if counted := _STEPS.fullmatch(text.strip()):
        if not int(counted[1]):
            raise UsageError("--more needs at least one step")
        return {"more_steps": int(counted[1]), "more_seconds": None}
    return {"more_steps": None, "more_seconds": seconds_from(text)}


def _finished(workspace: Workspace, key: str, command: str) -> Manifest | None:
    try:
        return workspace.finished("train", key)
    except BadManifest as problem:
        hint = f"It was quarantined; {command} trains again."
        raise StageError(
            "pipeline.training-damaged", f"cannot continue the training in {workspace.root}", str(problem), hint
        ) from problem
