"""The command line: finds the command, runs it, turns every ending into words and an exit code."""

import io
import json
import os
import re
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from pipeline.cli import arguments, exit_codes
from pipeline.cli.durations import seconds_from
from pipeline.cli.more_option import with_more
from pipeline.cli.options import (
    UsageError,
    check_fitted_poses,
    check_same_photos,
    check_workspace,
    read_toml,
    settings_from,
    with_effects,
    with_lasting_files,
    with_source,
)
from pipeline.cli.signals import Terminated, end_soon, go_on, heed_signals
from pipeline.cli.terminal import Unread, choose_display, open_closed_streams
from pipeline.engine import machine, stage_list, status
from pipeline.engine.display import Display, SilentDisplay
from pipeline.engine.failures import StageFailed
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.workspace import RUN_FILE, Workspace, default_workspace
from pipeline.view import check_installed, open_browser, serve_during
from stages.contract import StageError
from stages.hardware import cluster
from stages.hardware.ranks import launched
from stages.io.amounts import counted, duration

MAX_PORT = 65535
REPORT_IT = "Finished stages are kept. Please report it with the output of the same command and --debug."


def main() -> None:
    """One command line, from ``sys.argv``. That nobody reads its words to the end (`pipeline … | head`) is no error;
    nor are letters that the terminal does not have."""
    code: int | str | None = 0
    open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            code = run_command(sys.argv[1:])
        except SystemExit as ending:  # of a help text
            code = ending.code
        if code in (exit_codes.INTERRUPT, exit_codes.TERMINATED):
            end_soon(code)
        sys.stdout.flush()
    except BrokenPipeError:
        Unread(sys.stdout).leave()
    sys.exit(code)


def run_command(words: Sequence[str]) -> int:
    """Run one command line and return its exit code; errors are said on the way."""
    if not words or words[0] in ("-h", "--help"):
        print(arguments.overview(list(stage_list.STAGES)))
        return 0 if words else exit_codes.USAGE
    if words[0] == "--version":
        print(machine.versions(("pipeline-nerf",))["pipeline-nerf"])
        return 0
    debug, as_json = "--debug" in words, "--json" in words
    heed_signals()
    try:
        return _command(words[0])(words[1:])
    except UsageError as error:
        _say("pipeline.usage", str(error), "", "", as_json)
        return exit_codes.USAGE
    except StageFailed as failure:
        if debug:
            traceback.print_exc()
        return exit_codes.of_stage(failure.stage)
    except StageError as error:
        if debug:
            traceback.print_exc()
        _say(error.code, error.what, error.why, error.hint, as_json)
        return exit_codes.WORKSPACE
    except KeyboardInterrupt:
        _say("pipeline.interrupted", "stopped", "Ctrl-C", go_on(words), as_json)
        return exit_codes.INTERRUPT
    except Terminated:
        _say("pipeline.terminated", "stopped", "SIGTERM", go_on(words), as_json)
        return exit_codes.TERMINATED
    except BrokenPipeError:
        raise
    except Exception as error:
        if debug:
            traceback.print_exc()
        what = f"a bug in this program, not a problem with your photos: {type(error).__name__}: {error}"
        _say("pipeline.defect", what, "this should never happen", REPORT_IT, as_json)
        return exit_codes.DEFECT


def _say(code: str, what: str, why: str, hint: str, as_json: bool) -> None:
    """What ended the program outside of any stage, in words, or as an event like that of a stage that failed."""
    if as_json:
        event = {"event": "error", "stage": None, "code": code, "what": what, "why": why, "hint": hint}
        print(json.dumps(event), flush=True)
        return
    reason = f"\n  why: {why}\n  try: {hint}" if why else ""
    errors = Unread(sys.stderr)  # where nobody reads along, the exit code still tells
    print(f"pipeline: {what}{reason}", file=errors)
    errors.leave()


def _command(name: str) -> Callable[[Sequence[str]], int]:
    commands: dict[str, Callable[[Sequence[str]], int]] = {
        "run": command_run,
        "batch": command_batch,
        "resume": command_resume,
        "view": command_view,
        "status": command_status,
        "explain": command_explain,
        "clean": command_clean,
        "doctor": command_doctor,
        "demo": command_demo,
    }
    if name in commands:
        return commands[name]
    if name in stage_list.STAGES:
        return lambda words: command_stage(name, words)
    raise UsageError(f"no command {name!r}; there are: {', '.join([*commands, *stage_list.STAGES])}")


