"""The training loop: goes on from a checkpoint, keeps to its budget, and does not let a sick field pass for a result.

What can happen to a run, and what the loop does:

* killed: goes on from the last good checkpoint; the journal of step plans gives every step its old learning rate;
* a loss or gradient stops being finite: the batch is kept, the state rolled back and the rate halved, three times;
* the field is dead after the warm-up (empty, or no better than one flat colour): another seed, twice at most.
"""

import json
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from stages.contract import Progress, StageError
from stages.files import read_json, write_durably
from stages.live_line import live_line, short_count

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.probe import Probe, ProbeResult
    from nerf.schedule import StepPlan
    from nerf.training import FieldTrainer, NonFinite
    from stages.training_log import TrainingLog

MOST_ROLLBACKS = 3
MOST_RESTARTS = 2
WARM_UP_STEPS = 500  # after these a field is examined; a healthy one beats a flat colour long before
EMPTY_OPACITY = 1e-3  # a field whose mean opacity is below this shows nothing but background
FIRST_MEASUREMENT = 2.0  # training seconds; the next ones follow at 1.5 times that, and so on
MEASUREMENT_GROWTH = 1.5
MOST_MEASURING = 0.1  # share of the time that may go into measuring
PLAN_SHARE = 0.01  # of a budget in seconds: how often the clock is looked at, and how far off a plan may be
PROVISIONAL_STEPS = 1_000_000  # the plan of a run in seconds until its first step has been timed
RATE_MEMORY_SECONDS = 5.0  # how far back the measured speed and the shown PSNR look


class Budget(NamedTuple):
    """How long to train: exactly one of the two is given. Seconds count training steps alone."""

    steps: int | None
    seconds: float | None


class Probes(NamedTuple):
    """Fixed pixels to measure on; ``heldout`` is None without test photos, is reported and decides nothing.
    ``neighbours`` (test photos, training photos): how much these tell of those."""

    train: "Probe"
    heldout: "Probe | None" = None
    neighbours: "Tensor | None" = None


@dataclass
class RunState:
    """What a checkpoint keeps beside the tensors. ``seconds`` and ``rays`` include what was discarded."""

    step: int = 0
    seconds: float = 0.0
    rays: int = 0
    restarts: int = 0
    rollbacks: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)


class Pace:
    """Running means of a run's speed and batch PSNR, forgetting after a few seconds. Shown, and used for planning."""

    def __init__(self) -> None:
        self.count, self.seconds_per_step, self.rays_per_step, self.psnr = 0, 0.0, 0.0, 0.0

    def add(self, seconds: float, rays: int, psnr: float) -> None:
        """Take one step into account."""
        self.count += 1
        new = max(1 / self.count, 1 - math.exp(-seconds / RATE_MEMORY_SECONDS))
        self.seconds_per_step += new * (seconds - self.seconds_per_step)
        self.rays_per_step += new * (rays - self.rays_per_step)
        self.psnr += new * (psnr - self.psnr)


