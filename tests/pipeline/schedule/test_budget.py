"""A budget on a machine whose clock and speed are made up: it converges, whatever the machine does and however often
it is killed."""

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.stage_list import STAGES
from pipeline.schedule.budget import Account
from stages.contract import BudgetLeft
from stages.effects import STATISTICS_SECONDS, budget_seconds
from stages.io.files import read_json
from stages.io.stopwatch import BEAT
from stages.train import step_seconds
from tests.pipeline.schedule.made_up_machine import (
    CHAIN,
    EXPECTED,
    FLEXIBLE,
    MIN_SECONDS,
    Go,
    Killed,
    Machine,
    allocated,
    least,
    runs_on,
    spent,
)

OPEN = dict.fromkeys(FLEXIBLE)


@pytest.fixture
def go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    return runs_on(tmp_path, monkeypatch)


# --- the shares


@pytest.mark.parametrize("left", [60.0, 300.0, 3000.0])
def test_shares_use_up_what_is_left_and_no_more(left: float) -> None:
    """If every stage takes just what it is given, nothing is left over but what the last ones have no use for."""
    rest, taken = dict(OPEN), []
    for stage in list(OPEN):
        del rest[stage]
        taken.append(allocated(stage, left - sum(taken), rest, left))
    assert 0.9 * left < sum(taken) <= left * (1 + 1e-9)
    assert taken[0] == max(taken)


@given(
    left=st.floats(-1e3, 1e5),
    total=st.floats(1, 1e5),
    stage=st.sampled_from(list(FLEXIBLE)),
    report=st.floats(0, 100),
)
def test_never_less_than_the_least_nor_more_than_there_is(left: float, total: float, stage: str, report: float) -> None:
    after = list(FLEXIBLE)[list(FLEXIBLE).index(stage) + 1 :]
    seconds = allocated(stage, left, dict.fromkeys(after) | {"report": report}, total)
    assert MIN_SECONDS[stage] <= seconds <= max(MIN_SECONDS[stage], left)
    more = allocated(stage, left + 50, dict.fromkeys(after) | {"report": report}, total)
    assert more >= seconds - 1e-9


def test_what_later_stages_have_no_use_for_goes_to_training() -> None:
    hours = allocated("train", 36000.0, {name: None for name in FLEXIBLE if name != "train"}, 36000.0)
    assert hours == pytest.approx(36000 - sum(FLEXIBLE[name].max_seconds for name in FLEXIBLE if name != "train"))


def test_cached_stages_cost_nothing_and_videos_stay_short() -> None:
    assert allocated("render", 3600.0, {"mesh": None, "report": 2.0}, 3600.0) == pytest.approx(0.35 * 3600)


def test_structure_from_motion_leaves_the_rest_its_least() -> None:
    assert allocated("sfm", 600.0, OPEN, 600.0) == 300.0
    assert allocated("sfm", 55.0, OPEN, 60.0) == pytest.approx(55 - sum(MIN_SECONDS.values()))
    assert allocated("sfm", 10.0, OPEN, 60.0) == 1.0


def test_pilots_and_statistics_never_take_more_than_their_part() -> None:
    assert allocated("effects", 500.0, OPEN, 600.0) == 90.0 - STATISTICS_SECONDS
    assert allocated("effects", 500.0, OPEN, 600.0, 30.0) == 60.0 - STATISTICS_SECONDS
    assert allocated("effects", 80.0, OPEN, 600.0) == 20.0 - STATISTICS_SECONDS
    assert allocated("effects", -5.0, OPEN, 600.0) == 0.0
    assert allocated("effects", 500.0, OPEN, 600.0, 100.0) == 0.0


@pytest.mark.parametrize("wall", [5.0, 20.0, 300.0])
def test_steps_are_given_less_than_the_stage(wall: float) -> None:
    assert wall / 2 <= step_seconds(wall, 0.0) < wall
    assert step_seconds(wall, 0.0) + 10 > 0.9 * wall


def test_the_least_budget_is_what_has_to_be() -> None:
    assert least({"sfm": 50.0, "train": None, "report": 2.0}) == 52 + MIN_SECONDS["train"]


# --- whole runs