def command_run(words: Sequence[str]) -> int:
    """``pipeline run PHOTOS``: the whole chain, or a part of it."""
    given = arguments.parse(arguments.RunArguments, "run", words)
    settings = given.settings
    if given.more is not None and given.config is not None:
        what = f"--more uses the recorded options, not those of --config {given.config}"
        raise UsageError(f"{what}; leave out --config, and give the changes as flags")
    file = {} if given.config is None else read_toml(given.config)
    if given.config is not None:  # flags win over it
        settings = arguments.with_flags(settings_from(file, f"--config {given.config}"), settings, "run", words)
    root, cameras = given.output or default_workspace(given.photos), given.cameras
    check_workspace(root, given.photos)
    if given.output is None:
        check_same_photos(Workspace(root), given.photos)
    if given.more is not None:
        recorded = _recorded_settings(Workspace.existing(root))
        settings = arguments.with_flags(recorded, settings, "run", words)
        cameras = cameras or recorded.ingest.cameras
    asked = _matching_exposure(with_effects(_more(settings, given.more, root), given.effect), given.match_exposure)
    asked = _keeping_studies(asked, root, words, file)
    stages = stage_list.up_to(_known_stage(given.until or list(stage_list.STAGES)[-1], "--until"), dict(asked))
    force = frozenset[str]()
    if given.from_ is not None:
        if given.from_ in stage_list.usual() and given.from_ not in stages:
            raise UsageError(f"--from {given.from_} and --until {given.until}: the run ends before that stage")
        force = frozenset(stages[stages.index(_known_stage(given.from_, "--from", stages)) :])
    budget = _budget(given.budget, asked)
    _check_budget(budget, stages, given.until, root)
    with choose_display(given.common.json) as display:
        try:
            asked = with_source(asked, given.photos, cameras)
        except StageError as error:
            display.failed(stage_list.SOURCE, error)
            return exit_codes.of_stage(stage_list.SOURCE)
        new_budget = None if given.more is not None else (budget, 0.0)
        with _watched(root, given.view, display):
            return _run_stages(root, asked, stages, given.common, display, force, new_budget=new_budget)


def command_batch(words: Sequence[str]) -> int:
    """``pipeline batch SCENES``: a run for each scene in a folder."""
    if words and words[0].startswith("-") and not {"-h", "--help"} & {*words}:
        raise UsageError(f"give the folder of scenes first: pipeline batch SCENES {' '.join(words[:2])} …")
    if launched().size > 1:
        raise UsageError("batch starts a process for each scene, which torchrun knows nothing of; give --train.devices")
    given = arguments.parse(arguments.BatchArguments, "batch", words)
    settings = given.settings
    if given.config is not None:
        file = settings_from(read_toml(given.config), f"--config {given.config}")
        settings = arguments.with_flags(file, settings, "batch", words)
    settings = with_effects(settings, given.effect)
    budget = _budget(given.budget, settings)
    last = _known_stage(given.until or list(stage_list.STAGES)[-1], "--until")
    _check_budget(budget, stage_list.up_to(last, dict(settings)), given.until, "WORKSPACE")
    check_fitted_poses(settings)
    from pipeline.batch import Batch, other_folder, run_batch
    from pipeline.batch.scenes import find_scenes

    folder = given.output or Path.cwd() / f"{given.scenes.absolute().name}.batch"
    if given.output is None and (other := other_folder(folder, given.scenes)):
        raise UsageError(f"{folder.name} was made from {other}, not from {given.scenes}; give another folder with -o")
    scenes, address = given.scenes, given.common.cluster
    if address is not None:
        scenes, folder = scenes.absolute(), folder.absolute()  # machines of a cluster work in folders of their own
    batch = Batch(scenes, find_scenes(scenes), folder, _options_of_each(words[1:]), budget, address)
    with choose_display(given.common.json) as display:
        return exit_codes.BATCH if run_batch(batch, display) else 0


def _options_of_each(words: Sequence[str]) -> list[str]:
    """The options of a batch's command line that each of its runs is given: not those that are the batch's own."""
    own, each = ("-o", "--output", "--budget", "--cluster"), list[str]()
    rest = iter(words)
    for word in rest:
        if word in own:
            next(rest, None)
        elif word != "--json" and word.partition("=")[0] not in own and not re.match("-o[^-]", word):
            each.append(word)
    return each


