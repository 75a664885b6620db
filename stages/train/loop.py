"""The training loop: goes on from a checkpoint, keeps to its budget, and does not let a sick field pass for a result.

What can happen to a run, and what the loop does:

* killed: goes on from the last good checkpoint; the journal of step plans gives every step its old learning rate. A
  run in seconds goes on by the clock: what was trained since that checkpoint is lost, and its time is spent;
* a loss or gradient stops being finite: the batch is kept, the state rolled back and the rate halved, three times;
* the field is dead after the warm-up (empty, or no better than one flat colour): another seed, twice at most;
* it is so later, or at the end: back to the last checkpoint, like after a loss that is not finite. A run that ends
  within the warm-up is too short to judge: it ends, and says aloud what is wrong with it;
* it goes on from the end of a finished run: from that run's last checkpoint, at the rates of the longer run;
* it comes near a target on validation photos: it anneals early, and goes on as before if that was not enough.
"""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

from safetensors.torch import save

from nerf.training.schedule import CLOSING_SHARE, ScheduleRevision, StepSchedule, next_in_series, replanned, schedule_of
from nerf.training.trainer import RAYS, FieldTrainer, NonFinite
from nerf.training.validation_probe import ProbeResult, measure
from stages.amounts import short_count
from stages.contract import Progress, StageError
from stages.io.files import read_json, write_durably
from stages.io.live_line import live_line
from stages.train.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from stages.train.health_check import Lost, is_suspicious, not_finite, symptom_of
from stages.train.more import cannot_go_on
from stages.train.profile import observed
from stages.train.state import Pace, Probes, RunState, TrainingBudget, TrainingLog, checkpoint_interval, lost_seconds
from stages.train.validation_images import Target, load_metrics, look

MAX_ROLLBACKS = 3
MAX_RESTARTS = 2
WARM_UP_STEPS = 500  # after these a field is examined; a healthy one beats a flat colour long before
FIRST_MEASUREMENT = {"seconds": 2.0, "steps": 64.0}  # of training; the next follow at so many times that, and so on:
MEASUREMENT_GROWTH, TARGET_GROWTH = 2**0.5, 1.1  # the second where a measurement may end the run
MAX_MEASURING = 0.05  # of a run in seconds: the share of the time that may go into measuring
# By how much PSNR may be expected to rise while the rate falls (0.9 dB is the mean of 33 short runs): so far below a
# target a run anneals.
ANNEALING_DB = 1.0
PLAN_SHARE = 0.01  # of a budget in seconds: how often the clock is looked at, and how far off a plan may be
PROVISIONAL_STEPS = 1_000_000  # the plan of a run in seconds until its first step has been timed
MAX_LOST = 0.5  # of a run in seconds: however often it is killed, it has the other half to come to something


