"""One scene: `pipeline run` in a process of its own, so that whatever happens there ends that scene alone."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

from pipeline.batch.batch_file import SceneFailure
from stages.hardware.child_process import child_environment

# -P: nothing in the current folder is taken for a module.
COMMAND = ["-P", "-m", "pipeline.cli.exit_with_parent", "run"]
NO_REASON = {"why": "an option is wrong", "hint": "Correct it, and give the command again."}  # of a usage error
ENDING_SECONDS = 120.0  # until a run whose parent was killed has ended, and its lock is free on shared storage, too
FIGURES = ("photos", "registered", "psnr", "ssim", "cameras_doubtful")


class SceneRun(NamedTuple):
    """A scene to run: its name, the arguments of its `pipeline run`, the log, and the folder to run in."""

    name: str
    arguments: tuple[str, ...]
    log: Path
    at: Path


class Ending(NamedTuple):
    """How a scene ended: its last finished stage in a line, why it failed (None: it did not), seconds that it took."""

    name: str
    line: str
    failure: SceneFailure | None
    seconds: float


def run_scene(run: SceneRun, follow: Callable[[str, float | None], None] = lambda line, done: None) -> Ending:
    """Run a scene. What it says goes to its log; ``follow`` gets its live line and the finished fraction of the stage.
    Where this process is interrupted, the run is, too, and has ended when the exception goes on. Where a process was
    killed with the same scene, its run ends by itself in a moment, which is waited for."""
    began = time.monotonic()
    while True:
        line, failure = _attempted(run, follow)
        seconds = time.monotonic() - began
        if failure is None or failure.code != "pipeline.workspace-in-use" or seconds > ENDING_SECONDS:
            return Ending(run.name, line, failure, seconds)
        follow("waits: another run has not ended there", None)
        time.sleep(1.0)


def _attempted(run: SceneRun, follow: Callable[[str, float | None], None]) -> tuple[str, SceneFailure | None]:
    try:
        return _run(run, follow)
    except OSError as error:
        hint = "Give the same command again; what is finished is kept."
        why = error.strerror or str(error)
        return "", SceneFailure(stage=None, code="pipeline.scene-not-run", what="cannot run it", why=why, hint=hint)


def _run(run: SceneRun, follow: Callable[[str, float | None], None]) -> tuple[str, SceneFailure | None]:
    log = run.log
    last, failure = "", None
    with log.open("a", encoding="utf-8", errors="backslashreplace") as text:
        text.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} pipeline run {' '.join(run.arguments)}\n")
        text.flush()
        began = text.tell()
        with _started(run, text) as child:
            assert child.stdout
            for event in map(_event, child.stdout):
                if event["event"] == "progress":
                    follow(f"{event['stage']} · {event['message']}", event["done"])
                    continue
                if event["event"] == "begin":
                    follow(event["stage"], None)
                elif event["event"] == "end":
                    last = f"{event['stage']}: {event['line']}"
                elif event["event"] == "error":
                    told = {key: event[key] for key in SceneFailure.model_fields}
                    failure = SceneFailure(**told if event["why"] else told | NO_REASON)
                text.write(_log_line(event))
                text.flush()
    if child.returncode and failure is None:
        failure = _crash(log, began, child.returncode)
    return last, failure


@contextmanager
def _started(run: SceneRun, log: IO[str]) -> Iterator["subprocess.Popen[str]"]:
    child = subprocess.Popen(
        [sys.executable, *COMMAND, *run.arguments, "--json"],
        cwd=run.at,
        stdin=subprocess.PIPE,  # open as long as this process lives
        stdout=subprocess.PIPE,
        stderr=log,
        env=child_environment(),
        encoding="utf-8",
        errors="replace",
        start_new_session=True,  # Ctrl-C reaches this process alone, which hands it on
    )
    try:
        yield child
    except BaseException:
        child.send_signal(signal.SIGTERM)
        raise
    finally:
        child.wait()
        for stream in (child.stdin, child.stdout):
            if stream:
                stream.close()


def _event(line: str) -> dict[str, Any]:
    """A line of the run's output; one that is no event, such as a library prints, or that a crash cut off, as a
    message."""
    try:
        event = json.loads(line)
        return event if "event" in event else {"event": "note", "message": line.strip()}
    except (ValueError, TypeError):
        return {"event": "note", "message": line.strip()}


def _log_line(event: Mapping[str, Any]) -> str:
    kind = event["event"]
    if kind == "begin":
        return f"{time.strftime('%H:%M:%S')} {event['stage']}\n"
    if kind == "error":
        return f"failed: {event['what']}\n  why: {event['why']}\n  try: {event['hint']}\n"
    return f"         {event.get('line') or event.get('message') or event.get('text') or ''}\n"


def _crash(log: Path, began: int, ending: int) -> SceneFailure:
    """The failure of a run that ended without an error of its own, whose part of the log begins at ``began``."""
    with log.open("rb") as file:
        file.seek(began)
        lines = file.read().decode("utf-8", "replace").strip().splitlines()
    what = f"its process ended {f'by {signal.Signals(-ending).name}' if ending < 0 else f'with code {ending}'}"
    memory = ending == -getattr(signal, "SIGKILL", 9)
    why = "most likely memory ran out" if memory else f"its last line: {lines[-1].strip() if lines else 'none'}"
    hint = f"Give the same command again: what is finished is kept. Log: {log}"
    return SceneFailure(stage=None, code="pipeline.scene-crashed", what=what, why=why, hint=hint)


def figures_of(workspace: Path) -> dict[str, Any]:
    """What the summary of a finished run says that ranks it; empty where it made none."""
    try:
        summary = json.loads((workspace / "output" / "summary.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return {key: summary.get(key) for key in FIGURES}
