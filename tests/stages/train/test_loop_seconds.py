"""Runs that are given seconds: they use them, whatever single steps take."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from stages.train import loop
from stages.train.checkpoints import latest_checkpoint
from stages.train.loop import TrainingRun
from stages.train.state import TrainingBudget, TrainingSpeed, checkpoint_interval
from tests.refusals import no_note
from tests.stages.train.one_number import Killed, OneNumber, number_of, run_in

Make = Callable[[int], OneNumber]


def on_a_made_up_clock(
    monkeypatch: pytest.MonkeyPatch,
    takes: Callable[[int], float],
    killed_at: int | None = None,
    killed_after: float = math.inf,
) -> Make:
    """``takes(step)`` seconds a step, and no time beside the steps. Killed at a step or after so many seconds."""
    now = 0.0

    def step_by_step(step: int, lr_scale: float) -> None:
        nonlocal now
        if step == killed_at or now >= killed_after:
            raise Killed
        now += takes(step)

    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: now, monotonic=lambda: now))
    return lambda attempt: OneNumber(attempt, step_by_step)


def test_a_run_in_seconds_ends_at_full_progress(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_in(tmp_path, progress, TrainingBudget(None, 30.0), on_a_made_up_clock(monkeypatch, lambda _: 0.3))
    run.train()
    assert run.state.seconds == pytest.approx(30, abs=0.5)
    assert run.schedule.progress(run.state.step) == pytest.approx(1)
    assert len(run.schedule.revisions) >= 2
    shares = [share for _, share, _ in number_of(run).history]
    assert 0.8 < shares[-1] < 1


def test_a_resumed_run_in_seconds_keeps_its_clock(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    budget = TrainingBudget(None, 30.0)
    with pytest.raises(Killed):
        run_in(tmp_path, progress, budget, on_a_made_up_clock(monkeypatch, lambda _: 0.3, killed_at=30)).train()
    journal = json.loads((tmp_path / "schedule.json").read_text())
    resumed = run_in(tmp_path, progress, budget, on_a_made_up_clock(monkeypatch, lambda _: 0.3))
    resumed.train()
    assert [list(decision) for decision in resumed.schedule.revisions][: len(journal)] == journal
    assert number_of(resumed).history[0][:2] == (30, resumed.schedule.progress(30))
    assert resumed.state.seconds == pytest.approx(30, abs=0.5)
    assert progress.names("train.resumes", "step 30", "21 s")


def test_more_seconds_take_that_long(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    make = on_a_made_up_clock(monkeypatch, lambda _: 0.3)
    first = run_in(tmp_path / "first", progress, TrainingBudget(None, 30.0), make)
    first.train()
    more = run_in(tmp_path / "more", progress, TrainingBudget(None, 30.0, tmp_path / "first"), make)
    assert more.schedule.progress(first.state.step) == pytest.approx(0.5, abs=0.05)
    more.train()
    assert more.state.seconds - first.state.seconds == pytest.approx(30, abs=0.5)


def run_on_a_made_up_clock(
    folder: Path,
    progress,
    monkeypatch: pytest.MonkeyPatch,
    seconds: float,
    takes: Callable[[int], float],
    killed_after: float = math.inf,
    checkpoint_seconds: float | None = None,
) -> TrainingRun:
    make = on_a_made_up_clock(monkeypatch, takes, killed_after=killed_after)
    budget = TrainingBudget(None, seconds)
    run = run_in(folder, progress, budget, make, checkpoint_seconds=checkpoint_seconds)
    run.train()
    return run


@pytest.mark.parametrize(("checkpoint_seconds", "kept"), [(20.0, 20.0), (math.inf, 0.0), (None, 27.0)])
@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_what_a_kill_loses_is_spent(
    checkpoint_seconds: float | None,
    kept: float,
    factor: float,
    tmp_path: Path,
    progress,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on_clock = (tmp_path, progress, monkeypatch, 60.0)
    with pytest.raises(Killed):
        run_on_a_made_up_clock(*on_clock, lambda _: 0.2, 29.0, checkpoint_seconds)
    checkpoint = latest_checkpoint(tmp_path / "checkpoints", no_note)
    assert checkpoint is not None and kept <= checkpoint.facts["seconds"] < kept + 2
    run = run_on_a_made_up_clock(*on_clock, lambda _: 0.2 * factor, checkpoint_seconds=checkpoint_seconds)
    again = run.state.seconds - checkpoint.facts["seconds"]
    assert 29 + again == pytest.approx(60, abs=2.5), "it is all spent, however slow the machine is now"
    shares = [share for _, share, _ in number_of(run).history]
    assert shares == sorted(shares) and 0.9 < shares[-1] <= 1
    assert progress.codes.count("train.lost-time") == (29 - checkpoint.facts["seconds"] > 1.6)


def test_a_repeatedly_killed_run_has_half_its_time(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    on_clock = (tmp_path, progress, monkeypatch, 60.0, lambda _: 0.2)
    for _ in range(9):
        with pytest.raises(Killed):
            run_on_a_made_up_clock(*on_clock, 10.0, math.inf)
    assert run_on_a_made_up_clock(*on_clock).state.seconds == pytest.approx(30, abs=1.0)


def test_killed_before_its_steps_could_be_counted(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    on_clock = (tmp_path, progress, monkeypatch, 100.0, lambda _: 10.0)
    with pytest.raises(Killed):
        run_on_a_made_up_clock(*on_clock, 10.0, 5.0)
    run = run_on_a_made_up_clock(*on_clock, 100_000.0, 5.0)
    assert run.state.seconds == pytest.approx(100, abs=11) and number_of(run).history[0][0] == 1


@pytest.mark.parametrize("content", ["", "0.5\0", "nan", "-3"])
def test_what_was_spent_may_be_unreadable(
    content: str, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_clock = (tmp_path, progress, monkeypatch, 60.0, lambda _: 0.2)
    with pytest.raises(Killed):
        run_on_a_made_up_clock(*on_clock, 10.0)
    (tmp_path / "elapsed.txt").write_text(content)
    assert run_on_a_made_up_clock(*on_clock).state.seconds == pytest.approx(60, abs=0.7)


def test_checkpoints_follow_the_runs_length() -> None:
    short, long, steps = TrainingBudget(None, 40.0), TrainingBudget(None, 900.0), TrainingBudget(400, None)
    assert checkpoint_interval(short, 0.0) == 2 and checkpoint_interval(short, 0.1) == pytest.approx(10)
    assert checkpoint_interval(short, 2.0) == checkpoint_interval(long, 0.0) == checkpoint_interval(steps, 0.0) == 30


@pytest.mark.parametrize(("slow_step", "lasts"), [(0, 1.0), (0, 10.0), (1, 5.0), (100, 20.0), (600, 3.0)])
def test_one_long_step_does_not_end_a_run(
    slow_step: int, lasts: float, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_on_a_made_up_clock(
        tmp_path, progress, monkeypatch, 60.0, lambda step: lasts if step == slow_step else 0.04
    )
    assert run.state.seconds == pytest.approx(60, abs=0.7)
    assert run.state.step == pytest.approx(1 + (60 - lasts) / 0.04, rel=0.02)
    seconds = 0.0
    for step, share, _ in number_of(run).history:
        seconds += lasts if step == slow_step else 0.04
        if step not in range(slow_step, slow_step + 100):
            assert share == pytest.approx(seconds / 60, abs=0.04)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_machine_that_changes_its_speed_is_followed(
    factor: float, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_on_a_made_up_clock(
        tmp_path, progress, monkeypatch, 60.0, lambda step: 0.04 if step < 500 else 0.04 * factor
    )
    assert run.state.seconds == pytest.approx(60, abs=1.0)
    assert run.state.step == pytest.approx(500 + 40 / (0.04 * factor), rel=0.05)


def test_the_pace_forgets_first_steps_and_stalls() -> None:
    speed = TrainingSpeed()
    speed.add(1.0, 4, 20.0)
    assert speed.seconds_per_step == 1.0
    for seconds in (0.04, 0.04, 0.04, 30.0):
        speed.add(seconds, 4, 20.0)
    assert speed.seconds_per_step == pytest.approx(0.06)
