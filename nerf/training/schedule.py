"""When a run ends and which learning rate each step has, and when it is measured.

``progress`` is how much of a run is done, from 0 to 1; everything that changes while training is a function of it.
A run bounded by steps knows its progress exactly. A run bounded by seconds estimates how many steps will fit, and
revises the estimate when the clock disagrees; the decisions are data (:class:`StepSchedule`), so a resumed run that
replays them gives every step the learning rate it had before, and goes on from there by steps or by the clock.
"""

import math
from typing import Literal, NamedTuple

Reason = Literal["begin", "clock", "target", "more"]

# A run towards a target that stops early does so as every run ends: with the last quarter of its steps, at the shares
# of that.
DECAY_START_PROGRESS = 0.75


class ScheduleRevision(NamedTuple):
    """From step ``from_step`` on, where the run has made this ``progress``, it is meant to have ``total_steps``, for a
    ``reason``: it begins, the clock says so, a target is near or reached, or it is to go on."""

    from_step: int
    total_steps: int
    progress: float
    reason: Reason = "begin"


class StepSchedule(NamedTuple):
    """The decisions so far, in order; the last one holds."""

    revisions: tuple[ScheduleRevision, ...]

    @property
    def total_steps(self) -> int:
        """How many steps the run has, by the latest decision."""
        return self.revisions[-1].total_steps

    @property
    def is_single_cycle(self) -> bool:
        """Whether the progress never fell to go on from an end: that of another run, or one short of a target."""
        return all(decision.reason != "more" for decision in self.revisions)

    def progress(self, step: int) -> float:
        """The progress of the run before ``step``, 1 at the end.

        Every decision spreads the progress that was left when it was made evenly over the steps that were left.
        """
        start, total, progress, _ = next(
            decision for decision in reversed(self.revisions) if decision.from_step <= step
        )
        return progress if total == start else progress + (1 - progress) * min(1.0, (step - start) / (total - start))

    def revised(self, step: int, total_steps: int, progress: float) -> "StepSchedule":
        """This plan with one more decision made before ``step``, when the clock says ``progress``.

        Raises ValueError where that would leave no step to take, or rewrite a decision already made.
        """
        if not self.revisions[-1].from_step <= step < total_steps:
            raise ValueError(f"at step {step} the plan {self.revisions} cannot become {total_steps} steps")
        return StepSchedule((*self.revisions, ScheduleRevision(step, total_steps, progress, "clock")))

    def until(self, step: int) -> "StepSchedule":
        """The decisions made up to ``step``: later ones are about steps that are to be taken once more."""
        return StepSchedule(tuple(decision for decision in self.revisions if decision.from_step <= step))

    def with_decay_from(self, step: int) -> "StepSchedule":
        """This plan with ``step`` as the first one of the last quarter of a run, or of what is left if that is less.
        Raises ValueError where that rewrites a decision or leaves no step."""
        if not self.revisions[-1].from_step <= step < self.total_steps:
            raise ValueError(f"the plan {self.revisions} cannot close at step {step}")
        total = min(self.total_steps, max(step + 1, round(step / DECAY_START_PROGRESS)))
        progress = max(DECAY_START_PROGRESS, self.progress(step))
        return StepSchedule((*self.revisions, ScheduleRevision(step, total, progress, "target")))

    def ended_at(self, step: int) -> "StepSchedule":
        """This plan without the steps from ``step`` on. Raises ValueError where that rewrites a decision."""
        if not self.revisions[-1].from_step < step <= self.total_steps:
            raise ValueError(f"the plan {self.revisions} cannot end at step {step}")
        return StepSchedule((*self.revisions, ScheduleRevision(step, step, self.progress(step), "target")))

    def extended_to(self, total_steps: int) -> "StepSchedule":
        """This plan, once it is at its end, with more steps: its progress falls to that of a run of ``total_steps``.

        Raises ValueError where that would add no step.
        """
        done = self.total_steps
        if total_steps <= done:
            raise ValueError(f"after {done} steps the run cannot go on to {total_steps}")
        return StepSchedule((*self.revisions, ScheduleRevision(done, total_steps, done / total_steps, "more")))


def new_schedule(total_steps: int) -> StepSchedule:
    """The plan of a run of ``total_steps`` steps. Raises ValueError below one step."""
    if total_steps < 1:
        raise ValueError(f"a run needs at least one step, not {total_steps}")
    return StepSchedule((ScheduleRevision(0, total_steps, 0.0),))


def steps_that_fit(step: int, seconds_left: float, steps_per_second: float) -> int:
    """The total that uses up the time left at the measured rate; always at least the step about to be taken."""
    return step + max(1, round(seconds_left * steps_per_second))


def revised_by_clock(
    plan: StepSchedule, step: int, seconds: float, budget: float, steps_per_second: float, tolerance: float
) -> StepSchedule:
    """The plan before ``step``, ``seconds`` of the ``budget`` being used; revised only if it would end more than
    ``tolerance`` seconds early or late. Its progress is then that of the time, so that a schedule which the clock
    proved wrong leaves no trace in the learning rates."""
    left = budget - seconds
    if abs((plan.total_steps - step) / steps_per_second - left) <= tolerance:
        return plan
    total = steps_that_fit(step, left, steps_per_second)
    return plan if total == plan.total_steps else plan.revised(step, total, min(1.0, seconds / budget))


def learning_rate(progress: float, start: float, end: float) -> float:
    """From ``start`` to ``end`` exponentially in the progress of the run (Mildenhall et al. 2020, section 5.3)."""
    return start * (end / start) ** progress


def next_in_series(now: float, first: float, growth: float) -> float:
    """The first of ``first``, ``first * growth``, ``first * growth²`` … that is more than ``now``."""
    if now < first:
        return first
    due = first * growth ** math.floor(math.log(now / first) / math.log(growth))
    while due <= now:
        due *= growth
    return due