class TrainingRun:
    """One training run in one folder. ``make_trainer(attempt)`` builds a fresh trainer; attempt 0 is the first.

    Its public attributes are the outcome once :meth:`train` has returned: ``trainer``, ``state``, ``plan``.
    """

    def __init__(
        self,
        make_trainer: Callable[[int], FieldTrainer],
        probes: Probes,
        budget: TrainingBudget,
        folder: Path,
        checkpoint_seconds: float | None,
        log: TrainingLog,
        progress: Progress,
    ) -> None:
        self.make_trainer, self.probes, self.budget = make_trainer, probes, budget
        self.folder, self.log, self.progress, self.checkpoint_seconds = folder, log, progress, checkpoint_seconds
        self.checkpoints, self.journal, self.spent = folder / "checkpoints", folder / "plan.json", folder / "spent.txt"
        self.pace, self.next_planning = Pace(), 0.0
        checkpoint = latest_checkpoint(self.checkpoints, progress.note, self._fits)
        if checkpoint is None and budget.after is not None:
            self._go_on(budget.after)
        elif checkpoint is None or checkpoint.step == 0:
            self._begin(RunState(**checkpoint.facts) if checkpoint else RunState())
        else:
            self._resume(checkpoint)
        if words := lost_words(self.lost):
            progress.note("train.lost-time", words)

    def train(self) -> None:
        """Train to the end of the budget. Raises StageError where the field diverges or stays dead."""
        with live_line(self.progress, self._describe):
            over = False
            while not over:
                try:
                    self._take_steps()
                    over = self._is_over
                except (NonFinite, Lost) as fault:
                    self._roll_back(fault)
        self._save()

    @property
    def _is_over(self) -> bool:
        """Whether the last step of the plan is taken and measured."""
        step, curve = self.state.step, self.state.curve
        return step == self.plan.total_steps and bool(curve) and curve[-1]["step"] == step

    def _begin(self, state: RunState) -> None:
        """Start from fresh weights; ``state`` carries over what earlier attempts cost."""
        self.state = state
        self.trainer: FieldTrainer = self.make_trainer(state.restarts)
        self.lost = lost_seconds(self.spent, state)
        steps, self.clock_budget = self._limits()
        self.plan: StepSchedule = schedule_of(steps or PROVISIONAL_STEPS)
        self._plan_measurement()
        self._write_journal()
        self._save()

    def _go_on(self, folder: Path) -> None:
        """Start from the end of the finished run in ``folder``, at the rate that the longer run would have there."""
        checkpoint = latest_checkpoint(folder / "checkpoints", self.progress.note, remove=False)
        if checkpoint is None:
            raise cannot_go_on("train.no-state", f"the last state of the training in {folder} cannot be read")
        try:
            self._load(checkpoint, folder / "plan.json")
        except (RuntimeError, TypeError) as error:
            raise cannot_go_on(
                "train.other-version", f"the training in {folder} is of another version of this program: {error}"
            ) from error
        if self.state.step < self.plan.total_steps:
            raise cannot_go_on(
                "train.earlier-state", f"the last state of the training in {folder} cannot be read, only an earlier one"
            )
        self.state.steps_before, self.state.seconds_before = step, seconds = self.state.step, self.state.seconds
        self.state.validation_before = self.state.validation_psnr
        steps, self.clock_budget = self._limits()
        if steps is None:
            assert self.budget.seconds is not None, "one of the two is given"
            steps = step + max(1, round(self.budget.seconds * step / seconds))
        self.plan = self.plan.extended(steps)
        self._write_journal()
        self._save()
        self.log.event("extended", step, total_steps=self.plan.total_steps)
        self.progress.note(
            "train.more", f"going on from the {step:,} steps of the finished training, in {self.plan.total_steps:,}"
        )
        if self.probes.target is not None and self.state.open_target(self.probes.target.psnr) is None:
            self.progress.note("train.target-reached-before", reached_before_words(self.probes.target.psnr))

    def _limits(self) -> tuple[int | None, float | None]:
        """The steps or seconds after which the run ends at the latest, those of earlier runs included; of the seconds
        less what was lost."""
        steps, seconds, _ = self.budget
        if steps is not None:
            return self.state.steps_before + steps, None
        assert seconds is not None, "one of the two is given"
        return None, self.state.seconds_before + seconds - min(self.lost, MAX_LOST * seconds)

    def _fits(self, checkpoint: Checkpoint) -> None:
        """Raise RuntimeError for the state of another field, TypeError for facts that are not a run's."""
        self.make_trainer(RunState(**checkpoint.facts).restarts).load_state(checkpoint.tensors)

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint by the plan that held there; a run in seconds decides anew what it decided later."""
        self._load(checkpoint, self.journal)
        _, self.clock_budget = self._limits()
        left = None
        if self.clock_budget is not None:
            left = self.clock_budget - self.state.seconds
            self.plan = self.plan.until(self.state.step)
            self._write_journal()
        self._plan_checkpoint()
        self.log.event("resumed", self.state.step)
        self.progress.note("train.resumes", going_on_words(self.state.step, self.plan.total_steps, left))

    def _load(self, checkpoint: Checkpoint, journal: Path) -> None:
        self.state = RunState(**checkpoint.facts)
        self.trainer = self.make_trainer(self.state.restarts)
        self.trainer.load_state(checkpoint.tensors)
        self.plan = StepSchedule(tuple(ScheduleRevision(*decision) for decision in read_json(journal)))
        self.lost = lost_seconds(self.spent, self.state)
        self._plan_measurement()

    def _take_steps(self) -> None:
        """Steps to the end of the plan, with everything that is due between them."""
        while self.state.step < self.plan.total_steps:
            self._take_step()
            if self.state.step == WARM_UP_STEPS and (symptom := symptom_of(self.trainer, self.probes.train)):
                self._restart(symptom)
            if self._elapsed >= self.next_measurement:
                self._examine()
                self._measure()
            if self.clock_budget is not None and self._planning_is_due:
                self._replan(self.clock_budget)
            if time.monotonic() >= self.next_checkpoint:
                self._examine()
                self._save()
        self._examine_at_the_end()
        if not self._is_over:
            self._measure()

    def _take_step(self) -> None:
        started = time.perf_counter()
        share, scale = self.plan.progress(self.state.step), 0.5**self.state.rollbacks
        take = partial(self.trainer.step, self.state.step, share, scale)
        result = observed(take, self.state.step, self.state.timings, self.probes.train.colours.device)
        seconds = time.perf_counter() - started
        self.state.step += 1
        self.state.seconds += seconds
        self.state.rays += result.rays
        self.state.samples += result.samples
        self.pace.add(seconds, result.rays, result.psnr)

    @property
    def _planning_is_due(self) -> bool:
        """Every hundredth of the time, and before the last step: it may have been planned when steps took longer."""
        last = self.state.step >= self.plan.total_steps - 1
        return self.pace.count > 1 and (last or self.state.seconds >= self.next_planning)

    def _replan(self, budget: float) -> None:
        """Fit the number of steps to the time left. Never rewrites a decision (after a roll-back, that is)."""
        step, tolerance = self.state.step, PLAN_SHARE * (budget - self.state.seconds_before)
        self.next_planning = self.state.seconds + tolerance
        self.spent.write_text(f"{self.state.seconds + self.lost:.3f}")
        last = self.plan.decisions[-1]
        if not last.from_step <= step < self.plan.total_steps or last.reason == "target":
            return
        plan = replanned(self.plan, step, self.state.seconds, budget, 1 / self.pace.seconds_per_step, tolerance)
        if plan is not self.plan:
            self.plan = plan
            self._write_journal()
            self.log.event("planned", step, total_steps=plan.total_steps)

    def _measure(self) -> None:
        """Add a point to the curve. Not training time, and without influence on what is trained."""
        load_metrics()
        started = time.perf_counter()
        seen = look(self.trainer, self.probes.test) if self.probes.test else None
        # Right after a kill at the very end no step has told how well the batches go.
        train = self.pace.psnr if self.pace.count else self._on_training_photos().psnr
        point = {"step": self.state.step, "seconds": round(self.state.seconds, 3), "train_psnr": round(train, 3)}
        point["probe_psnr"] = None if seen is None else round(seen.psnr, 3)
        point["probe_ssim"] = None if seen is None or seen.ssim is None else round(seen.ssim, 4)
        self.state.curve.append(point)
        self.log.point(point)
        if self.probes.target is not None:
            self._steer(self.probes.target)
        self._plan_measurement(time.perf_counter() - started)

    @property
    def _elapsed(self) -> float:
        """What measurements are spaced by: steps where these are counted, so that nothing depends on the clock."""
        return self.state.seconds if self.budget.steps is None else float(self.state.step)

    def _plan_measurement(self, cost: float = 0.0) -> None:
        """Decide when to measure next; the last time took ``cost`` seconds."""
        growth = MEASUREMENT_GROWTH if self.probes.target is None else TARGET_GROWTH
        kind = "seconds" if self.budget.steps is None else "steps"
        self.next_measurement = next_in_series(self._elapsed, FIRST_MEASUREMENT[kind], growth)
        if kind == "seconds":
            self.next_measurement = max(self.next_measurement, self._elapsed + cost / MAX_MEASURING)

    def _steer(self, target: Target) -> None:
        """Stop where the validation photos are as good as wanted; anneal where that may be all it takes; go on as
        before where it was not enough and there is time. Decisions already in the plan are not made again."""
        step, decided = self.state.step, self.plan.decisions[-1]
        self.state.validation_psnr = round(look(self.trainer, target.photos).psnr, 3)
        self.log.event("validated", step, psnr=self.state.validation_psnr)
        if step <= decided.from_step or self.state.open_target(target.psnr) is None:
            return
        own = (decision for decision in self.plan.decisions if decision.from_step > self.state.steps_before)
        failed = sum(decision.reason == "target" for decision in own)
        missing = target.psnr - self.state.validation_psnr
        plan = self.plan
        if missing <= 0:
            plan = plan.ended(step)
        elif step == plan.total_steps:
            if decided.reason == "target" and self._most_steps() > step:
                plan = plan.extended(self._most_steps())
        elif missing <= ANNEALING_DB / 2**failed and plan.progress(step) < CLOSING_SHARE:
            plan = plan.closing(step)
        if plan is not self.plan:
            self.plan = plan
            self._write_journal()
            self.log.event("steered", step, total_steps=plan.total_steps)
            if plan.total_steps > step:
                self.progress.note("train.target-steering", steering_words(self.state, target.psnr, plan))

    def _most_steps(self) -> int:
        """How many steps the budget allows for."""
        steps, seconds = self._limits()
        if steps is not None:
            return steps
        assert seconds is not None, "one of the two is given"
        per_step = self.pace.seconds_per_step or self.state.seconds / self.state.step
        return self.state.step + int((seconds - self.state.seconds) / per_step)

    def _save(self) -> None:
        started = time.monotonic()
        save_checkpoint(self.checkpoints, Checkpoint(self.state.step, self.trainer.state(), asdict(self.state)))
        self._plan_checkpoint(time.monotonic() - started)

    def _plan_checkpoint(self, cost: float = 0.0) -> None:
        self.next_checkpoint = time.monotonic() + (self.checkpoint_seconds or checkpoint_interval(self.budget, cost))

    def _write_journal(self) -> None:
        write_durably(self.journal, json.dumps(self.plan.decisions).encode())

    def _examine(self) -> None:
        """Before the state is kept: raise Lost where it is not finite or, the warm-up being over, the field is dead."""
        if name := not_finite(self.trainer):
            raise Lost(f"after {self.state.step:,} steps the field is lost: its {name} is not finite")
        if self.state.step > WARM_UP_STEPS and is_suspicious(self.pace.psnr, self.probes.train):
            self._examine_fully()

    def _examine_at_the_end(self) -> None:
        self._examine()
        self.state.symptom = None
        if self.state.step >= WARM_UP_STEPS:
            self._examine_fully()
        elif symptom := symptom_of(self.trainer, self.probes.train):
            self.state.symptom = symptom
            self.log.event("unripe", self.state.step, symptom=symptom)
            self.progress.note(
                "train.undertrained",
                f"after {self.state.step:,} steps the field is of no use yet: {symptom}; train longer",
            )

    def _examine_fully(self) -> None:
        if symptom := symptom_of(self.trainer, self.probes.train):
            raise Lost(f"after {self.state.step:,} steps the field is lost: {symptom}")

    def _roll_back(self, fault: NonFinite | Lost) -> None:
        """Keep the batch, return to the last good checkpoint and halve the rate; give up by name after the third."""
        hint = self._on_record(fault)
        rollbacks = self.state.rollbacks + 1
        if rollbacks > MAX_ROLLBACKS:
            why = f"{fault}, after {MAX_ROLLBACKS} roll-backs that each halved the learning rate"
            raise StageError("train.diverged", "training diverged", why, hint)
        checkpoint = latest_checkpoint(self.checkpoints, self.progress.note, self._load_sound)
        if checkpoint is None and self.budget.after is not None:
            self._go_on(self.budget.after)
            self.state.rollbacks = rollbacks
        elif checkpoint is None:
            self._begin(self.state.anew(self.state.restarts, rollbacks))
        else:
            self.state.step, self.state.rollbacks = checkpoint.step, rollbacks
            self.state.curve = [point for point in self.state.curve if point["step"] <= checkpoint.step]
            self._plan_measurement()
        self.progress.note("train.rolled-back", f"{fault}: back to step {self.state.step:,} at half the learning rate")

    def _load_sound(self, checkpoint: Checkpoint) -> None:
        """Go back to it. Raises Lost where the field was dead already, as its batches tell only seconds later."""
        self.trainer.load_state(checkpoint.tensors)
        if checkpoint.step > WARM_UP_STEPS and (symptom := symptom_of(self.trainer, self.probes.train)):
            raise Lost(symptom)

    def _on_record(self, fault: NonFinite | Lost) -> str:
        """Log the fault, and keep the batch of one that has it; what the user may try."""
        slower = "Try a tenth of --train.learning-rate"
        if isinstance(fault, Lost):
            self.log.event("lost", self.state.step, symptom=str(fault))
            return f"{slower}."
        name = f"nonfinite_{fault.step}.safetensors"
        (self.folder / name).write_bytes(save({key: tensor.contiguous() for key, tensor in fault.batch.items()}))
        self.log.event("nonfinite", fault.step, quantity=fault.quantity, batch=name)
        advice = "Check the cameras, which give the rays" if fault.quantity == RAYS else slower
        return f"{advice}; the batch is kept in {self.folder / name}."

    def _on_training_photos(self) -> ProbeResult:
        return measure(self.trainer.model, self.probes.train, self.trainer.effects)

    def _restart(self, symptom: str) -> None:
        """Begin anew with another seed; give up by name after the second."""
        self.log.event("dead", self.state.step, symptom=symptom)
        restarts = self.state.restarts + 1
        if restarts > MAX_RESTARTS:
            why = f"after {WARM_UP_STEPS} steps {symptom}, with {restarts} different seeds"
            hint = "Check the cameras: the photos may not fit their poses. Or try a tenth of --train.learning-rate."
            raise StageError("train.collapsed", "the field does not learn", why, hint)
        self.progress.note(
            "train.restarted", f"after {WARM_UP_STEPS} steps the field is dead: {symptom}; starting with another seed"
        )
        shutil.rmtree(self.checkpoints)
        self._begin(self.state.anew(restarts, rollbacks=0))

    def _describe(self) -> tuple[str, float]:
        """The live line, and the share of the run that is done."""
        if not self.pace.count:
            return "first step", 0.0
        left = (self.plan.total_steps - self.state.step) * self.pace.seconds_per_step
        if self.clock_budget is not None:
            left = max(0.0, self.clock_budget - self.state.seconds)
        return live_words(self.state, self.pace, left), self.plan.progress(self.state.step)


def live_words(state: RunState, pace: Pace, left: float) -> str:
    """Step, speed, quality and the seconds left; of a run that knows its pace."""
    measured = [point["probe_psnr"] for point in state.curve if point["probe_psnr"] is not None]
    test = f" · {measured[-1]:.1f} dB on test pixels" if measured else ""
    speed = f"{short_count(pace.rays_per_step / pace.seconds_per_step)} rays/s"
    return f"step {state.step:,} · {speed} · train {pace.psnr:.1f} dB{test} · {left:.0f} s left"


def going_on_words(step: int, total_steps: int, left: float | None) -> str:
    """After a kill; ``left``: seconds, where it is these that count."""
    much = f" of {total_steps:,}" if left is None else f", with {max(0.0, left):.0f} s of training left"
    return f"going on from step {step:,}{much}"


def lost_words(seconds: float) -> str | None:
    """What a kill cost; None where it is next to nothing."""
    return (
        f"{seconds:.0f} s of training after the last checkpoint are lost, and count as spent" if seconds >= 1 else None
    )


def reached_before_words(target_psnr: float) -> str:
    """That a target which a finished run has reached does not end the one that goes on from it."""
    return f"{target_psnr:g} dB are reached already: training goes on for all that was asked for"


def steering_words(state: RunState, target_psnr: float, plan: StepSchedule) -> str:
    """That the rate falls before the end, or goes back up, with a target in mind."""
    seen = f"{state.validation_psnr:.1f} of {target_psnr:g} dB on validation photos after {state.step:,} steps"
    and_now = "annealing over" if plan.decisions[-1].reason == "target" else "going on for"
    return f"{seen}: {and_now} {plan.total_steps - state.step:,} more"
