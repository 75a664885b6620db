"""Faults by the dozen: what the tests of this folder do a few times and ``python -m tests.drills`` many times."""

import random
import shutil
import signal
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.engine.stage_list import STAGES
from stages.sfm.retry_strategies import STRATEGIES
from stages.sfm.worker_process import REFINING
from tests.drills.drill import Prepare, Program, copy_workspace, results, run_words

# How a program that got a signal ends: its exit code, and the code of its last event.
ENDS = {signal.SIGINT: (130, "pipeline.interrupted"), signal.SIGTERM: (143, "pipeline.terminated")}
RETRY = next(strategy for strategy in STRATEGIES if strategy.matches == "missing")
# How the events of sfm tell where it is; two by a note, for the live line may miss what takes less than half a second.
SFM_INSTANTS = {
    "features": lambda event: event.get("done") is not None,
    "matching": lambda event: event["event"] == "note" and event["message"].startswith("matching "),
    RETRY.name: lambda event: event.get("code") == "sfm.strategy" and RETRY.description in event["message"],
    "final bundle adjustment": lambda event: event.get("done") == REFINING,
}


def reached(instant: str, events: Sequence[Mapping[str, Any]]) -> bool:
    """Whether stage sfm has got to one of the ``SFM_INSTANTS``."""
    return any(event.get("stage") == "sfm" and SFM_INSTANTS[instant](event) for event in events)


@dataclass
class Chain:
    """Photos, options, and what a run that nobody disturbs makes of them, in ``workspace``."""

    photos: Path
    workspace: Path
    options: tuple[str, ...] = ()
    until: str = "report"
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage

    def __post_init__(self) -> None:
        program = self.start(self.workspace).finish()
        self.seconds = {event["stage"]: event["seconds"] for event in program.events() if event["event"] == "end"}
        self.expected = results(self.workspace)

    def start(self, workspace: Path, *more: str, says: Path | None = None, prepare: Prepare = None) -> Program:
        """The same run in another workspace; what it says goes to ``says``, by default beside that."""
        as_far = () if "--until" in more else ("--until", self.until)
        words = run_words(self.photos, workspace, *self.options, *as_far, *more)
        return Program(words, says or workspace.parent / f"{workspace.name}.says", prepare)

    def before(self, stage: str, to: Path) -> Path:
        """A workspace in which everything before ``stage`` is finished."""
        stages = list(self.seconds)
        return copy_workspace(self.workspace, to, tuple(stages[stages.index(stage) :]))

    def lost(self, workspace: Path, *more: str, until: str | None = None, says: Path | None = None) -> list[str]:
        """Run again and name the stages, as far as ``until``, whose results are not those of the undisturbed run."""
        until = until or self.until
        self.start(workspace, *more, "--until", until, says=says).finish()
        found, stages = results(workspace), list(self.seconds)
        asked = stages[: stages.index(until) + 1]
        return [stage for stage in asked if stage != "report" and found.get(stage) != self.expected[stage]]


@dataclass
class Tally:
    """What a campaign did and found."""

    struck: Counter[str] = field(default_factory=Counter)  # by stage
    lost: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    slowest: float = 0.0  # seconds to end

    def __str__(self) -> str:
        where = ", ".join(f"{stage} {self.struck[stage]}" for stage in STAGES if self.struck[stage])
        slowest = f"; ended within {self.slowest:.2f} s" if self.slowest else ""
        problems = "".join(f"\n  {fault}" for fault in self.faults)
        return f"{self.struck.total()} struck ({where}); results lost: {len(self.lost)}{slowest}{problems}"


def instants(chain: Chain, stages: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, float]]:
    """Stages in turn, and how long after each one's beginning to strike: at random within the time that it takes."""
    numbers = random.Random(seed)
    for index in range(count):
        stage = stages[index % len(stages)]
        yield stage, numbers.uniform(0.0, chain.seconds[stage])


def strike_in(chain: Chain, stage: str, delay: float, number: signal.Signals, workspace: Path) -> tuple[Program, float]:
    """Run ``stage`` of a fresh copy and strike ``delay`` seconds after it began; the program, and how long it took to
    end."""
    program = chain.start(chain.before(stage, workspace))
    program.wait_until(lambda events: any(e["event"] == "begin" and e["stage"] == stage for e in events))
    program.process.join(delay)
    return program, program.strike(number)


def kills(chain: Chain, stages: Sequence[str], count: int, seed: int, folder: Path) -> Tally:
    """SIGKILL at random instants; after each one the same command must end with the same results."""
    tally = Tally()
    for stage, delay in instants(chain, stages, count, seed):
        workspace = folder / "killed.nerf"
        program, _ = strike_in(chain, stage, delay, signal.SIGKILL, workspace)
        if program.wait() == -signal.SIGKILL:
            tally.struck[stage] += 1
        if orphans := program.orphans():
            tally.faults.append(f"{stage} after {delay:.3f} s: left behind {orphans}")
        tally.lost += [f"{lost} after a kill in {stage}" for lost in chain.lost(workspace)]
        shutil.rmtree(workspace)
    return tally


def interruptions(chain: Chain, stages: Sequence[str], count: int, seed: int, folder: Path) -> Tally:
    """SIGTERM and Ctrl-C in turn at random instants; each end must be clean, and the same command give the same."""
    tally = Tally()
    for index, (stage, delay) in enumerate(instants(chain, stages, count, seed)):
        number = (signal.SIGINT, signal.SIGTERM)[index // len(stages) % 2]
        workspace = folder / "interrupted.nerf"
        program, seconds = strike_in(chain, stage, delay, number, workspace)
        if program.wait() != 0:  # else it had finished before
            tally.struck[stage] += 1
            tally.slowest = max(tally.slowest, seconds)
            where = f"{number.name} in {stage} after {delay:.3f} s"
            tally.faults += [f"{where}: {fault}" for fault in unclean(program, number, workspace)]
        tally.lost += [f"{lost} after {number.name} in {stage}" for lost in chain.lost(workspace)]
        shutil.rmtree(workspace)
    return tally


def unclean(program: Program, number: signal.Signals, workspace: Path) -> list[str]:
    """What is wrong with how a program that got a signal has ended."""
    faults = []
    exit_code, code = ENDS[number]
    if program.wait() != exit_code:
        faults.append(f"exit code {program.wait()}")
    if complaints := program.complaints:
        faults.append(f"it complained: {complaints}")
    words = {"what": "", "why": "", "hint": ""}
    if (last := program.events()[-1]) | words != {"event": "error", "stage": None, "code": code, **words}:
        faults.append(f"its last words were {last}")
    if orphans := program.orphans():
        faults.append(f"left behind {orphans}")
    if (workspace / ".lock.pid").exists():
        faults.append("the lock still names it")
    return faults
