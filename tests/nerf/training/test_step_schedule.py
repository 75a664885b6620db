from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from nerf.training.step_schedule import (
    DECAY_START_PROGRESS,
    StepSchedule,
    new_schedule,
    revised_by_clock,
    steps_that_fit,
)


@st.composite
def plans(draw: st.DrawFn) -> StepSchedule:
    plan = new_schedule(draw(st.integers(1, 60)))
    for _ in range(draw(st.integers(0, 6))):
        earliest = plan.revisions[-1].from_step
        step = draw(st.integers(earliest, max(earliest, plan.total_steps - 1)))
        plan = plan.revised(step, draw(st.integers(step + 1, step + 60)), plan.progress(step))
    return plan


@given(plans())
def test_share_goes_from_0_to_1_and_never_back(plan: StepSchedule) -> None:
    shares = [plan.progress(step) for step in range(plan.total_steps + 1)]
    assert shares[0] == 0
    assert shares[-1] == pytest.approx(1, abs=1e-12)
    assert all(a < b for a, b in pairwise(shares))


@given(plans(), st.integers(1, 50), st.integers(0, 10**6))
def test_a_decision_leaves_the_past_and_the_present_alone(plan: StepSchedule, more: int, position: int) -> None:
    earliest = plan.revisions[-1].from_step
    step = earliest + position % (plan.total_steps - earliest)
    revised = plan.revised(step, step + more, plan.progress(step))
    assert [revised.progress(s) for s in range(step + 1)] == [plan.progress(s) for s in range(step + 1)]


@given(plans(), st.integers(0, 60))
def test_a_schedule_without_later_revisions_is_the_earlier_one(plan: StepSchedule, step: int) -> None:
    earlier = plan.until(step)
    assert [earlier.progress(s) for s in range(step + 1)] == [plan.progress(s) for s in range(step + 1)]
    assert earlier.revisions[-1].from_step <= step and plan.revisions[: len(earlier.revisions)] == earlier.revisions


def test_a_plan_without_revision_is_linear() -> None:
    assert [new_schedule(4).progress(step) for step in range(5)] == [0, 0.25, 0.5, 0.75, 1]


def test_half_way_through_twice_the_steps() -> None:
    plan = new_schedule(4).revised(2, 6, 0.5)
    assert [plan.progress(step) for step in range(7)] == [0, 0.25, 0.5, 0.625, 0.75, 0.875, 1]


@given(plans(), st.integers(1, 60), st.integers(1, 60))
def test_more_steps_take_progress_back(plan: StepSchedule, more: int, yet_more: int) -> None:
    done = plan.total_steps
    longer = plan.extended_to(done + more)
    assert [longer.progress(step) for step in range(done)] == [plan.progress(step) for step in range(done)]
    whole = new_schedule(done + more)
    for step in range(done, done + more + 1):
        assert longer.progress(step) == pytest.approx(whole.progress(step), abs=1e-12)
    assert longer.extended_to(done + more + yet_more).progress(done + more) == (done + more) / (done + more + yet_more)
    assert plan.is_single_cycle and not longer.is_single_cycle


@given(st.integers(1, 500), st.data())
def test_a_run_that_closes_early_ends_as_every_run_does(total: int, data: st.DataObject) -> None:
    plan, step = new_schedule(total), data.draw(st.integers(0, total - 1))
    closed = plan.with_decay_from(step)
    assert step < closed.total_steps <= total
    assert closed.progress(step) >= DECAY_START_PROGRESS and closed.progress(closed.total_steps) == 1
    assert [closed.progress(s) for s in range(step)] == [plan.progress(s) for s in range(step)]
    if closed.total_steps < total and step >= 10:
        whole = new_schedule(closed.total_steps)
        assert closed.progress(step) == pytest.approx(whole.progress(step), abs=0.05)


def test_a_run_may_end_at_any_step() -> None:
    ended_at = new_schedule(10).with_decay_from(6).ended_at(7)
    assert ended_at.total_steps == 7 and ended_at.progress(7) == new_schedule(10).with_decay_from(6).progress(7)
    with pytest.raises(ValueError, match="cannot end"):
        ended_at.ended_at(7)
    with pytest.raises(ValueError, match="cannot decay"):
        ended_at.with_decay_from(7)


@pytest.mark.parametrize("total", [4, 3])
def test_more_steps_are_more_than_there_were(total: int) -> None:
    with pytest.raises(ValueError, match="cannot be extended"):
        new_schedule(4).extended_to(total)


@pytest.mark.parametrize(("step", "total"), [(5, 5), (3, 9)])
def test_no_decision_without_a_step_left_or_about_the_past(step: int, total: int) -> None:
    with pytest.raises(ValueError, match="cannot become"):
        new_schedule(10).revised(4, 8, 0.4).revised(step, total, 0.5)


def test_a_run_has_steps() -> None:
    with pytest.raises(ValueError, match="at least one step"):
        new_schedule(0)


@example(budget=10.0, rate=1.25)  # 12.5 steps
@given(st.floats(0.01, 1000), st.floats(0.01, 1000))
def test_a_run_on_a_steady_clock_ends_on_time(budget: float, rate: float) -> None:
    plan, step = new_schedule(10**6), 0
    while step < plan.total_steps and step < 40:
        step += 1
        if step < plan.total_steps:
            plan = revised_by_clock(plan, step, step / rate, budget, rate, 0.01 * budget)
    # The first step is what the clock is read by, and one more is the least a plan can hold.
    assert abs(plan.total_steps / rate - budget) <= 0.01 * budget + 2 / rate
    assert len(plan.revisions) <= 2 + (budget * rate < 10)  # where steps are few, a whole one is a large part


def test_a_slow_run_is_cut_short_and_ends_at_1() -> None:
    plan = revised_by_clock(new_schedule(100), 50, 9.0, 10.0, 10.0, 0.1)
    assert plan.total_steps == 60
    assert plan.progress(49) == 0.49 and plan.progress(50) == 0.9
    assert plan.progress(60) == pytest.approx(1)


def test_a_schedule_made_too_short_leaves_no_trace() -> None:
    plan = revised_by_clock(new_schedule(30), 29, 1.5, 30.0, 20.0, 0.3)
    assert plan.total_steps == 29 + 570
    assert plan.progress(29) == 0.05


def test_a_plan_that_is_right_enough_stands() -> None:
    plan = new_schedule(100)
    assert revised_by_clock(plan, 50, 4.95, 10.0, 10.0, 0.1) is plan


def test_past_the_deadline_one_step_is_left() -> None:
    assert steps_that_fit(7, -3.0, 10.0) == 8