def _check_budget(budget: float | None, stages: Sequence[str], until: str | None, root: Path | str) -> None:
    """Raises UsageError where a ``budget`` is given for ``stages`` that none covers."""
    if budget is not None and (studies := [stage for stage in stages if stage_list.STAGES[stage].on_request]):
        stage = studies[0]
        what = f"no budget covers {stage}, which has its own time limit (--{stage}.seconds)"
        if stage != until:
            raise UsageError(f"--budget and --train.depth: {what}; give --train.seconds in place of --budget")
        raise UsageError(f"--budget and --until {stage}: {what}; run first, then `pipeline {stage} {root}`")


def _keeping_studies(settings: Settings, root: Path, words: Sequence[str], file: Collection[str] = ()) -> Settings:
    """The settings with the recorded options of the stages on request but those that the command's ``words`` or tables
    of the ``file`` of --config name: a run that does not ask for them leaves what they found where it is."""
    studies = [name for name, stage in stage_list.STAGES.items() if stage.on_request]
    named = {*file, *(stage for stage in studies if any(word.startswith(f"--{stage}.") for word in words))}
    if not os.path.isfile(root / RUN_FILE):
        return settings
    options = Workspace(root).read_run().options
    recorded = {stage: options[stage] for stage in studies if stage in options and stage not in named}
    try:
        kept = settings_from(recorded, f"options recorded in {root}")
    except UsageError:  # of another version of this program, which finds nothing by them anyway
        return settings
    return settings.model_copy(update={stage: getattr(kept, stage) for stage in recorded})


def _budget(text: str | None, settings: Settings) -> float | None:
    """The seconds of ``--budget``. Raises UsageError beside steps, which take as long as they take, and ``--more``."""
    if text is not None and settings.train.after is not None:
        raise UsageError("--budget and --more both limit the time; give one")
    if text is not None and settings.train.steps is not None:
        what = f"--budget {text} and --train.steps {settings.train.steps}: a number of steps cannot keep a budget"
        raise UsageError(f"{what}; leave out one, or give --train.seconds")
    return None if text is None else seconds_from(text)


def _more(settings: Settings, more: str | None, root: Path) -> Settings:
    """The settings with ``--more``, where it is given."""
    return settings if more is None else with_more(settings, Workspace.existing(root), more)


def _matching_exposure(settings: Settings, photo: str | None) -> Settings:
    """The settings with ``--match-exposure PHOTO``."""
    if photo is None:
        return settings
    return settings.model_copy(update={"render": settings.render.model_copy(update={"match_exposure": photo})})


def _known_stage(name: str, flag: str, among: Sequence[str] = tuple(stage_list.STAGES)) -> str:
    if name not in among:
        raise UsageError(f"{flag} {name}: not one of {', '.join(among)}")
    return name


def _run_stages(
    root: Path,
    settings: Settings,
    stages: Sequence[str],
    common: arguments.Common,
    display: Display,
    force: frozenset[str] = frozenset(),
    alone: str | None = None,
    new_budget: tuple[float | None, float] | None = None,
) -> int:
    """``alone``: the one stage that the command is for, whose stages are no run to repeat; None for a run.
    ``new_budget``: seconds for the whole command (None: no limit), and those spent before; None: as recorded."""
    if "evaluate" in stages:
        check_fitted_poses(settings)
    settings = with_lasting_files(settings, root)
    if common.cluster is not None:
        root = root.absolute()  # machines of a cluster work in folders of their own
    with Workspace(root) as workspace, cluster.joined(common.cluster, [root]):
        runner = Runner(workspace, settings, display)
        shown = (name for name in runner.run_file.keys if stage_list.STAGES[name].summary and name not in stages)
        stages = [*stages, *shown]  # a report that exists goes with what it shows
        if new_budget is not None:
            runner.budget.set_total(*new_budget)
        replan = (stages if alone is None else (alone,)) if common.replan else ()
        again = force | (runner.run_file.plans.keys() & replan)
        forecast = runner.forecast(stages, again)
        display.headline(" · ".join([machine.headline(root), *cluster.described(), *forecast.messages]))
        try:
            given = {"force": force, "replan": replan, "remember": alone is None, "verify": common.verify}
            ran = runner.run(stages, times=forecast.times, **given)
        except StageFailed as failure:
            display.failed(failure.stage, failure.error)
            raise
        words = _closing_words(runner, stages, ran, alone)
        if runner.budget.charged and alone is None and (account := runner.budget.account):
            words = f"{duration(account.seconds_spent)} of {duration(account.total)} spent {words}"
        display.finished(words, _outputs(workspace))
    return 0