@pytest.mark.parametrize(
    ("total", "slowness"), [(120, 0.5), (120, 1.0), (300, 0.8), (300, 1.5), (900, 0.5), (900, 1.5)]
)
def test_a_run_takes_its_budget_on_slow_and_fast_machines(go: Go, total: float, slowness: float) -> None:
    machine = Machine(slowness)
    runner = go(machine, total)
    assert runner.took == pytest.approx(total, rel=0.1)
    assert sum(spent(runner).values()) == pytest.approx(runner.took, abs=1)
    assert spent(runner)["train"] > 0.3 * total or slowness == 1.5
    assert runner.budget is not None
    account: dict[str, Any] = runner.budget.shown(STAGES)
    assert set(account["allocated"]) == set(account["spent"]) == set(CHAIN) - {"report"}


@pytest.mark.parametrize("when", [20.0, 90.0, 200.0, 260.0])
def test_a_machine_that_becomes_half_as_fast_midway_is_met(go: Go, when: float) -> None:
    machine = Machine()
    machine.halves_at = machine.now + when
    assert go(machine, 300.0).took == pytest.approx(300, rel=0.2)


def test_a_budget_too_small_leaves_the_least_for_each(go: Go) -> None:
    runner = go(Machine(), 45.0)
    assert runner.took < 45 + sum(MIN_SECONDS.values()) + 5
    assert spent(runner)["train"] < MIN_SECONDS["train"] + 5


def test_the_same_budget_again_has_nothing_to_do(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 120.0)
    folders = {path for path in (tmp_path / "w.nerf").glob("*/*") if path.is_dir()}
    again = go(machine, 120.0)
    assert (again.ran, again.took) == (False, 0)
    longer = go(machine, 300.0)
    assert longer.ran and folders < {path for path in (tmp_path / "w.nerf").glob("*/*") if path.is_dir()}
    assert spent(longer)["sfm"] < 1  # planned anew, and found finished
    assert longer.took == pytest.approx(300, rel=0.1)  # what the cameras cost before goes to the training
    back = go(machine, 120.0)
    assert not back.ran or set(spent(back)) == {"report"}


def test_without_the_budget_its_choices_are_forgotten(go: Go) -> None:
    given = {name: {"seconds": 5.0} for name in FLEXIBLE}
    machine = Machine()
    go(machine, 120.0)
    plain = go(machine, None, **given)
    assert plain.budget is None and plain.ran
    assert not go(machine, None, **given).ran


def given_to_pilots(workspace: Path) -> list[float | None]:
    """The seconds that stage effects was given, of every result that it left."""
    return sorted(read_json(file)["config"]["seconds"] for file in workspace.glob("effects/*/result.json"))


def test_pilots_have_their_part_of_a_usual_run(go: Go, tmp_path: Path) -> None:
    others = {name: {"seconds": 5.0} for name in ("evaluate", "render", "mesh")}
    times = EXPECTED | dict.fromkeys(others, 5.0) | {"train": 204.0}
    total = sum(seconds or 0.0 for seconds in times.values())
    limit = budget_seconds(BudgetLeft(total, total, 0.0, 0.0))
    go(Machine(), None, train={"seconds": 200.0}, times=times, **others)
    assert given_to_pilots(tmp_path / "w.nerf") == [pytest.approx(limit)]
    assert 0 < limit < 0.15 * total
    ran = go(Machine(), None, train={"seconds": 200.0}, **others).ran
    assert not ran, "the plan stands"


def test_where_training_counts_steps_pilots_take_what_they_take(go: Go, tmp_path: Path) -> None:
    others = {name: {"seconds": 5.0} for name in ("evaluate", "render", "mesh")}
    go(Machine(), None, train={"steps": 5, "seconds": 20.0}, **others)
    assert given_to_pilots(tmp_path / "w.nerf") == [None]


@pytest.mark.parametrize("kills", [[30.0], [100.0], [100.0, 170.0], [225.0], [255.0, 270.0], [20.0, 40.0, 60.0]])
def test_a_kill_and_a_resume_keep_the_total(go: Go, kills: list[float]) -> None:
    """Also in stages that write nothing before their end: all but train."""
    machine = Machine()
    machine.killed_at = [machine.now + when for when in kills]
    worked = 0.0
    for _ in kills:
        began = machine.now
        with pytest.raises(Killed):
            go(machine, 300.0, resume=worked > 0)
        worked += machine.now - began
        later = 5000.0  # nobody counts the hours between
        machine.now += later
        machine.killed_at = [when + later for when in machine.killed_at]
    runner = go(machine, 300.0, resume=True)
    assert worked + runner.took == pytest.approx(300, rel=0.1)
    assert sum(spent(runner).values()) == pytest.approx(worked + runner.took, abs=1 + BEAT * len(kills))


