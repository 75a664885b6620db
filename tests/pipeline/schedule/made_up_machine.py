"""A whole chain of stages on a machine whose clock and speed are made up, for budgets."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from PIL import Image
from pydantic import BaseModel

from pipeline.engine.display import SilentDisplay
from pipeline.engine.runner import Runner
from pipeline.engine.stage_list import STAGES
from pipeline.engine.workspace import RUN_FILE, Workspace
from pipeline.schedule.budget import Account, allocated_seconds, min_total
from stages.contract import Stage, StageConfig, StageError, StageResult, reading_seconds
from stages.hardware.device import processors
from stages.io.files import write_durably, write_json
from stages.io.photos import Photo, write_photos
from stages.train.config import Config as TrainConfig

CHAIN = ("ingest", "sfm", "normalise", "effects", "train", "evaluate", "render", "mesh", "report")
INPUTS: dict[str, tuple[str, ...]] = {
    "sfm": ("ingest",),
    "normalise": ("sfm",),
    "effects": ("normalise",),
    "train": ("effects",),
}
INPUTS |= {"evaluate": ("train",), "render": ("train",), "mesh": ("train",), "tradeoff": ("effects",)}
INPUTS["report"] = ("train", "evaluate", "render", "mesh", "tradeoff")

FLEXIBLE = {name: flexible for name, stage in STAGES.items() if (flexible := stage.flexible)}
MIN_SECONDS = {name: flexible.min_seconds for name, flexible in FLEXIBLE.items()}


def allocated(stage: str, left: float, to_come: dict[str, float | None], total: float, reading: float = 0.0) -> float:
    """What the real stage is given."""
    return allocated_seconds(STAGES, stage, left, to_come, total, reading)


def least(times: dict[str, float | None], reading: float = 0.0) -> float:
    """The smallest budget of the real stages."""
    return min_total(STAGES, times, reading)


class Timed(StageConfig):
    """Of a stage that works for as long as it is told, or as long as it must."""

    photos: Path = Path()
    cameras: Path | None = None
    photo_list: Path | None = None
    seconds: float | None = None
    units: int | None = None
    pace: float = 1.0


class Training(Timed):
    steps: int | None = None
    preset: str | None = None
    after: str | None = None

    time_is_open = TrainConfig.time_is_open  # pyright: ignore[reportIncompatibleMethodOverride]
    exempt_from_budget = TrainConfig.exempt_from_budget  # pyright: ignore[reportIncompatibleMethodOverride]
    planned_seconds = TrainConfig.planned_seconds


class Fixed(StageConfig):
    photos: Path = Path()
    cameras: Path | None = None
    photo_list: Path | None = None
    budget: dict[str, Any] | None = None
    resumed: tuple[str, ...] | None = None


class Machine:
    """A clock, and how many seconds a second of work takes from ``halves_at`` on and before."""

    def __init__(self, slowness: float = 1.0) -> None:
        self.now, self.slowness, self.halves_at, self.killed_at = 1000.0, slowness, float("inf"), list[float]()
        self.megapixels, self.refuses = 0.0, ""  # of the photos, and the stage that cannot do what it is asked to
        self.planning = 0.5  # seconds that a plan takes
        self.killed_planning = ""  # the stage that is killed 15 seconds after its planning began
        self.root = Path()  # the workspace
        self.beats = dict[Callable[[], object], tuple[float, float]]()  # what is done every so often, and when next
        self.dead = False

    def work(self, seconds: float) -> None:
        """Let time pass, in quarters. A kill leaves what is on the disk."""
        for _ in range(round(4 * seconds)):
            self.now += 0.25 * self.slowness * (2 if self.now >= self.halves_at else 1)
            if self.killed_at and self.now >= self.killed_at[0]:
                self.killed_at.pop(0)
                self.dead = True
                raise Killed((self.root / RUN_FILE).read_bytes())
            for act, (every, due) in list(self.beats.items()):
                if self.now >= due:
                    self.beats[act] = every, self.now + every
                    act()

    @contextmanager
    def periodically(self, seconds: float, act: Callable[[], object]) -> Iterator[None]:
        """stages/io/stopwatch.py, by this machine's clock."""
        self.beats[act] = seconds, self.now + seconds
        try:
            yield
        finally:
            del self.beats[act]

    def write_durably(self, path: Path, content: bytes) -> None:
        """stages/io/files.py, for those who note how long they worked: a killed program does so no more."""
        if self.dead:
            raise OSError
        write_durably(path, content)


class Killed(BaseException):
    """SIGKILL: nothing is noted down. Holds run.json as it was."""


UNITS = {"evaluate": (1, 8, 1.5), "render": (6, 4000, 0.1), "mesh": (4, 400, 0.15)}
"""Least and most, and seconds for each at full speed."""
MUST = {"ingest": 1.5, "sfm": 40.0, "normalise": 0.3, "effects": 3.0, "report": 1.5}
EXPECTED: dict[str, float | None] = dict.fromkeys(FLEXIBLE) | {
    "ingest": 1.0, "sfm": 50.0, "normalise": 0.3, "effects": 10.0, "report": 2.0,
}  # fmt: skip


