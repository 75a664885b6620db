"""A watched training: what it writes and when, what it costs nobody, and how it ends early where it is asked to."""

import json
import time
from pathlib import Path

import pytest
import torch

from nerf.training.step_schedule import DECAY_START_PROGRESS
from nerf.training.trainer import NonFinite
from stages.contract import StageError
from stages.train import live, loop
from stages.train.live import FINISH, LIVE, STATE, LiveFolder, ask_to_finish, touch
from stages.train.loop import TrainingRun
from stages.train.state import TrainingBudget
from tests.stages.train.one_number import Killed, OneNumber, events, number_of, run_in

STEPS = 400


def saved(folder: Path) -> None:
    (folder / "field.json").write_text("{}")


def watchable(
    folder: Path, progress, trouble=lambda step, _: None, budget: TrainingBudget | None = None
) -> TrainingRun:
    budget = budget or TrainingBudget(STEPS, None)
    run = run_in(folder, progress, budget, lambda seed: OneNumber(seed, trouble), checkpoint_seconds=1e3)
    run.live = LiveFolder(folder, saved)
    return run


@pytest.fixture(autouse=True)
def short_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """A poll before every step, and a health that is known early."""
    monkeypatch.setattr(live, "POLL_SECONDS", 0.0)
    monkeypatch.setattr(loop, "MIN_HEALTHY_STEPS", 60)


def test_a_training_nobody_watches_writes_nothing(tmp_path: Path, progress) -> None:
    there: set[str] = set()
    run = watchable(tmp_path, progress, lambda step, _: there.update(path.name for path in (tmp_path / LIVE).iterdir()))
    run.train()
    assert there == {live.WATCHED} and not (tmp_path / LIVE).exists()


def test_who_watches_sees_state_and_field(tmp_path: Path, progress) -> None:
    told: list[dict] = []

    def watch(step: int, _: float) -> None:
        assert touch(tmp_path)
        if (file := tmp_path / LIVE / STATE).exists():
            told.append(json.loads(file.read_text()))
            assert (tmp_path / LIVE / told[-1]["field"] / "field.json").exists()

    watchable(tmp_path, progress, watch).train()
    steps = [state["step"] for state in told]
    assert steps == sorted(steps) and len(set(steps)) > 100 and 0 < told[-1]["progress"] < 1
    assert told[-1]["total_steps"] == STEPS and told[-1]["curve"][-1][1] == pytest.approx(20, abs=0.1)
    assert not touch(tmp_path) and not ask_to_finish(tmp_path), "a training that has ended is not watched"


def test_fields_cost_at_most_their_fraction_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "SNAPSHOT_SECONDS", 0.0)
    monkeypatch.setattr(live, "MAX_FRACTION", 0.1)
    folder, spent = LiveFolder(tmp_path, lambda _: time.sleep(0.01)), 0
    ends = time.monotonic() + 0.6
    while time.monotonic() < ends:
        before = list(folder.snapshots)
        folder.show({})
        spent += folder.snapshots != before
    assert 2 <= spent <= 6 and len([path for path in folder.root.iterdir() if path.is_dir()]) == live.KEPT


def test_a_full_disk_ends_no_training_and_fills_no_further(tmp_path: Path) -> None:
    tried: list[Path] = []

    def full(folder: Path) -> None:
        tried.append(folder)
        (folder / "field.safetensors").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    folder = LiveFolder(tmp_path, full)
    for step in (1, 2, 3):
        folder.show({"step": step})
    assert len(tried) == 1 and not tried[0].exists(), "the next one is not due at once"
    assert json.loads((tmp_path / LIVE / STATE).read_text()) == {"step": 3, "field": None}


def test_a_field_that_cannot_be_packed_ends_no_training(tmp_path: Path) -> None:
    def cannot(folder: Path) -> None:
        raise StageError("viewer.effect", "cannot pack the field", "no shader knows an effect", "")

    LiveFolder(tmp_path, cannot).show({"step": 1})
    assert json.loads((tmp_path / LIVE / STATE).read_text()) == {"step": 1, "field": None}