def _outputs(workspace: Workspace) -> dict[str, Path]:
    folder = workspace.root / "output"
    return {path.name: path for path in sorted(folder.iterdir())} if folder.is_dir() else {}


def _closing_words(runner: Runner, stages: Sequence[str], ran: bool, alone: str | None) -> str:
    """That there was nothing to do, the next command where the user might miss it, and what there is to look at."""
    workspace, words = runner.workspace, list[str]()
    if not ran or alone is not None:
        statuses = status.all_statuses(workspace, runner, deep=False)
        step = status.next_step(statuses, runner.run_file.stages, workspace.root)
        last = [name for name in stages if not stage_list.STAGES[name].summary][-1:]
        what = "everything" if step is None else alone or f"all up to {last[0]}"
        words = [*([] if ran else [f"nothing to do: {what} is up to date"]), *([step] if step else [])]
    found = _outputs(workspace)
    named = [str(found[name]) for name in ("report.html", "viewer.html", "mesh.glb", "video.mp4") if name in found]
    return f"{'; '.join(words)} → {'  '.join(named) or workspace.root}".lstrip()


def command_stage(stage: str, words: Sequence[str]) -> int:
    """``pipeline STAGE WORKSPACE``: bring one stage, what it needs, and the report if there is one, up to date."""
    given = arguments.parse(arguments.StageArguments, stage, words)
    workspace = Workspace.existing(given.workspace)
    settings = arguments.with_flags(_recorded_settings(workspace), given.settings, stage, words)
    for flag in ("cameras", "match_exposure"):
        if getattr(given, flag) is not None and stage != "render":
            option = flag.replace("_", "-")
            raise UsageError(f"--{option} belongs to `pipeline render` and `pipeline run`, not to {stage}")
    if given.more is not None and stage != "train":
        raise UsageError(f"--more belongs to `pipeline train` and `pipeline run`, not to {stage}")
    settings = with_effects(_more(settings, given.more, given.workspace), given.effect)
    settings = _matching_exposure(settings, given.match_exposure)
    if given.budget is not None:
        settings = _study_for(settings, given.budget, stage)
    if given.cameras is not None:
        update = {"cameras": given.cameras.absolute()}
        settings = settings.model_copy(update={"render": settings.render.model_copy(update=update)})
    stages = stage_list.needed_for(stage, dict(settings))
    with choose_display(given.common.json) as display:
        force = frozenset({stage}) if given.force else frozenset[str]()
        return _run_stages(given.workspace, settings, stages, given.common, display, force, alone=stage)


def _study_for(settings: Settings, budget: str, stage: str) -> Settings:
    """The settings with `pipeline tradeoff --budget`."""
    if stage != "tradeoff":
        raise UsageError(f"--budget belongs to `pipeline tradeoff`, not to {stage}")
    update = {"seconds": seconds_from(budget)}
    return settings.model_copy(update={"tradeoff": settings.tradeoff.model_copy(update=update)})


def _recorded_settings(workspace: Workspace) -> Settings:
    """The options in run.json. Raises StageError where this version of the program has others."""
    try:
        return settings_from(workspace.read_run().options, "recorded there")
    except UsageError as error:
        why = f"{error}; another version of this program wrote it"
        hint = f"Give the photos again: pipeline run PHOTOS -o {workspace.root}. Results that still match are kept."
        raise StageError(
            "pipeline.recorded-options", f"cannot use the options of {workspace.root}", why, hint
        ) from error


def command_resume(words: Sequence[str]) -> int:
    """``pipeline resume WORKSPACE``: repeat the recorded run."""
    given = arguments.parse(arguments.ResumeArguments, "resume", words)
    workspace = Workspace.existing(given.workspace)
    stages = workspace.read_run().stages or stage_list.usual()
    with choose_display(given.common.json) as display, _watched(given.workspace, given.view, display):
        return _run_stages(given.workspace, _recorded_settings(workspace), stages, given.common, display)


@contextmanager
def _watched(root: Path, wanted: bool, display: Display) -> Iterator[None]:
    """The block, with a server for browsers meanwhile where that is ``wanted``."""
    if not wanted:
        yield
        return
    with serve_during(root) as url:
        display.headline(f"view it: {url}")
        open_browser(url, root)
        yield


