"""The loop with a field that is one number, so that every kind of trouble can be staged."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from nerf.training.trainer import NonFinite, StepResult
from stages.train import loop
from stages.train.checkpoints import latest_checkpoint
from stages.train.loop import TrainingRun
from stages.train.state import TrainingBudget
from stages.train.validation_images import Target
from tests.refusals import no_note, refused
from tests.stages.train.one_number import (
    Killed,
    OneNumber,
    events,
    held_out,
    killed_at,
    number_of,
    pixels,
    quiet,
    run_in,
)


def test_killed_and_resumed_is_the_same_as_uninterrupted(tmp_path: Path, progress) -> None:
    whole = run_in(tmp_path / "whole", progress)
    whole.train()
    with pytest.raises(Killed):
        run_in(tmp_path / "cut", progress, make=killed_at(20)).train()
    resumed = run_in(tmp_path / "cut", progress)
    resumed.train()
    assert number_of(resumed).history[0][0] == 20, "the resumed run does not start over"
    assert torch.equal(number_of(whole).value, number_of(resumed).value)
    spent = [(run.state.step, run.state.rays, run.state.colour_evaluations) for run in (whole, resumed)]
    assert spent == 2 * [(40, 160, 480)]
    assert progress.names("train.resumes", "step 20 of 40")


def test_finished_and_run_again_does_nothing(tmp_path: Path, progress) -> None:
    first = run_in(tmp_path, progress)
    first.train()
    again = run_in(tmp_path, progress)
    again.train()
    assert number_of(again).history == []
    assert again.state == first.state


def non_finite(at: int, until_rate: float) -> Callable[[int], OneNumber]:
    def trouble(step: int, lr_scale: float) -> None:
        if step == at and lr_scale > until_rate:
            raise NonFinite("loss", step, {"target": torch.full((2, 3), torch.nan)})

    return lambda attempt: OneNumber(attempt, trouble)


def test_a_non_finite_step_is_rolled_back(tmp_path: Path, progress) -> None:
    run = run_in(tmp_path, progress, make=non_finite(at=25, until_rate=0.3))
    run.train()
    assert run.state.rollbacks == 2
    assert {rate for step, _, rate in number_of(run).history if step > 25} == {0.25}
    assert [e["step"] for e in events(tmp_path) if e["event"] == "nonfinite"] == [25, 25]
    assert (tmp_path / "nonfinite_25.safetensors").is_file()
    assert progress.names("train.rolled-back", "the loss of step 25", "back to step 25")


def test_after_three_roll_backs_training_fails_by_name(tmp_path: Path, progress) -> None:
    run = run_in(tmp_path, progress, make=non_finite(at=25, until_rate=0))
    batch = tmp_path / "nonfinite_25.safetensors"
    with refused("train.diverged", "step 25", "3 roll-backs", "--train.learning-rate", batch):
        run.train()


def dying(seeds: int, opacity: float, grey: float) -> Callable[[int], OneNumber]:
    """A field that has collapsed with its first ``seeds`` seeds: of some opacity and grey all over."""

    def make(attempt: int) -> OneNumber:
        field = OneNumber(attempt, quiet)
        if attempt < seeds:
            field.opacity, field.shown = opacity, torch.tensor(grey)
        return field

    return make


@pytest.mark.parametrize(
    ("opacity", "grey", "reason"),
    [
        (1e-4, 0.25, "it is empty (mean opacity 1e-04)"),
        (1.0, 0.7, "it is no better than a flat colour (5.8 of 12.0 dB)"),
    ],
)
def test_a_collapsed_field_is_restarted_with_another_seed(
    opacity: float, grey: float, reason: str, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "MIN_HEALTHY_STEPS", 10)
    run = run_in(tmp_path, progress, make=dying(2, opacity, grey))
    run.train()
    assert (run.state.restarts, run.state.step, number_of(run).seed) == (2, 40, 2)
    assert progress.codes == ["train.restarted"] * 2 and progress.names("train.restarted", "10 steps", reason)


def test_a_field_that_stays_collapsed_fails_by_name(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "MIN_HEALTHY_STEPS", 10)
    run = run_in(tmp_path, progress, make=dying(9, opacity=0.0, grey=0.5))
    with refused("train.collapsed", "10 steps", "opacity 0e+00", "3 different seeds"):
        run.train()


def test_the_curve_ends_with_the_run_and_is_on_record(
    tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(loop.FIRST_EVALUATION, "steps", 10.0)
    run = run_in(tmp_path, progress)
    run.train()
    assert run.state.curve[-1]["step"] == 40
    assert run.state.curve[-1]["probe_psnr"] == 20.0
    measured = [e for e in events(tmp_path) if e["event"] == "evaluated"]
    assert [e["step"] for e in measured] == [point["step"] for point in run.state.curve]
    assert [point["step"] for point in run.state.curve] == [10, 15, 21, 29, 40]
    assert {"device", "threads"} & set(run.state.curve[0]) == set() and run.state.curve[0]["probe_ssim"] is None


def test_what_was_measured_of_steps_taken_back_is_forgotten(
    tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(loop.FIRST_EVALUATION, "steps", 10.0)

    def trouble(step: int, lr_scale: float) -> None:
        if step == 22 and lr_scale == 1:
            raise NonFinite("loss", step, {})

    run = run_in(tmp_path, progress, make=lambda attempt: OneNumber(attempt, trouble))
    run.next_checkpoint = math.inf
    run.train()
    assert run.state.rollbacks == 1
    assert [point["step"] for point in run.state.curve] == [10, 15, 21, 29, 40]


def test_a_field_improved_by_more_steps_is_of_use(tmp_path: Path, progress) -> None:
    first = run_in(tmp_path / "first", progress, make=dying(1, 0.0, 0.5))
    first.train()
    assert "opacity 0e+00" in str(first.state.failure_reason)
    more = run_in(tmp_path / "more", progress, TrainingBudget(20, None, tmp_path / "first"))
    more.train()
    assert more.state.failure_reason is None


def test_the_live_line_tells_step_speed_quality_and_time_left(tmp_path: Path, progress) -> None:
    run = run_in(tmp_path, progress)
    assert run._progress_line() == ("first step", 0.0)
    run.train()
    message, done = progress.updates[-1]
    assert message.startswith("step 40 · ") and message.endswith(
        " rays/s · train 20.0 dB · 20.0 dB on test pixels · 0 s left"
    )
    assert done == pytest.approx(1)


def test_times_of_minutes_are_not_told_in_seconds() -> None:
    assert "4 min 26 s" in loop.resumed_message(5, 40, 266.4)
    assert "2 min" in str(loop.lost_time_message(120.0)) and loop.lost_time_message(0.5) is None


def test_every_checkpoint_loads(tmp_path: Path, progress) -> None:
    run_in(tmp_path, progress).train()
    found = latest_checkpoint(tmp_path / "checkpoints", no_note)
    assert found is not None and found.step == 40


def finished(folder: Path, progress, steps: int = 40) -> Path:
    run_in(folder, progress, TrainingBudget(steps, None)).train()
    return folder


def test_more_steps_begin_at_the_longer_runs_rates(tmp_path: Path, progress) -> None:
    first = finished(tmp_path / "first", progress)
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    longer = run_in(tmp_path / "more", progress, TrainingBudget(20, None, first))
    longer.train()
    assert [(step, progress) for step, progress, _ in number_of(longer).history] == [
        (step, pytest.approx(step / 60)) for step in range(40, 60)
    ]
    assert (longer.state.step, longer.state.rays, longer.state.steps_before) == (60, 240, 40)
    curve = [point["step"] for point in longer.state.curve]
    assert curve == sorted(set(curve)) and curve[-1] == 60 and 40 in curve, "one curve over both"
    assert before == {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    assert progress.names("train.more", "step 40 to step 60")


def test_more_steps_in_two_pieces_are_the_same_bytes(tmp_path: Path, progress) -> None:
    first, budget = finished(tmp_path / "first", progress), TrainingBudget(20, None, tmp_path / "first")
    whole = run_in(tmp_path / "whole", progress, budget)
    whole.train()
    with pytest.raises(Killed):
        run_in(tmp_path / "cut", progress, budget, killed_at(51)).train()
    shutil.rmtree(first)  # what has begun needs the first run no more
    resumed = run_in(tmp_path / "cut", progress, budget)
    resumed.train()
    assert number_of(resumed).history[0][0] == 51
    assert torch.equal(number_of(whole).value, number_of(resumed).value)


def test_without_a_readable_state_there_is_no_more(tmp_path: Path, progress) -> None:
    first = finished(tmp_path / "first", progress)
    for path in (first / "checkpoints").glob("*.safetensors"):
        path.write_bytes(b"")
    with refused("train.no-state"):
        run_in(tmp_path / "more", progress, TrainingBudget(20, None, first))


class Rising(OneNumber):
    """Comes nearer the truth by 1 dB with every doubling of the steps, and by ``annealing`` dB as its rate falls: at
    constant rate it is at 20 dB after 500 steps."""

    annealing = 1.0

    def __init__(self) -> None:
        super().__init__(0, quiet)

    def step(self, step: int, progress: float, lr_scale: float) -> StepResult:
        result = super().step(step, progress, lr_scale)
        db = 20 + math.log2((step + 1) / 500) + self.annealing * progress
        self.shown = pixels().colours + 10 ** (-db / 20)
        return result


class RisingLess(Rising):
    """One that gains nothing by annealing."""

    annealing = 0.0


def towards(folder: Path, progress, target: float, make=Rising, steps: int = 1000) -> TrainingRun:
    run = run_in(folder, progress, TrainingBudget(steps, None), lambda attempt: make(), Target(target, held_out()))
    run.train()
    return run


def reasons(run: TrainingRun) -> list[str]:
    return [decision.reason for decision in run.schedule.revisions]


def test_a_target_ends_the_run_once_it_is_reached(tmp_path: Path, progress) -> None:
    run = towards(tmp_path, progress, 20.0)
    assert run.state.validation_psnr is not None and 20.0 <= run.state.validation_psnr < 20.3
    assert 200 < run.state.step < 400, "annealing gave the last of it"
    assert reasons(run) == ["begin", "target", "target"]
    assert run.schedule.total_steps == run.state.step == run.state.curve[-1]["step"]


def test_an_unreachable_target_takes_the_whole_budget(tmp_path: Path, progress) -> None:
    run = towards(tmp_path, progress, 30.0)
    assert run.state.step == 1000 and reasons(run) == ["begin"]
    assert run.state.validation_psnr == pytest.approx(22.0, abs=0.1)


def test_annealing_that_does_not_suffice_is_undone(tmp_path: Path, progress) -> None:
    run = towards(tmp_path, progress, 20.0, RisingLess)
    assert reasons(run)[:3] == ["begin", "target", "more"]
    assert run.state.validation_psnr is not None and 20.0 <= run.state.validation_psnr < 20.3
    back = run.schedule.revisions[2]
    assert (back.total_steps, back.progress) == (1000, back.from_step / 1000)


def more_towards(folder: Path, progress, target: float, first: Path, make=Rising) -> TrainingRun:
    run = run_in(folder, progress, TrainingBudget(600, None, first), lambda attempt: make(), Target(target, held_out()))
    run.train()
    return run


def test_a_target_that_was_reached_does_not_end_more_steps(tmp_path: Path, progress) -> None:
    class Mortal(Rising):
        def step(self, step: int, progress: float, lr_scale: float) -> StepResult:
            if step == 500:
                raise Killed
            return super().step(step, progress, lr_scale)

    first = towards(tmp_path / "first", progress, 20.0)
    with pytest.raises(Killed):
        more_towards(tmp_path / "more", progress, 20.0, tmp_path / "first", Mortal)
    more = more_towards(tmp_path / "more", progress, 20.0, tmp_path / "first")
    assert more.state.step == first.state.step + 600 and more.schedule.progress(more.state.step) == pytest.approx(1)
    assert reasons(more) == [*reasons(first), "more"]
    assert progress.codes.count("train.target-reached-before") == 1
    assert progress.names("train.target-reached-before", "20 dB")
    assert more.state.pending_target(20.0) is None and first.state.pending_target(20.0) == 20.0


def test_a_higher_target_anneals_as_if_new(tmp_path: Path, progress) -> None:
    first = towards(tmp_path / "first", progress, 20.0)
    more = more_towards(tmp_path / "more", progress, 20.8, tmp_path / "first")
    assert more.state.validation_psnr is not None and 20.8 <= more.state.validation_psnr < 21.1
    closing = more.schedule.revisions[len(first.schedule.revisions) + 1]
    seen = {e["step"]: e["psnr"] for e in events(tmp_path / "more") if e["event"] == "validated"}
    assert closing.reason == "target" and 19.8 <= seen[closing.from_step] < 20.3, "within 1 dB, not a part of that"


@pytest.mark.parametrize("at", [70, 225, 250])
def test_a_target_run_in_two_pieces_is_the_same(at: int, tmp_path: Path, progress) -> None:
    class Mortal(Rising):
        def step(self, step: int, progress: float, lr_scale: float) -> StepResult:
            if step == at:
                raise Killed
            return super().step(step, progress, lr_scale)

    whole = towards(tmp_path / "whole", progress, 20.0)
    with pytest.raises(Killed):
        towards(tmp_path / "cut", progress, 20.0, Mortal)
    resumed = towards(tmp_path / "cut", progress, 20.0)
    assert resumed.schedule == whole.schedule
    assert torch.equal(number_of(whole).value, number_of(resumed).value)
    assert [p["step"] for p in resumed.state.curve] == [p["step"] for p in whole.state.curve]
