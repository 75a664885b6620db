"""What all drills share: a chain that takes seconds, programs that can be struck at any instant, and what came of it.

A program of a drill is forked from a server that has imported everything already (4 s each time otherwise), in a
session of its own, as a shell would start it. What it prints goes to files, so that it can be read while it runs.
"""

import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.cli import commands
from pipeline.engine import manifest_file

MARK = "PIPELINE_DRILL"  # in the environment of a program and of all that it starts
TINY = (
    "--train.steps 60 --train.grid.num-levels 2 --train.grid.log2-hashmap-size 10 --train.grid.max-res 32"
    " --train.grid.target-samples 1024 --train.grid.micro-batches 2 --train.grid.backend warp"
    " --train.checkpoint-seconds 0.05 --train.downscale 1 --evaluate.fraction 1"
    " --render.frames 6 --render.width 32 --mesh.resolution 24 --mesh.keep all"
).split()
PATIENCE = 120.0  # seconds until a program counts as hanging

Prepare = Callable[[], None] | None

_server = multiprocessing.get_context("forkserver")
_server.set_forkserver_preload(["tests.drills.preloaded"])


@dataclass
class Program:
    """``pipeline WORDS`` in a process of its own; ``files``: where it prints; ``prepare`` is called in it first."""

    words: list[str]
    files: Path
    prepare: Prepare = None
    process: Any = field(init=False)

    def __post_init__(self) -> None:
        self.files.mkdir(parents=True, exist_ok=True)
        for old in ("out", "err"):
            (self.files / old).unlink(missing_ok=True)
        self.mark = f"{os.getpid()}-{time.monotonic_ns()}"
        self.process = _server.Process(target=_live, args=(self.words, self.files, self.mark, self.prepare))
        self.process.start()

    @property
    def said(self) -> str:
        """What it printed so far on standard output."""
        return (self.files / "out").read_text("utf-8") if (self.files / "out").exists() else ""

    @property
    def complaints(self) -> str:
        """What it printed so far on standard error."""
        return (self.files / "err").read_text("utf-8") if (self.files / "err").exists() else ""

    def events(self) -> list[dict[str, Any]]:
        """The whole lines of ``--json`` so far."""
        return [json.loads(line) for line in self.said.splitlines(keepends=True) if line.endswith("\n")]

    def wait_until(self, reached: Callable[[list[dict[str, Any]]], bool]) -> bool:
        """Wait for events; False if it ended before they came."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            if reached(self.events()):
                return True
            if not self.process.is_alive():
                return reached(self.events())
            time.sleep(0.005)
        raise AssertionError(f"nothing of the kind in {PATIENCE:g} s: {self.said[-2000:]}")

    def strike(self, number: signal.Signals) -> float:
        """Send a signal, Ctrl-C to all of its group as a terminal does, and return the seconds until it was gone."""
        started = time.monotonic()
        if self.process.is_alive():
            (os.killpg if number == signal.SIGINT else os.kill)(self.process.pid, number)
        self.wait()
        return time.monotonic() - started

    def wait(self) -> int:
        """Its exit code, once it has ended; negative: the signal that ended it."""
        self.process.join(PATIENCE)
        if self.process.is_alive():
            self.process.kill()
            raise AssertionError(f"it hangs: {self.said[-2000:]} {self.complaints[-2000:]}")
        assert self.process.exitcode is not None
        return self.process.exitcode

    def orphans(self, seconds: float = 3.0) -> list[str]:
        """Command lines of processes that it started and that outlived it by so long."""
        deadline = time.monotonic() + seconds
        while (found := list(self._relatives())) and time.monotonic() < deadline:
            time.sleep(0.02)
        return found

    def _relatives(self) -> Iterator[str]:
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if f"{MARK}={self.mark}".encode() in (folder / "environ").read_bytes():
                    yield (folder / "cmdline").read_text().replace("\0", " ")
            except OSError:  # it has ended meanwhile
                continue

    def finish(self) -> "Program":
        """Wait for a good end."""
        assert self.wait() == 0, self.said[-3000:] + self.complaints[-3000:]
        return self


def _live(words: list[str], files: Path, mark: str, prepare: Prepare) -> None:
    """In the forked process: become a program as a shell starts it, and run the command line."""
    os.setsid()
    for name, number in (("out", 1), ("err", 2)):
        descriptor = os.open(files / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, number)
        os.close(descriptor)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 -- until the program ends
    sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    os.environ[MARK] = mark
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if prepare is not None:
        prepare()
    sys.argv[1:] = words
    commands.main()


def run_words(photos: Path, workspace: Path, *more: str) -> list[str]:
    """The command line of a whole chain."""
    return ["run", str(photos), "-o", str(workspace), "--json", *TINY, *more]


def finished_folders(workspace: Path) -> dict[str, Path]:
    """Stage → the folder of its finished result; those that have none are left out."""
    keys = json.loads((workspace / "run.json").read_text("utf-8"))["keys"]
    found = {stage: workspace / stage / key[:16] for stage, key in keys.items()}
    return {stage: folder for stage, folder in found.items() if (folder / "manifest.json").is_file()}


def results(workspace: Path) -> dict[str, str]:
    """Stage → digest of its outputs, the files read anew. The report shows how long everything took: it is left out."""
    found = {}
    for stage, folder in finished_folders(workspace).items():
        manifest = manifest_file.read(folder)
        assert manifest.outputs_digest == manifest_file.outputs_digest(
            manifest_file.describe_outputs(folder, tuple(manifest.outputs))
        ), f"{folder} is not what its manifest says"
        if stage != "report":
            found[stage] = manifest.outputs_digest
    return found


def copy_workspace(workspace: Path, to: Path, without: tuple[str, ...] = ()) -> Path:
    """A copy, links kept, without the results of some stages."""
    shutil.copytree(workspace, to, symlinks=True)
    for stage in without:
        shutil.rmtree(to / stage, ignore_errors=True)
    return to
