"""What the user sees while stages run: a live line on a terminal, plain lines when piped, JSON lines for scripts."""

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO

from pipeline.engine.display import Display
from stages.contract import StageError
from stages.io.amounts import duration

JSON_SECONDS = 0.2  # JSON output: one progress event at most this often
HEARTBEAT_SECONDS = 10.0  # plain output: one line at most this often, and only a new one, so that a log stays readable


def end_line(stage: str, line: str, seconds: float, cached: bool) -> str:
    """One finished stage as one line."""
    took = "cached" if cached else duration(seconds)
    return f"{stage:<10} {line}  [{took}]"


def error_text(stage: str, error: StageError) -> str:
    """A stage error as the user reads it: what, why, what to try."""
    return f"{stage} failed: {error.what}\n  why: {error.why}\n  try: {error.hint}"


class Unread:
    """A stream that loses what it cannot write: that its reader or its terminal is gone, or the disk under a log full,
    ends no run."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()

    def leave(self) -> None:
        """What is left of a failed write would be tried again when the program ends, and make that a failure."""
        try:
            self._stream.flush()
        except OSError:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())


def open_closed_streams() -> None:
    """Let standard streams that were closed (``>&-``) lead nowhere; else whatever file is opened next is in their
    place."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)  # the lowest that is free: that of the stream
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "r" if name == "stdin" else "w"))


class PlainDisplay:
    """Lines on standard output; errors on standard error."""

    def __init__(self) -> None:
        self._stage = ""
        self._last, self._said = 0.0, ""
        self._lock = threading.Lock()

    def _say(self, text: str) -> None:
        with self._lock:
            print(text, flush=True)

    def headline(self, text: str) -> None:
        self._say(text)

    def begin(self, stage: str) -> None:
        self._stage, self._last, self._said = stage, time.monotonic(), ""

    def update(self, message: str, done: float | None = None) -> None:
        now = time.monotonic()
        if not self._stage or now - self._last < HEARTBEAT_SECONDS:
            return
        share = "" if done is None else f" {100 * done:.0f}%"
        line = f"{self._stage:<10} …{share} {message}"
        if line != self._said:
            self._last, self._said = now, line
            self._say(line)

    def note(self, code: str, text: str) -> None:
        self._say(f"{self._stage:<10} {text}")

    def end(self, stage: str, line: str, seconds: float, cached: bool) -> None:
        self._say(end_line(stage, line, seconds, cached))

    def failed(self, stage: str, error: StageError) -> None:
        print(error_text(stage, error), file=sys.stderr, flush=True)

    def finished(self, message: str, outputs: dict[str, Path]) -> None:
        self._say(message)


class JsonDisplay:
    """One JSON object a line on standard output, for scripts: {"event", "stage", ...}."""

    def __init__(self) -> None:
        self._stage, self._last = "", 0.0
        self._lock = threading.Lock()

    def _event(self, event: str, **values: Any) -> None:
        with self._lock:
            print(json.dumps({"event": event, **values}), flush=True)

    def headline(self, text: str) -> None:
        self._event("start", text=text)

    def begin(self, stage: str) -> None:
        self._stage, self._last = stage, 0.0
        self._event("begin", stage=stage)

    def update(self, message: str, done: float | None = None) -> None:
        now = time.monotonic()
        if self._stage and now - self._last >= JSON_SECONDS:
            self._last = now
            self._event("progress", stage=self._stage, message=message, done=done)

    def note(self, code: str, text: str) -> None:
        self._event("note", stage=self._stage, code=code, message=text)

    def end(self, stage: str, line: str, seconds: float, cached: bool) -> None:
        self._event("end", stage=stage, line=line, seconds=round(seconds, 3), cached=cached)

    def failed(self, stage: str, error: StageError) -> None:
        self._event("error", stage=stage, code=error.code, what=error.what, why=error.why, hint=error.hint)

    def finished(self, message: str, outputs: dict[str, Path]) -> None:
        self._event("finished", message=message, outputs={k: str(v) for k, v in outputs.items()})


class RichDisplay:
    """A terminal: finished lines scroll up, one live line with a spinner shows that work goes on."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self._console = Console(highlight=False)
        self.progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.fields[stage]:<10}", markup=False),
            BarColumn(bar_width=20),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            refresh_per_second=8,
        )
        self._task: Any = None
        self._stage = ""

    def headline(self, text: str) -> None:
        self._print(text, style="dim")

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, markup=False, soft_wrap=True)

    def begin(self, stage: str) -> None:
        self._clear()  # the line of a stage that failed
        self._stage = stage
        self._task = self.progress.add_task("starting", total=None, stage=stage)

    def update(self, message: str, done: float | None = None) -> None:
        from rich.markup import escape

        if self._task is not None:
            total, completed = (None, 0.0) if done is None else (1.0, done)
            self.progress.update(self._task, description=escape(message), total=total, completed=completed)

    def note(self, code: str, text: str) -> None:
        self._print(f"{self._stage:<10} {text}", style="yellow")

    def _clear(self) -> None:
        if self._task is not None:
            self.progress.remove_task(self._task)
            self._task = None

    def end(self, stage: str, line: str, seconds: float, cached: bool) -> None:
        self._clear()
        self._print(end_line(stage, line, seconds, cached), style="dim" if cached else None)

    def failed(self, stage: str, error: StageError) -> None:
        self._clear()
        self._print(error_text(stage, error), style="red")

    def finished(self, message: str, outputs: dict[str, Path]) -> None:
        self._print(message, style="bold")


@contextmanager
def choose_display(as_json: bool) -> Iterator[Display]:
    """The display that fits where the output goes; a terminal's line is live while the block runs, which goes on where
    nobody reads along any more."""
    out, errors = Unread(sys.stdout), Unread(sys.stderr)
    try:
        with redirect_stdout(out), redirect_stderr(errors):
            if as_json:
                yield JsonDisplay()
            elif out.isatty():
                display = RichDisplay()
                with display.progress:
                    yield display
            else:
                yield PlainDisplay()
    finally:
        out.leave()
        errors.leave()