def test_a_kills_loss_is_not_told_by_file_times(go: Go, tmp_path: Path) -> None:
    """As after a copy, or after a clock that was put forward."""
    machine = Machine()
    machine.killed_at = [machine.now + 100]
    with pytest.raises(Killed):
        go(machine, 300.0)
    for path in (tmp_path / "w.nerf").rglob("*"):
        os.utime(path, (1e10, 1e10))
    assert 100 + go(machine, 300.0, resume=True).took == pytest.approx(300, rel=0.1)


@pytest.mark.parametrize("stage", ["evaluate", "render", "mesh"])
def test_a_kill_while_a_stage_is_planned_is_not_free(go: Go, stage: str) -> None:
    machine = Machine()
    machine.planning, machine.killed_planning, began = 20.0, stage, machine.now
    with pytest.raises(Killed):
        go(machine, 300.0)
    worked = machine.now - began
    machine.now += 5000.0
    runner = go(machine, 300.0, resume=True)
    assert sum(spent(runner).values()) == pytest.approx(worked + runner.took, abs=1 + BEAT)


def test_other_options_are_another_run_with_its_whole_budget(go: Go) -> None:
    machine = Machine()
    machine.killed_at = [machine.now + 200]
    with pytest.raises(Killed):
        go(machine, 300.0)
    other = go(machine, 300.0, train={"pace": 2.0})
    assert other.took == pytest.approx(300, rel=0.1)


def test_given_seconds_win_and_the_rest_fits(go: Go) -> None:
    machine = Machine()
    runner = go(machine, 300.0, evaluate={"seconds": 4.0}, train={"seconds": 100.0})
    assert spent(runner)["train"] == pytest.approx(104, abs=3)
    assert spent(runner)["evaluate"] == pytest.approx(4, abs=2)
    assert runner.took <= 310


def test_one_stage_alone_has_a_share_and_not_the_whole(go: Go) -> None:
    machine = Machine()
    go(machine, 300.0)
    runner = go(machine, None, resume=True, stages=("render", "report"), render={"pace": 2.0})
    assert set(spent(runner)) == {"render", "report"}
    assert 40 < spent(runner)["render"] < 0.4 * 300


def test_remakes_for_a_report_are_planned(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 300.0)
    (report,) = (tmp_path / "w.nerf/report").iterdir()
    shutil.rmtree(report)
    (result,) = (tmp_path / "w.nerf/train").glob("*/result.json")
    result.write_text(result.read_text().replace("1", "2"))
    runner = go(machine, None, resume=True, stages=("report",))
    assert set(spent(runner)) == {"train", "evaluate", "render", "mesh", "report"}
    assert runner.took < 1.4 * 300


def test_until_train_leaves_nothing_for_what_is_not_asked_for(go: Go) -> None:
    runner = go(Machine(), 200.0, stages=CHAIN[:5])
    assert runner.took == pytest.approx(200, rel=0.05)


def test_replan_shares_out_anew(go: Go) -> None:
    machine = Machine()
    first = go(machine, 200.0)
    machine.slowness = 0.5
    again = go(machine, 200.0, replan=CHAIN)
    assert spent(again)["train"] > 1.1 * spent(first)["train"]  # the cameras are there already
    assert again.took == pytest.approx(200, rel=0.1)


def test_an_account_survives_its_journey_through_json() -> None:
    budget = Account(total=60.0, run="run")
    budget.allocate("sfm", 20.0)
    budget.allocate("sfm", 99.0)
    budget.running = "sfm"
    budget.end("sfm", 12.34)
    budget.end("sfm", 1.0)
    budget = Account.model_validate_json(budget.model_dump_json(), strict=True)
    assert (budget.seconds_spent, budget.left) == (pytest.approx(13.3), pytest.approx(46.7))
    assert budget.shown(STAGES) == {"seconds": 60.0, "allocated": {"sfm": 20.0}, "spent": {"sfm": 13.3}}
