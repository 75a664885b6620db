"""The training loop: it resumes from checkpoints, keeps to its budget, and returns no field that collapsed or diverged.

What can happen to a run, and what the loop does:

* it is killed: it resumes from the last good checkpoint; the saved step schedule gives every step the learning rate it
  had. A run in seconds continues by the clock: training since that checkpoint is lost, and its time counts as spent;
* a loss or gradient is not finite: it keeps the batch, rolls back and halves the learning rate, three times at most;
* the field has collapsed after MIN_HEALTHY_STEPS (empty, or no better than one flat colour): it restarts with another
  seed, twice at most;
* it collapses or diverges later, or at the end: back to the last checkpoint, as after a loss that is not finite. A run
  of fewer than MIN_HEALTHY_STEPS is too short to judge: it ends as undertrained, with the reason;
* it continues a finished run: from that run's last checkpoint, at the learning rate of the longer run;
* it comes near a target on validation photos: the learning rate decays early, and goes back up if that was not enough;
* somebody watches it: it writes what they see (stages/train/live.py), and finishes early where they ask for it.
"""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from safetensors.torch import save

from nerf.training.evaluation_pixels import PixelEvaluation, evaluate
from nerf.training.step_schedule import (
    DECAY_START_PROGRESS,
    ScheduleRevision,
    StepSchedule,
    new_schedule,
    next_in_series,
    revised_by_clock,
)
from nerf.training.trainer import RAY_GEOMETRY, FieldTrainer, NonFinite
from stages.contract import Progress, StageError
from stages.io.amounts import counted, duration, short_count
from stages.io.files import read_json, write_durably
from stages.io.stopwatch import live_line
from stages.train.checkpoints import (
    Checkpoint,
    TrainingFailure,
    failure_reason,
    latest_checkpoint,
    needs_full_check,
    non_finite_tensor,
    save_checkpoint,
)
from stages.train.continuation import cannot_continue
from stages.train.live import LiveFolder
from stages.train.profile import profiled_step
from stages.train.state import (
    EvaluationSets,
    RunState,
    TrainingBudget,
    TrainingLog,
    TrainingSpeed,
    checkpoint_interval,
    lost_seconds,
)
from stages.train.validation_images import Target, evaluate_held_out, load_metrics

MAX_ROLLBACKS = 3
MAX_RESTARTS = 2
MIN_HEALTHY_STEPS = 500  # from here on a field's health is checked; a healthy one beats a flat colour long before
FIRST_EVALUATION = {"seconds": 2.0, "steps": 64.0}  # of training; each next one comes later by a factor:
EVALUATION_GROWTH, TARGET_EVALUATION_GROWTH = 2**0.5, 1.1  # the second where an evaluation may end the run
MAX_EVALUATION_FRACTION = 0.05  # of the time of a run in seconds
# The PSNR that the decay phase is expected to gain (0.9 dB is the mean of 33 short runs): this far below a target it
# begins.
DECAY_GAIN_DB = 1.0
SCHEDULE_TOLERANCE = 0.01  # of a budget in seconds: how often the clock is read, and how far off a schedule may be
PROVISIONAL_STEPS = 1_000_000  # the schedule of a run in seconds until its first step has been timed
EARLY_ENDS = ("target", "finish")  # reasons of revisions after which the clock does not decide
MAX_LOST_FRACTION = 0.5  # of a run in seconds: however often it is killed, the other half is left to train in