def test_what_cannot_be_touched_is_not_watched(tmp_path: Path) -> None:
    (tmp_path / LIVE).write_text("a file")
    assert not touch(tmp_path) and not ask_to_finish(tmp_path)


def test_a_figure_that_is_not_finite_ends_no_training(tmp_path: Path) -> None:
    LiveFolder(tmp_path, saved).show({"train_psnr": float("inf")})
    assert not (tmp_path / LIVE / STATE).exists()


def test_watching_changes_no_step(tmp_path: Path, progress) -> None:
    def watch(step: int, _: float) -> None:
        touch(tmp_path / "b")

    alone, watched = watchable(tmp_path / "a", progress), watchable(tmp_path / "b", progress, watch)
    alone.train()
    watched.train()
    assert torch.equal(number_of(alone).value, number_of(watched).value)


def asked_at(folder: Path, at: int, dies_at: int = -1):
    def trouble(step: int, _: float) -> None:
        time.sleep(0.001)
        if step == at:
            ask_to_finish(folder)
        if step == dies_at:
            raise Killed

    return trouble


def test_asked_to_finish_it_decays_and_ends(tmp_path: Path, progress) -> None:
    run = watchable(tmp_path, progress, asked_at(tmp_path, 89))
    run.train()
    assert run.state.step == run.schedule.total_steps == round(90 / DECAY_START_PROGRESS) == 120
    shares = [progress for _, progress, _ in number_of(run).history]
    assert shares[89] == 89 / STEPS and shares[90] == DECAY_START_PROGRESS and 0.98 < shares[119] < 1
    assert [event["total_steps"] for event in events(tmp_path) if event["event"] == "finish-requested"] == [120]
    assert progress.names("train.finish-requested", 30)


def test_a_request_waits_until_the_field_can_be_judged(tmp_path: Path, progress) -> None:
    run = watchable(tmp_path, progress, asked_at(tmp_path, 2))
    run.train()
    assert run.state.step == round(60 / DECAY_START_PROGRESS)


def test_a_request_waits_after_a_roll_back(tmp_path: Path, progress) -> None:
    """For the step of the latest revision, from which alone a schedule can be revised."""

    def trouble(step: int, lr_scale: float) -> None:
        if step == 100 and lr_scale == 1:
            run.schedule = run.schedule.revised(step, STEPS - 100, 0.25)
            ask_to_finish(tmp_path)
            raise NonFinite("loss", step, {})

    run = watchable(tmp_path, progress, trouble)
    run.train()
    assert run.schedule.revisions[-1].from_step == 100 and run.state.step == round(100 / DECAY_START_PROGRESS)


@pytest.mark.parametrize("budget", [TrainingBudget(STEPS, None), TrainingBudget(None, 60.0)])
@pytest.mark.parametrize("dies_at", [90, 100])
def test_killed_while_it_finishes_it_finishes_after_resuming(
    tmp_path: Path, progress, budget: TrainingBudget, dies_at: int
) -> None:
    whole = watchable(tmp_path / "whole", progress, asked_at(tmp_path / "whole", 89), budget)
    whole.train()
    with pytest.raises(Killed):
        watchable(tmp_path / "cut", progress, asked_at(tmp_path / "cut", 89, dies_at), budget).train()
    assert (tmp_path / "cut" / LIVE / FINISH).exists()
    resumed = watchable(tmp_path / "cut", progress, asked_at(tmp_path / "cut", 89), budget)
    resumed.train()
    assert resumed.state.step == whole.state.step == 120
    assert number_of(resumed).history[-1] == number_of(whole).history[-1]
    if budget.steps:
        assert torch.equal(number_of(resumed).value, number_of(whole).value)