class TrainingRun:
    """One training run in one folder. ``make_trainer(attempt)`` builds a fresh trainer; attempt 0 is the first.

    Its public attributes are the outcome once :meth:`train` has returned: ``trainer``, ``state``, ``plan``.
    """

    def __init__(
        self,
        make_trainer: "Callable[[int], FieldTrainer]",
        probes: Probes,
        budget: Budget,
        folder: Path,
        checkpoint_seconds: float,
        log: "TrainingLog",
        progress: Progress,
    ) -> None:
        self.make_trainer, self.probes, self.budget = make_trainer, probes, budget
        self.folder, self.checkpoint_seconds = folder, checkpoint_seconds
        self.log, self.progress = log, progress
        self.checkpoints, self.journal = folder / "checkpoints", folder / "plan.json"
        self.pace = Pace()
        checkpoint = latest_checkpoint(self.checkpoints, progress.note)
        if checkpoint is None or checkpoint.step == 0:
            self._begin(RunState(**checkpoint.facts) if checkpoint else RunState())
        else:
            self._resume(checkpoint)

    def train(self) -> None:
        """Train to the end of the budget. Raises StageError where the field diverges or stays dead."""
        from nerf.training import NonFinite

        with live_line(self.progress, self._describe):
            while self.state.step < self.plan.total_steps:
                try:
                    self._take_steps()
                except NonFinite as fault:
                    self._roll_back(fault)
            if not self.state.curve or self.state.curve[-1]["step"] != self.state.step:
                self._measure()
        self._save()

    def _begin(self, state: RunState) -> None:
        """Start from fresh weights; ``state`` carries over what earlier attempts cost."""
        from nerf.schedule import plan_of

        self.state = state
        self.trainer: FieldTrainer = self.make_trainer(state.restarts)
        self.plan: StepPlan = plan_of(self.budget.steps or PROVISIONAL_STEPS)
        self.clock_budget = self.budget.seconds
        self.next_planning, self.next_measurement = 0.0, state.seconds + FIRST_MEASUREMENT
        self._write_journal()
        self._save()

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint, by the plan that held when the run was killed: its steps are now counted."""
        from nerf.schedule import Decision, StepPlan

        self.state = RunState(**checkpoint.facts)
        self.trainer = self.make_trainer(self.state.restarts)
        self.trainer.load_state(checkpoint.tensors)
        self.plan = StepPlan(tuple(Decision(*decision) for decision in read_json(self.journal)))
        self.clock_budget = None
        self.next_measurement = self.state.seconds * MEASUREMENT_GROWTH
        self.next_checkpoint = time.monotonic() + self.checkpoint_seconds
        self.log.event("resumed", self.state.step)
        self.progress.note(f"going on from step {self.state.step:,} of {self.plan.total_steps:,}")

    def _take_steps(self) -> None:
        """Steps to the end of the plan, with everything that is due between them."""
        while self.state.step < self.plan.total_steps:
            self._take_step()
            if self.state.step == WARM_UP_STEPS and (symptom := self._symptom()):
                self._restart(symptom)
            if self.state.seconds >= self.next_measurement:
                self._measure()
            if self.clock_budget is not None and self.state.seconds >= self.next_planning:
                self._replan(self.clock_budget)
            if time.monotonic() >= self.next_checkpoint:
                self._save()

    def _take_step(self) -> None:
        started = time.perf_counter()
        result = self.trainer.step(self.state.step, self.plan.share(self.state.step), 0.5**self.state.rollbacks)
        seconds = time.perf_counter() - started
        self.state.step += 1
        self.state.seconds += seconds
        self.state.rays += result.rays
        self.pace.add(seconds, result.rays, result.psnr)

    def _replan(self, budget: float) -> None:
        """Fit the number of steps to the time left. Never rewrites a decision (after a roll-back, that is)."""
        from nerf.schedule import replanned

        step = self.state.step
        self.next_planning = self.state.seconds + PLAN_SHARE * budget
        if not self.plan.decisions[-1].from_step <= step < self.plan.total_steps:
            return
        left, tolerance = budget - self.state.seconds, PLAN_SHARE * budget
        plan = replanned(self.plan, step, left, 1 / self.pace.seconds_per_step, tolerance)
        if plan is not self.plan:
            self.plan = plan
            self._write_journal()
            self.log.event("planned", step, total_steps=plan.total_steps)

    def _measure(self) -> None:
        """Add a point to the curve. Not training time, and without influence on what is trained."""
        from nerf.probe import measure

        started = time.perf_counter()
        heldout = None
        if self.probes.heldout is not None and self.probes.neighbours is not None:
            unseen = self.trainer.photo_colours.of_unseen(self.probes.neighbours)
            heldout = measure(self.trainer.model, self.probes.heldout, unseen).psnr
        cost = time.perf_counter() - started
        seconds = self.state.seconds
        # Right after a kill at the very end no step has told how well the batches go.
        train = self.pace.psnr if self.pace.count else self._on_training_photos().psnr
        self.next_measurement = max(MEASUREMENT_GROWTH * seconds, seconds + cost / MOST_MEASURING)
        point = {"step": self.state.step, "seconds": round(seconds, 3), "train_psnr": round(train, 3)}
        point["heldout_psnr"] = None if heldout is None else round(heldout, 3)
        self.state.curve.append(point)
        self.log.point(point)

    def _save(self) -> None:
        save_checkpoint(self.checkpoints, Checkpoint(self.state.step, self.trainer.state(), asdict(self.state)))
        self.next_checkpoint = time.monotonic() + self.checkpoint_seconds

    def _write_journal(self) -> None:
        write_durably(self.journal, json.dumps(self.plan.decisions).encode())

    def _roll_back(self, fault: "NonFinite") -> None:
        """Keep the batch, return to the last good checkpoint and halve the rate; give up by name after the third."""
        from safetensors.torch import save

        name = f"nonfinite_{fault.step}.safetensors"
        (self.folder / name).write_bytes(save({key: tensor.contiguous() for key, tensor in fault.batch.items()}))
        self.log.event("nonfinite", fault.step, quantity=fault.quantity, batch=name)
        rollbacks = self.state.rollbacks + 1
        if rollbacks > MOST_ROLLBACKS:
            why = f"{fault}, after {MOST_ROLLBACKS} roll-backs that each halved the learning rate"
            hint = f"Try a tenth of --train.learning-rate; the batch is kept in {self.folder / name}."
            raise StageError("training diverged", why, hint)
        checkpoint = latest_checkpoint(self.checkpoints, self.progress.note)
        if checkpoint is None:
            raise StageError("training cannot roll back", f"{fault} and no checkpoint is readable", "Run it again.")
        self.trainer.load_state(checkpoint.tensors)
        self.state.step, self.state.rollbacks = checkpoint.step, rollbacks
        self.progress.note(f"{fault}: back to step {checkpoint.step:,} at half the learning rate")

    def _symptom(self) -> str | None:
        """What is wrong with the field after its warm-up, or None; judged on training photos alone."""
        seen = self._on_training_photos()
        if seen.opacity < EMPTY_OPACITY:
            return f"it is empty (mean opacity {seen.opacity:.0e})"
        if seen.psnr <= self.probes.train.flat_psnr:
            return f"it is no better than a flat colour ({seen.psnr:.1f} of {self.probes.train.flat_psnr:.1f} dB)"
        return None

    def _on_training_photos(self) -> "ProbeResult":
        from nerf.probe import measure

        return measure(self.trainer.model, self.probes.train, self.trainer.photo_colours, self.trainer.photo_rays)

    def _restart(self, symptom: str) -> None:
        """Begin anew with another seed; give up by name after the second."""
        self.log.event("dead", self.state.step, symptom=symptom)
        restarts = self.state.restarts + 1
        if restarts > MOST_RESTARTS:
            why = f"after {WARM_UP_STEPS} steps {symptom}, with {restarts} different seeds"
            raise StageError("the field does not learn", why, "Check the cameras: the photos may not fit their poses.")
        self.progress.note(f"after {WARM_UP_STEPS} steps the field is dead: {symptom}; starting with another seed")
        shutil.rmtree(self.checkpoints)
        self._begin(RunState(seconds=self.state.seconds, rays=self.state.rays, restarts=restarts))

    def _describe(self) -> tuple[str, float]:
        """The live line: step, speed, quality, time left."""
        step, total, pace = self.state.step, self.plan.total_steps, self.pace
        if not pace.count:
            return "first step", 0.0
        left = (total - step) * pace.seconds_per_step
        if self.clock_budget is not None:
            left = max(0.0, self.clock_budget - self.state.seconds)
        measured = [point["heldout_psnr"] for point in self.state.curve if point["heldout_psnr"] is not None]
        heldout = f" · held out {measured[-1]:.1f} dB" if measured else ""
        speed = f"{short_count(pace.rays_per_step / pace.seconds_per_step)} rays/s"
        return f"step {step:,} · {speed} · train {pace.psnr:.1f} dB{heldout} · {left:.0f} s left", self.plan.share(step)
