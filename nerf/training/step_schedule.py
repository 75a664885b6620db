"""The step schedule of a run: how many steps it has, and how far it has come at each of them.

``progress`` is the finished fraction of a run, from 0 to 1; everything that changes while training is a function of it,
the learning rate (learning_rate.py) above all.
A run bounded by steps knows its progress exactly. A run bounded by seconds estimates how many steps will fit, and
revises the estimate when the clock disagrees. The revisions are data (:class:`StepSchedule`): a resumed run that
replays them gives every step the learning rate it had before, and continues from there by steps or by the clock.
"""

import math
from typing import Literal, NamedTuple

from nerf.training.learning_rate import LR_HOLD_FRACTION

Reason = Literal["begin", "clock", "target", "finish", "more"]

# A run that stops early, at a target or as the user wants it, gets the last quarter of a run, in which the hash grid's
# learning rate decays; the vanilla NeRF's falls all the time.
DECAY_START_PROGRESS = LR_HOLD_FRACTION


class ScheduleRevision(NamedTuple):
    """From step ``from_step`` on, at this ``progress``, the run has ``total_steps``. ``reason``: it begins, the clock
    says so, a target is near or reached, the user wants it finished, or the finished run is to train more."""

    from_step: int
    total_steps: int
    progress: float
    reason: Reason = "begin"


class StepSchedule(NamedTuple):
    """The revisions so far, in order; the last one holds."""

    revisions: tuple[ScheduleRevision, ...]

    @property
    def total_steps(self) -> int:
        """How many steps the run has, by the latest revision."""
        return self.revisions[-1].total_steps

    @property
    def is_single_cycle(self) -> bool:
        """Whether the learning rate decayed once: no finished run was continued, and no target missed after its
        decay."""
        return all(revision.reason != "more" for revision in self.revisions)

    def progress(self, step: int) -> float:
        """The progress of the run before ``step``, 1 at the end.

        Every revision spreads the remaining progress evenly over the remaining steps.
        """
        start, total, progress, _ = next(
            revision for revision in reversed(self.revisions) if revision.from_step <= step
        )
        return progress if total == start else progress + (1 - progress) * min(1.0, (step - start) / (total - start))

    def revised(self, step: int, total_steps: int, progress: float) -> "StepSchedule":
        """This schedule with one more revision before ``step``, when the clock says ``progress``.

        Raises ValueError if that would leave no step, or rewrite an earlier revision.
        """
        if not self.revisions[-1].from_step <= step < total_steps:
            raise ValueError(f"at step {step} the schedule {self.revisions} cannot become {total_steps} steps")
        return StepSchedule((*self.revisions, ScheduleRevision(step, total_steps, progress, "clock")))

    def until(self, step: int) -> "StepSchedule":
        """The revisions up to ``step``: later ones concern steps that are to be repeated."""
        return StepSchedule(tuple(revision for revision in self.revisions if revision.from_step <= step))

    def with_decay_from(self, step: int, reason: Reason = "target") -> "StepSchedule":
        """This schedule with the decay phase, the last quarter of a run, beginning at ``step``, or what is left of it
        if that is less. Raises ValueError if that rewrites an earlier revision or leaves no step."""
        if not self.revisions[-1].from_step <= step < self.total_steps:
            raise ValueError(f"the schedule {self.revisions} cannot decay from step {step}")
        total = min(self.total_steps, max(step + 1, round(step / DECAY_START_PROGRESS)))
        progress = max(DECAY_START_PROGRESS, self.progress(step))
        return StepSchedule((*self.revisions, ScheduleRevision(step, total, progress, reason)))

    def ended_at(self, step: int) -> "StepSchedule":
        """This schedule without the steps from ``step`` on. Raises ValueError if that rewrites an earlier revision."""
        if not self.revisions[-1].from_step < step <= self.total_steps:
            raise ValueError(f"the schedule {self.revisions} cannot end at step {step}")
        return StepSchedule((*self.revisions, ScheduleRevision(step, step, self.progress(step), "target")))

    def extended_to(self, total_steps: int) -> "StepSchedule":
        """This schedule, at its end, with more steps: its progress falls back to that of a run of ``total_steps``.

        Raises ValueError if that would add no step.
        """
        done = self.total_steps
        if total_steps <= done:
            raise ValueError(f"after {done} steps the run cannot be extended to {total_steps}")
        return StepSchedule((*self.revisions, ScheduleRevision(done, total_steps, done / total_steps, "more")))


def new_schedule(total_steps: int) -> StepSchedule:
    """The schedule of a run of ``total_steps`` steps. Raises ValueError below one step."""
    if total_steps < 1:
        raise ValueError(f"a run needs at least one step, not {total_steps}")
    return StepSchedule((ScheduleRevision(0, total_steps, 0.0),))


def steps_that_fit(step: int, seconds_left: float, steps_per_second: float) -> int:
    """The total number of steps that uses up the time left at the measured speed; at least the next step."""
    return step + max(1, round(seconds_left * steps_per_second))


def revised_by_clock(
    schedule: StepSchedule, step: int, seconds: float, budget: float, steps_per_second: float, tolerance: float
) -> StepSchedule:
    """The schedule before ``step``, ``seconds`` of the ``budget`` being used; revised only if it would end more than
    ``tolerance`` seconds early or late. Its progress is then that of the time, so that a schedule which the clock
    proved wrong leaves no trace in the learning rates."""
    left = budget - seconds
    nearest = 0.51 / steps_per_second  # whole steps come no nearer than half of one; the rest is rounding
    if abs((schedule.total_steps - step) / steps_per_second - left) <= max(tolerance, nearest):
        return schedule
    total = steps_that_fit(step, left, steps_per_second)
    return schedule if total == schedule.total_steps else schedule.revised(step, total, min(1.0, seconds / budget))


def next_in_series(now: float, first: float, growth: float) -> float:
    """The first of ``first``, ``first * growth``, ``first * growth²`` … that is more than ``now``."""
    if now < first:
        return first
    due = first * growth ** math.floor(math.log(now / first) / math.log(growth))
    while due <= now:
        due *= growth
    return due