def chain(machine: Machine) -> dict[str, Stage]:
    """Nine stages like the real ones: some take what they take, training has a clock, the rest measure speed."""

    def plan(name: str) -> Callable[..., Timed]:
        def units(config: Timed, _inputs: object, _progress: object) -> Timed:
            if name not in UNITS or config.units is not None:
                return config
            least, most, each = UNITS[name]
            measured = machine.now
            if name == machine.killed_planning:
                machine.killed_planning, machine.killed_at = "", [machine.now + 15]
            machine.work(machine.planning)
            speed = machine.planning / (machine.now - measured)
            assert config.seconds is not None
            count = int(config.seconds * speed / each)
            return config.model_copy(update={"units": max(least, min(most, count))})

        return units

    def run(name: str) -> Callable[..., StageResult]:
        def work(config: Any, _inputs: object, folder: Path, _progress: object) -> StageResult:
            if name == "train":
                checkpoint = folder / "seconds"
                done = float(checkpoint.read_text()) if checkpoint.exists() else 0.0
                machine.work(3.0 + reading_seconds(machine.megapixels, processors()))
                while done < config.seconds:  # the clock decides, whatever the machine does
                    before = machine.now
                    machine.work(1.0)
                    done += machine.now - before
                    checkpoint.write_text(str(done))
            elif name in UNITS:
                machine.work(config.units * UNITS[name][2])
            elif name == "tradeoff":
                machine.work(config.seconds)
            else:
                machine.work(MUST[name])
            if name == machine.refuses:
                raise StageError("sfm.fake", "it cannot be done", "nothing overlaps", "Add photos.")
            if name == "ingest":
                photo = Photo(
                    "0.png", "images/0.png", round(1000 * machine.megapixels), 1000, 0, None, None, False, 1.0
                )
                write_photos(folder, [photo], [], {})
            # A training bounded by seconds never gives the same bytes again.
            content = {"config": config.model_dump(mode="json"), "ended": machine.now if name == "train" else None}
            write_json(folder / "result.json", content)
            return StageResult(("result.json", *(["photos.json"] if name == "ingest" else [])), name)

        return work

    def stage(name: str) -> Stage:
        real, planned = STAGES[name], name not in ("ingest", "normalise", "report")
        return Stage(
            name=name,
            inputs=INPUTS.get(name, ()),
            version=1,
            exit_code=real.exit_code,
            resumes=name == "train",
            published=(),
            config=Training if name == "train" else Timed if planned else Fixed,
            not_hashed=("seconds",) if planned and name != "train" else (),
            plan=plan(name) if planned else None,
            run=run(name),
            on_request=real.on_request,
            summary=real.summary,
            flexible=real.flexible,
            budget_seconds=real.budget_seconds,
            limiting_seconds=real.limiting_seconds,
        )

    return {name: stage(name) for name in (*CHAIN[:-1], "tradeoff", "report")}


class Options(BaseModel):
    ingest: Fixed = Fixed()
    sfm: Timed = Timed()
    normalise: Fixed = Fixed()
    effects: Timed = Timed()
    train: Training = Training()
    evaluate: Timed = Timed()
    render: Timed = Timed()
    mesh: Timed = Timed()
    tradeoff: Timed = Timed(seconds=1000.0)
    report: Fixed = Fixed()


class Outcome(NamedTuple):
    """Of one command: its account, whether anything ran, and the seconds until it ended."""

    budget: Account | None
    ran: bool
    took: float


Go = Callable[..., Outcome]


def runs_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    """Runs the chain on a machine under a budget; ``resume``: goes on without naming one, ``alone``: no whole run."""
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.new("RGB", (4, 4)).save(photos / "0.png")

    def run(
        machine: Machine, total: float | None, resume=False, stages=CHAIN, replan=(), alone=False, times=None, **options
    ) -> Outcome:
        clock = SimpleNamespace(monotonic=lambda: machine.now)
        monkeypatch.setattr("pipeline.engine.runner.STAGES", chain(machine))
        monkeypatch.setattr("pipeline.engine.runner.time", clock)
        monkeypatch.setattr("stages.io.stopwatch.time", clock)
        monkeypatch.setattr("stages.io.stopwatch.periodically", machine.periodically)
        monkeypatch.setattr("stages.io.stopwatch.write_durably", machine.write_durably)
        settings = Options.model_validate({"ingest": {"photos": photos}} | options)
        machine.root, machine.dead = tmp_path / "w.nerf", False
        with Workspace(machine.root) as workspace:
            runner = Runner(workspace, settings, SilentDisplay())  # type: ignore[arg-type]
            if not resume:
                runner.budget.set_total(total, 0.0)
            began = machine.now
            try:
                ran = runner.run(stages, times=times or EXPECTED, replan=replan, remember=not alone)
            except Killed as kill:  # what the runner notes as it is left, no killed program does
                (machine.root / RUN_FILE).write_bytes(kill.args[0])
                raise
        return Outcome(runner.budget.account, ran, machine.now - began)

    return run


def spent(runner: Outcome) -> dict[str, float]:
    assert runner.budget is not None
    return runner.budget.spent