def command_view(words: Sequence[str]) -> int:
    """``pipeline view WORKSPACE``: until Ctrl-C."""
    given = arguments.parse(arguments.ViewArguments, "view", words)
    if given.port is not None and not 1 <= given.port <= MAX_PORT:
        raise UsageError(f"--port {given.port}: a port is a number from 1 to {MAX_PORT}")
    workspace = Workspace.existing(given.workspace)
    workspace.read_run()  # a page could only say that there is nothing to show
    check_installed()
    from pipeline.view.server import ViewServer

    server = ViewServer(workspace.root, given.port)
    print(json.dumps({"event": "view", "url": server.url}) if given.json else f"view it: {server.url}", flush=True)
    open_browser(server.url, workspace.root)
    server.run()
    return 0


def _reader(root: Path) -> tuple[Workspace, Runner]:
    workspace = Workspace.existing(root)
    return workspace, Runner(workspace, _recorded_settings(workspace), SilentDisplay())


def command_status(words: Sequence[str]) -> int:
    """``pipeline status WORKSPACE``."""
    given = arguments.parse(arguments.StatusArguments, "status", words)
    workspace, runner = _reader(given.workspace)
    statuses = status.all_statuses(workspace, runner, given.verify)
    code = exit_codes.DEFECT if given.verify and any(s.state == "damaged" for s in statuses) else 0
    if given.json:
        print(json.dumps([asdict(s) for s in statuses]))
        return code
    for s in statuses:
        print(f"{s.stage:<10} {s.state:<8} {s.text}".rstrip())
    if workspace.running() is None:
        print(status.next_step(statuses, runner.run_file.stages, workspace.root) or "everything is up to date")
    return code


def command_explain(words: Sequence[str]) -> int:
    """``pipeline explain STAGE WORKSPACE``."""
    given = arguments.parse(arguments.ExplainArguments, "explain", words)
    stage = _known_stage(given.stage, "explain")
    print("\n".join(status.explain(*_reader(given.workspace), stage)))
    return 0


def command_clean(words: Sequence[str]) -> int:
    """``pipeline clean WORKSPACE``: remove results that the recorded options do not use."""
    given = arguments.parse(arguments.CleanArguments, "clean", words)
    with Workspace.existing(given.workspace) as workspace:
        stale = workspace.stale_folders(workspace.read_run().keys, list(stage_list.STAGES))
        freed = sum(p.stat().st_size for folder in stale for p in folder.rglob("*") if p.is_file())
        for folder in stale:
            print(f"{'would remove' if given.dry_run else 'removed'} {folder}")
            if not given.dry_run:
                shutil.rmtree(folder)
    print(f"{freed / 2**20:.1f} MB in {counted(len(stale), 'folder')}")
    return 0


def command_doctor(words: Sequence[str]) -> int:
    """``pipeline doctor``: versions, device, threads, free disk, a numerical self-test."""
    given = arguments.parse(arguments.DoctorArguments, "doctor", words)
    from pipeline.doctor import examine

    return examine(Path(os.curdir), given.selftest, given.bench)


def command_demo(words: Sequence[str]) -> int:
    """``pipeline demo``: photograph a synthetic scene, run everything, compare with the truth."""
    given = arguments.parse(arguments.DemoArguments, "demo", words)
    from pipeline import demo

    settings = given.settings
    if given.budget is None:
        settings = arguments.with_flags(demo.default_settings(), settings, "demo", words)
    budget = _budget(given.budget, settings)
    asked = with_effects(settings, given.effect)
    photos, root = given.output / "photos", given.output / "demo.nerf"
    asked = _keeping_studies(asked, root, words)
    with choose_display(given.common.json) as display:
        display.begin("photos")
        line, seconds = demo.photograph(photos, display)
        display.end("photos", line, seconds, cached=seconds == 0)
        settings = with_source(asked, photos, None)
        budgeted = (budget, seconds)
        stages = stage_list.up_to(list(stage_list.STAGES)[-1], dict(settings))
        code = _run_stages(root, settings, stages, given.common, display, new_budget=budgeted)
        started = time.monotonic()
        display.begin("truth")
        *notes, last = demo.truth_lines(root / "output", photos)
        for text in notes:
            display.note("pipeline.truth", text)
        display.end("truth", last, time.monotonic() - started, cached=False)
        report = root / "output" / "report.html"
        display.finished(f"→ the report: {report}", {"report.html": report})
    return code