class TrainingRun:
    """One training run in one folder. ``make_trainer(attempt)`` builds a fresh trainer; attempt 0 is the first.

    Its public attributes are the outcome once :meth:`train` has returned: ``trainer``, ``state``, ``schedule``.
    """

    def __init__(
        self,
        make_trainer: Callable[[int], FieldTrainer],
        evaluation_sets: EvaluationSets,
        budget: TrainingBudget,
        folder: Path,
        checkpoint_seconds: float | None,
        log: TrainingLog,
        progress: Progress,
    ) -> None:
        self.make_trainer, self.evaluation_sets, self.budget = make_trainer, evaluation_sets, budget
        self.folder, self.log, self.progress, self.checkpoint_seconds = folder, log, progress, checkpoint_seconds
        self.checkpoints = folder / "checkpoints"
        self.schedule_file, self.elapsed_file = folder / "schedule.json", folder / "elapsed.txt"
        self.speed, self.next_revision = TrainingSpeed(), 0.0
        self.live: LiveFolder | None = None  # of a training that may be watched
        checkpoint = latest_checkpoint(self.checkpoints, progress.note, self._restore)
        if checkpoint is None and budget.after is not None:
            self._extend(budget.after)
        elif checkpoint is None or checkpoint.step == 0:
            self._start(self.state if checkpoint else RunState())
        else:
            self._resume()
        if message := lost_time_message(self.lost):
            progress.note("train.lost-time", message)

    def train(self) -> None:
        """Train to the end of the budget. Raises StageError if the field diverges, or collapses with every seed."""
        with live_line(self.progress, self._progress_line):
            finished = False
            while not finished:
                try:
                    self._take_steps()
                    finished = self._is_finished
                except (NonFinite, TrainingFailure) as failure:
                    self._roll_back(failure)
        self._save()
        if self.live is not None:
            self.live.close()

    @property
    def _is_finished(self) -> bool:
        """Whether the last step of the schedule is taken and evaluated."""
        step, curve = self.state.step, self.state.curve
        return step == self.schedule.total_steps and bool(curve) and curve[-1]["step"] == step

    def _start(self, state: RunState) -> None:
        """Start from fresh weights; ``state`` carries over what earlier attempts cost."""
        self.state = state
        self.trainer: FieldTrainer = self.make_trainer(state.restarts)
        self.lost = lost_seconds(self.elapsed_file, state)
        steps, self.clock_budget = self._budget_limits()
        self.schedule: StepSchedule = new_schedule(steps or PROVISIONAL_STEPS)
        self._schedule_evaluation()
        self._write_schedule()
        self._save()

    def _extend(self, folder: Path) -> None:
        """Start from the end of the finished run in ``folder``, at the learning rate of the longer run."""
        checkpoint = latest_checkpoint(folder / "checkpoints", self.progress.note, remove=False)
        if checkpoint is None:
            raise cannot_continue("train.no-state", f"the last checkpoint of the training in {folder} cannot be read")
        try:
            self._restore(checkpoint)
            self.schedule = _read_schedule(folder / "schedule.json")
        except (RuntimeError, TypeError) as error:
            raise cannot_continue(
                "train.other-version", f"another version of this program made the training in {folder}: {error}"
            ) from error
        if self.state.step < self.schedule.total_steps:
            raise cannot_continue(
                "train.earlier-state",
                f"the last checkpoint of the training in {folder} cannot be read, only an earlier one",
            )
        self.state.steps_before, self.state.seconds_before = step, seconds = self.state.step, self.state.seconds
        self.state.validation_before = self.state.validation_psnr
        steps, self.clock_budget = self._budget_limits()
        if steps is None:
            assert self.budget.seconds is not None, "one of the two is given"
            steps = step + max(1, round(self.budget.seconds * step / seconds))
        self.schedule = self.schedule.extended_to(steps)
        self._write_schedule()
        self._save()
        self.log.event("extended", step, total_steps=self.schedule.total_steps)
        self.progress.note(
            "train.more", f"continuing the finished training from step {step:,} to step {self.schedule.total_steps:,}"
        )
        target = self.evaluation_sets.target
        if target is not None and self.state.pending_target(target.psnr) is None:
            self.progress.note("train.target-reached-before", target_already_reached_message(target.psnr))

    def _budget_limits(self) -> tuple[int | None, float | None]:
        """The steps or seconds after which the run ends at the latest, including those of earlier runs and without the
        seconds that were lost."""
        steps, seconds, _ = self.budget
        if steps is not None:
            return self.state.steps_before + steps, None
        assert seconds is not None, "one of the two is given"
        return None, self.state.seconds_before + seconds - min(self.lost, MAX_LOST_FRACTION * seconds)

    def _restore(self, checkpoint: Checkpoint) -> None:
        """State and trainer as of a checkpoint. Raises RuntimeError for the state of another field, TypeError for facts
        that are no run state."""
        self.state = RunState(**checkpoint.facts)
        self.trainer = self.make_trainer(self.state.restarts)
        self.trainer.load_state(checkpoint.tensors)
        self.lost = lost_seconds(self.elapsed_file, self.state)
        self._schedule_evaluation()

    def _resume(self) -> None:
        """Resume from what :meth:`_restore` found, with its schedule; a run in seconds makes later revisions again."""
        self.schedule = _read_schedule(self.schedule_file)
        _, self.clock_budget = self._budget_limits()
        left = None
        if self.clock_budget is not None:
            left = self.clock_budget - self.state.seconds
            self.schedule = self.schedule.until(self.state.step)
            self._write_schedule()
        self._schedule_checkpoint()
        self.log.event("resumed", self.state.step)
        self.progress.note("train.resumes", resumed_message(self.state.step, self.schedule.total_steps, left))

    def _take_steps(self) -> None:
        """Steps to the end of the schedule, with everything that is due between them."""
        while self.state.step < self.schedule.total_steps:
            self._take_step()
            if self.state.step == MIN_HEALTHY_STEPS and (reason := self._failure_reason()):
                self._restart(reason)
            if self._elapsed >= self.next_evaluation:
                self._check_health()
                self._evaluate()
            if self.clock_budget is not None and self._revision_is_due:
                self._revise_schedule(self.clock_budget)
            if time.monotonic() >= self.next_checkpoint:
                self._check_health()
                self._save()
            if self.live is not None and time.monotonic() >= self.live.next_poll:
                self._heed_watchers(self.live)
        self._check_final_health()
        if not self._is_finished:
            self._evaluate()

    def _take_step(self) -> None:
        started = time.perf_counter()
        progress, lr_scale = self.schedule.progress(self.state.step), 0.5**self.state.rollbacks
        take = partial(self.trainer.step, self.state.step, progress, lr_scale)
        result = profiled_step(take, self.state.step, self.state.timings, self.evaluation_sets.train.colours.device)
        seconds = time.perf_counter() - started
        self.state.step += 1
        self.state.seconds += seconds
        self.state.rays += result.rays
        self.state.colour_evaluations += result.colour_evaluations
        self.speed.add(seconds, result.rays, result.psnr)

    @property
    def _revision_is_due(self) -> bool:
        """Every SCHEDULE_TOLERANCE of the time, and before the last step: steps may have become faster."""
        last = self.state.step >= self.schedule.total_steps - 1
        return self.speed.count > 1 and (last or self.state.seconds >= self.next_revision)

    def _revise_schedule(self, budget: float) -> None:
        """Fit the number of steps to the time left. Never rewrites an earlier revision (after a roll-back)."""
        step, tolerance = self.state.step, SCHEDULE_TOLERANCE * (budget - self.state.seconds_before)
        self.next_revision = self.state.seconds + tolerance
        self.elapsed_file.write_text(f"{self.state.seconds + self.lost:.3f}")
        last = self.schedule.revisions[-1]
        if not last.from_step <= step < self.schedule.total_steps or last.reason in EARLY_ENDS:
            return
        speed = 1 / self.speed.seconds_per_step
        schedule = revised_by_clock(self.schedule, step, self.state.seconds, budget, speed, tolerance)
        if schedule is not self.schedule:
            self.schedule = schedule
            self._write_schedule()
            self.log.event("schedule-revised", step, total_steps=schedule.total_steps)

    def _evaluate(self) -> None:
        """Add a point to the curve. It is no training time and does not influence training."""
        load_metrics()
        started = time.perf_counter()
        test = evaluate_held_out(self.trainer, self.evaluation_sets.test) if self.evaluation_sets.test else None
        # Right after a kill at the very end there is no batch PSNR yet.
        train = self.speed.psnr if self.speed.count else self._evaluate_training().psnr
        point = {"step": self.state.step, "seconds": round(self.state.seconds, 3), "train_psnr": round(train, 3)}
        point["probe_psnr"] = None if test is None else round(test.psnr, 3)
        point["probe_ssim"] = None if test is None or test.ssim is None else round(test.ssim, 4)
        self.state.curve.append(point)
        self.log.point(point)
        if self.evaluation_sets.target is not None:
            self._adapt_to_target(self.evaluation_sets.target)
        self._schedule_evaluation(time.perf_counter() - started)

    @property
    def _elapsed(self) -> float:
        """What spaces the evaluations: steps of a run in steps, which must not depend on the clock, else seconds."""
        return self.state.seconds if self.budget.steps is None else float(self.state.step)

    def _schedule_evaluation(self, cost: float = 0.0) -> None:
        """Decide when to evaluate next; the last evaluation took ``cost`` seconds."""
        growth = EVALUATION_GROWTH if self.evaluation_sets.target is None else TARGET_EVALUATION_GROWTH
        kind = "seconds" if self.budget.steps is None else "steps"
        self.next_evaluation = next_in_series(self._elapsed, FIRST_EVALUATION[kind], growth)
        if kind == "seconds":
            self.next_evaluation = max(self.next_evaluation, self._elapsed + cost / MAX_EVALUATION_FRACTION)

    def _adapt_to_target(self, target: Target) -> None:
        """Stop if the validation photos reach the target; begin the decay phase if that may be enough; train on if it
        was not and there is time. Revisions already in the schedule are not made again."""
        step, last = self.state.step, self.schedule.revisions[-1]
        self.state.validation_psnr = round(evaluate_held_out(self.trainer, target.held_out).psnr, 3)
        self.log.event("validated", step, psnr=self.state.validation_psnr)
        if step <= last.from_step or self.state.pending_target(target.psnr) is None:
            return
        own = (revision for revision in self.schedule.revisions if revision.from_step > self.state.steps_before)
        failed = sum(revision.reason == "target" for revision in own)
        missing = target.psnr - self.state.validation_psnr
        schedule = self.schedule
        if missing <= 0:
            schedule = schedule.ended_at(step)
        elif step == schedule.total_steps:
            if last.reason == "target" and self._max_steps() > step:
                schedule = schedule.extended_to(self._max_steps())
        elif missing <= DECAY_GAIN_DB / 2**failed and schedule.progress(step) < DECAY_START_PROGRESS:
            schedule = schedule.with_decay_from(step)
        if schedule is not self.schedule:
            self.schedule = schedule
            self._write_schedule()
            self.log.event("target-revision", step, total_steps=schedule.total_steps)
            if schedule.total_steps > step:
                self.progress.note("train.target-revision", target_revision_message(self.state, target.psnr, schedule))

    def _heed_watchers(self, live: LiveFolder) -> None:
        """Show those who watch how it stands, and finish early where they ask for it. Before MIN_HEALTHY_STEPS nobody
        could tell whether the field is sound, and after a roll-back the schedule has no revision until its latest: a
        request waits until then."""
        last = self.schedule.revisions[-1]
        wanted = live.is_asked_to_finish and last.reason != "finish"
        if wanted and max(MIN_HEALTHY_STEPS, last.from_step) <= self.state.step < last.total_steps:
            self._finish_early()
        if live.is_watched() and self.speed.count:
            live.show(self._live_state())

    def _finish_early(self) -> None:
        """Begin the decay phase. The checkpoint comes first: a run in seconds that is resumed keeps no revision beyond
        its checkpoint."""
        self._check_health()
        self._save()
        self.schedule = self.schedule.with_decay_from(self.state.step, "finish")
        self._write_schedule()
        self.log.event("finish-requested", self.state.step, total_steps=self.schedule.total_steps)
        steps = self.schedule.total_steps - self.state.step
        self.progress.note(
            "train.finish-requested", f"asked to finish: the learning rate decays over {steps:,} more steps"
        )

    def _live_state(self) -> dict[str, Any]:
        """What a watcher is told."""
        state, schedule = self.state, self.schedule
        return {
            "step": state.step,
            "total_steps": schedule.total_steps,
            "progress": schedule.progress(state.step),
            "seconds": state.seconds,
            "seconds_left": self._seconds_left(),
            "rays_per_second": self.speed.rays_per_step / self.speed.seconds_per_step,
            "train_psnr": self.speed.psnr,
            "curve": [[point["seconds"], point["probe_psnr"], point["train_psnr"]] for point in state.curve],
            "finishing": schedule.revisions[-1].reason == "finish",
        }

    def _max_steps(self) -> int:
        """How many steps the budget allows for."""
        steps, seconds = self._budget_limits()
        if steps is not None:
            return steps
        assert seconds is not None, "one of the two is given"
        per_step = self.speed.seconds_per_step or self.state.seconds / self.state.step
        return self.state.step + int((seconds - self.state.seconds) / per_step)

    def _save(self) -> None:
        started = time.monotonic()
        save_checkpoint(self.checkpoints, Checkpoint(self.state.step, self.trainer.state(), asdict(self.state)))
        self._schedule_checkpoint(time.monotonic() - started)

    def _schedule_checkpoint(self, cost: float = 0.0) -> None:
        self.next_checkpoint = time.monotonic() + (self.checkpoint_seconds or checkpoint_interval(self.budget, cost))

    def _write_schedule(self) -> None:
        write_durably(self.schedule_file, json.dumps(self.schedule.revisions).encode())

    def _check_health(self) -> None:
        """Before the state is saved: raise TrainingFailure if it is not finite or, from MIN_HEALTHY_STEPS on, the field
        has collapsed."""
        if name := non_finite_tensor(self.trainer):
            steps = counted(self.state.step, "step")
            raise TrainingFailure(f"after {steps} the field has diverged: its {name} is not finite")
        if self.state.step > MIN_HEALTHY_STEPS and needs_full_check(self.speed.psnr, self.evaluation_sets.train):
            self._check_health_fully()

    def _failure_reason(self) -> str | None:
        return failure_reason(self.trainer, self.evaluation_sets.train)

    def _check_final_health(self) -> None:
        self._check_health()
        self.state.failure_reason = None
        if self.state.step >= MIN_HEALTHY_STEPS:
            self._check_health_fully()
        elif reason := self._failure_reason():
            self.state.failure_reason = reason
            self.log.event("undertrained", self.state.step, reason=reason)
            self.progress.note(
                "train.undertrained",
                f"after {self.state.step:,} steps the field is undertrained: {reason}; train longer",
            )

    def _check_health_fully(self) -> None:
        if reason := self._failure_reason():
            raise TrainingFailure(f"after {self.state.step:,} steps the field has collapsed: {reason}")

    def _roll_back(self, failure: NonFinite | TrainingFailure) -> None:
        """Keep the batch, return to the last good checkpoint and halve the learning rate. Raises StageError after
        MAX_ROLLBACKS."""
        hint = self._log_failure(failure)
        rollbacks = self.state.rollbacks + 1
        if rollbacks > MAX_ROLLBACKS:
            why = f"{failure}, after {MAX_ROLLBACKS} roll-backs that each halved the learning rate"
            raise StageError("train.diverged", "training diverged", why, hint)
        checkpoint = latest_checkpoint(self.checkpoints, self.progress.note, self._load_healthy)
        if checkpoint is None and self.budget.after is not None:
            self._extend(self.budget.after)
            self.state.rollbacks = rollbacks
        elif checkpoint is None:
            self._start(self.state.restarted(self.state.restarts, rollbacks))
        else:
            self.state.step, self.state.rollbacks = checkpoint.step, rollbacks
            self.state.curve = [point for point in self.state.curve if point["step"] <= checkpoint.step]
            self._schedule_evaluation()
        self.progress.note(
            "train.rolled-back", f"{failure}: back to step {self.state.step:,} at half the learning rate"
        )

    def _load_healthy(self, checkpoint: Checkpoint) -> None:
        """Restore it. Raises TrainingFailure if its field had collapsed: the batch PSNR shows that only seconds
        later."""
        self.trainer.load_state(checkpoint.tensors)
        if checkpoint.step > MIN_HEALTHY_STEPS and (reason := self._failure_reason()):
            raise TrainingFailure(reason)

    def _log_failure(self, failure: NonFinite | TrainingFailure) -> str:
        """Log the failure and save the batch of a non-finite one; returns what the user may try."""
        slower = "Try a tenth of --train.learning-rate"
        if isinstance(failure, TrainingFailure):
            self.log.event("failed", self.state.step, reason=str(failure))
            return f"{slower}."
        name = f"nonfinite_{failure.step}.safetensors"
        (self.folder / name).write_bytes(save({key: tensor.contiguous() for key, tensor in failure.batch.items()}))
        self.log.event("nonfinite", failure.step, quantity=failure.quantity, batch=name)
        advice = "Check the cameras, which give the rays" if failure.quantity == RAY_GEOMETRY else slower
        return f"{advice}; the batch is kept in {self.folder / name}."

    def _evaluate_training(self) -> PixelEvaluation:
        return evaluate(self.trainer.model, self.evaluation_sets.train, self.trainer.effects)

    def _restart(self, reason: str) -> None:
        """Restart with another seed. Raises StageError after MAX_RESTARTS."""
        self.log.event("collapsed", self.state.step, reason=reason)
        restarts = self.state.restarts + 1
        if restarts > MAX_RESTARTS:
            why = f"after {MIN_HEALTHY_STEPS} steps {reason}, with {restarts} different seeds"
            hint = "Check the cameras: the photos may not fit their poses. Or try a tenth of --train.learning-rate."
            raise StageError("train.collapsed", "the field does not learn", why, hint)
        self.progress.note(
            "train.restarted",
            f"after {MIN_HEALTHY_STEPS} steps the field has collapsed: {reason}; restarting with another seed",
        )
        shutil.rmtree(self.checkpoints)
        self._start(self.state.restarted(restarts, rollbacks=0))

    def _progress_line(self) -> tuple[str, float]:
        """The live line, and the progress of the run."""
        if not self.speed.count:
            return "first step", 0.0
        message = speed_message(self.state, self.speed, self._seconds_left())
        return message, self.schedule.progress(self.state.step)

    def _seconds_left(self) -> float:
        """Until the last step, by the speed so far; by the clock where that ends the run."""
        left = (self.schedule.total_steps - self.state.step) * self.speed.seconds_per_step
        if self.clock_budget is None or self.schedule.revisions[-1].reason in EARLY_ENDS:
            return left
        return max(0.0, self.clock_budget - self.state.seconds)


