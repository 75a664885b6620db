"""What is cached, stale, half done or never run, and why a stage would run; reads only, runs nothing."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.engine import manifest_file
from pipeline.engine.failures import last_failure
from pipeline.engine.job import Job, NotReady
from pipeline.engine.manifest_file import BadManifest, Manifest
from pipeline.engine.runner import Runner
from pipeline.engine.stage_list import STAGES, command_that_makes
from pipeline.engine.workspace import Workspace
from stages.contract import KEY_LENGTH, StageError


@dataclass(frozen=True)
class StageStatus:
    """``state``: cached / stale / damaged / partial / failed / never; ``text``: its summary or the reason."""

    stage: str
    state: str
    text: str


def last_result(workspace: Workspace, runner: Runner, stage: str) -> Manifest | None:
    """The result run.json points to, or else the newest finished one of any key."""
    known = runner.run_file.keys.get(stage)
    folders = [workspace.folder(stage, known)] if known else []
    if (workspace.root / stage).is_dir():
        others = (p for p in (workspace.root / stage).iterdir() if len(p.name) == KEY_LENGTH)
        folders += sorted(others, key=lambda p: p.stat().st_mtime, reverse=True)
    for folder in folders:
        try:
            return manifest_file.read(folder)
        except (FileNotFoundError, BadManifest):
            continue
    return None


def status_of(workspace: Workspace, runner: Runner, stage: str, deep: bool = False) -> StageStatus:
    """How ``stage`` stands for the recorded options; ``deep``: its files are read and compared with their sha256."""
    last = last_result(workspace, runner, stage)
    command = command_that_makes(stage, runner.run_file.stages, workspace.root)
    try:
        job = runner.resolve(stage, may_plan=False)
    except NotReady as waiting:
        reason = f"waits for {waiting.upstream}"
        if waiting.upstream == stage:
            if failure := last_failure(workspace.partial(stage, waiting.asked)):
                return StageStatus(stage, "failed", f"{failure}; `{command}` tries again")
            reason = _why_unplanned(runner, stage, last) if last else ""
        return StageStatus(stage, "stale" if last else "never", reason)
    except StageError as error:
        return StageStatus(stage, "stale" if last else "never", f"{error.what}: {error.why}")
    folder = workspace.folder(stage, job.key)
    try:
        manifest = manifest_file.read(folder)
        manifest_file.check_outputs(folder, manifest, deep)
        return StageStatus(stage, "cached", manifest.line)
    except FileNotFoundError:
        pass
    except BadManifest as problem:
        return StageStatus(stage, "damaged", f"{problem}; `{command} --verify` rebuilds it")
    if workspace.partial(stage, job.key).exists():
        if process := workspace.running():
            return StageStatus(stage, "partial", f"process {process} is running in this workspace")
        if failure := last_failure(workspace.partial(stage, job.key)):
            return StageStatus(stage, "failed", f"{failure}; `{command}` tries again")
        return StageStatus(stage, "partial", f"interrupted; `{command}` resumes it")
    if last is not None:
        return StageStatus(stage, "stale", "; ".join(differences(job, last)) or "run again")
    return StageStatus(stage, "never", "")


def _why_unplanned(runner: Runner, stage: str, last: Manifest) -> str:
    """Why a stage whose inputs are there has not the result it needs, while its open options are not chosen yet."""
    read, options = STAGES[stage].inputs_of(runner.options[stage]), runner.options[stage]
    inputs = {name: runner.done[name].outputs_digest for name in read if name in runner.done}
    given = options.model_dump(mode="json", exclude={*STAGES[stage].not_hashed}, exclude_none=True)
    changed = [f"{stage}.{change}" for change in _changes(given, last.config)]
    return "; ".join([*changed, *_other_inputs(inputs, last)]) or "its automatic options are chosen again"


def _other_inputs(now: dict[str, str], last: Manifest) -> list[str]:
    changed = (name for name in sorted({*now, *last.inputs}) if now.get(name) != last.inputs.get(name))
    return [f"{name} has another result" for name in changed]


def differences(job: Job, last: Manifest) -> list[str]:
    """Which part of the key changed between the last result and now."""
    found = []
    if last.version != job.stage.version:
        found.append(f"the program has changed (version {last.version} → {job.stage.version} of this stage)")
    now: dict[str, Any] = job.config.model_dump(mode="json", exclude=set(job.stage.not_hashed))
    found += [f"{job.stage.name}.{change}" for change in _changes(now, last.config)]
    found += _other_inputs(job.inputs, last)
    if not found and last.key != job.key:
        found.append("the photos or a file in its options have changed")
    return found


def _changes(now: Mapping[str, Any], before: Mapping[str, Any]) -> Iterator[str]:
    """Which options have another value ``now`` than ``before``, where both know them."""
    for name in sorted(now.keys() & before.keys()):
        values = now[name], before[name]
        if all(isinstance(value, dict) for value in values):
            yield from (f"{name}.{change}" for change in _changes(*values))
        elif values[0] != values[1]:
            new, old = ("given" if isinstance(value, dict) else value for value in values)
            yield f"{name}: {old} → {new}"


def explain(workspace: Workspace, runner: Runner, stage: str) -> list[str]:
    """Lines that say whether ``stage`` would run, and which part of its key makes it."""
    status = status_of(workspace, runner, stage)
    lines = [f"{stage}: {status.state}" + (f" · {status.text}" if status.text else "")]
    try:
        job = runner.resolve(stage, may_plan=False)
    except NotReady as waiting:
        unknown = "its automatic options are chosen" if waiting.upstream == stage else f"{waiting.upstream} has run"
        return [*lines, f"It would run, unless a finished result has its key, which is known when {unknown}."]
    except StageError:
        return lines
    last = last_result(workspace, runner, stage)
    if status.state == "cached":
        lines.append("It would not run: a finished result has this key.")
    elif last is None:
        lines.append("It would run: it has never finished in this workspace.")
    else:
        lines += ["It would run because:", *(f"  {reason}" for reason in differences(job, last))]
    lines.append(f"key {job.key[:KEY_LENGTH]} = version {job.stage.version}")
    lines += [f"  config {name} = {value}" for name, value in sorted(job.key_config.items())]
    lines += [f"  input  {name} = {value[:KEY_LENGTH]}" for name, value in sorted(job.inputs.items())]
    return lines


def next_step(statuses: Sequence[StageStatus], recorded: Sequence[str] | None, root: Path) -> str | None:
    """The command that brings more of the workspace ``root`` up to date, whose last run had the ``recorded`` stages,
    and what it does; None where all that belongs to a whole run is up to date."""
    usual = [name for name, stage in STAGES.items() if not stage.on_request]
    outdated = {one.stage: one.state for one in statuses if one.state != "cached"}
    if again := [name for name in outdated if name in (recorded or usual)]:
        verify = " --verify" if "damaged" in map(outdated.get, again) else ""
        return f"`pipeline resume {root}{verify}` brings {', '.join(again)} up to date"
    if later := [name for name in outdated if name in usual]:
        return f"`{command_that_makes(later[0], recorded, root)}` continues where the last run ended"
    return None


def all_statuses(workspace: Workspace, runner: Runner, deep: bool) -> list[StageStatus]:
    """Every stage of the chain, in order."""
    return [status_of(workspace, runner, stage, deep) for stage in STAGES]