def speed_message(state: RunState, speed: TrainingSpeed, left: float) -> str:
    """Step, speed, quality and the seconds left of a run whose speed is known."""
    known = [point["probe_psnr"] for point in state.curve if point["probe_psnr"] is not None]
    test = f" · {known[-1]:.1f} dB on test pixels" if known else ""
    rays = f"{short_count(speed.rays_per_step / speed.seconds_per_step)} rays/s"
    return f"step {state.step:,} · {rays} · train {speed.psnr:.1f} dB{test} · {duration(left)} left"


def resumed_message(step: int, total_steps: int, left: float | None) -> str:
    """After a kill; ``left``: the seconds left of a run in seconds."""
    rest = f" of {total_steps:,}" if left is None else f", with {duration(max(0.0, left))} of training left"
    return f"resuming from step {step:,}{rest}"


def _read_schedule(file: Path) -> StepSchedule:
    return StepSchedule(tuple(ScheduleRevision(*revision) for revision in read_json(file)))


def lost_time_message(seconds: float) -> str | None:
    """What a kill cost; None below a second."""
    if seconds < 1:
        return None
    return f"{duration(seconds)} of training after the last checkpoint are lost and count as spent"


def target_already_reached_message(target_psnr: float) -> str:
    """That a target which the finished run has reached does not end its continuation."""
    return f"{target_psnr:g} dB are already reached: training goes on to the end of the additional time"


def target_revision_message(state: RunState, target_psnr: float, schedule: StepSchedule) -> str:
    """That the learning rate decays before the end, or goes back up, to reach a target."""
    quality = f"{state.validation_psnr:.1f} of {target_psnr:g} dB on validation photos after {state.step:,} steps"
    steps = f"{schedule.total_steps - state.step:,} more steps"
    if schedule.revisions[-1].reason == "target":
        return f"{quality}: the learning rate decays over {steps}"
    return f"{quality}: training continues for {steps}"
