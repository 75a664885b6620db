"""What is charged to a budget, when an account ends, and which one the report shows."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.engine.failures import StageFailed
from pipeline.engine.stage_list import STAGES
from stages.contract import reading_seconds
from stages.hardware.device import processors
from stages.io.files import read_json
from stages.train import step_seconds
from tests.pipeline.schedule.made_up_machine import (
    EXPECTED,
    MIN_SECONDS,
    MUST,
    Go,
    Killed,
    Machine,
    allocated,
    least,
    runs_on,
    spent,
)


@pytest.fixture
def go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    return runs_on(tmp_path, monkeypatch)


def reported(tmp_path: Path) -> dict[str, Any]:
    """The account in the newest report."""
    newest = max((tmp_path / "w.nerf/report").glob("*/result.json"), key=lambda path: path.stat().st_mtime_ns)
    return read_json(newest)["config"]["budget"]


def manifest(tmp_path: Path, stage: str) -> dict[str, Any]:
    (path,) = (tmp_path / "w.nerf" / stage).glob("*/manifest.json")
    return read_json(path)


def test_a_refused_run_ends_and_the_next_is_whole(go: Go) -> None:
    machine = Machine()
    machine.refuses = "sfm"
    with pytest.raises(StageFailed):
        go(machine, 300.0)
    machine.refuses = ""
    again = go(machine, 300.0, resume=True)
    assert again.took == pytest.approx(300, rel=0.1)
    assert "ingest" not in spent(again)


def test_other_photos_begin_a_new_account_after_a_kill(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    machine.killed_at = [machine.now + 100]
    with pytest.raises(Killed):
        go(machine, 300.0)
    Image.new("RGB", (4, 4), "red").save(tmp_path / "photos/1.png")
    assert go(machine, 300.0).took == pytest.approx(300, rel=0.1)


def test_a_study_is_no_part_of_a_run(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 300.0)
    before = reported(tmp_path)
    study = go(machine, None, resume=True, alone=True, stages=("tradeoff", "report"), tradeoff={"seconds": 900.0})
    assert study.took == pytest.approx(900 + MUST["report"], abs=1)
    assert reported(tmp_path) == before and before["spent"].keys() >= {"train", "mesh"}
    assert not go(machine, 300.0).ran


def test_a_study_between_kill_and_resume_leaves_the_rest(go: Go) -> None:
    machine = Machine()
    machine.killed_at = [machine.now + 100]
    with pytest.raises(Killed):
        go(machine, 300.0)
    stages = ("ingest", "sfm", "normalise", "effects", "tradeoff")
    study = go(machine, None, resume=True, alone=True, stages=stages, tradeoff={"seconds": 900.0})
    assert study.took == pytest.approx(900, abs=1)
    resumed = go(machine, None, resume=True, tradeoff={"seconds": 900.0})
    assert 100 + resumed.took == pytest.approx(300, rel=0.1)


def test_a_report_alone_keeps_the_account_of_the_run(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 300.0)
    before = reported(tmp_path)
    (report,) = (tmp_path / "w.nerf/report").iterdir()
    shutil.rmtree(report)
    assert go(machine, 300.0).ran
    assert not go(machine, 300.0).ran and reported(tmp_path) == before


def test_a_stage_alone_keeps_the_runs_account(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 300.0)
    before = reported(tmp_path)
    alone = go(machine, None, resume=True, alone=True, stages=("mesh", "report"), mesh={"pace": 2.0})
    assert set(spent(alone)) == {"mesh", "report"} and spent(alone)["mesh"] < 0.4 * 300
    assert reported(tmp_path) == before
    assert not go(machine, None, resume=True, mesh={"pace": 2.0}).ran


def test_one_stage_does_not_end_an_interrupted_run(go: Go) -> None:
    machine = Machine()
    machine.killed_at = [machine.now + 100]
    with pytest.raises(Killed):
        go(machine, 300.0)
    alone = go(machine, None, resume=True, alone=True, stages=("ingest", "sfm", "normalise", "effects", "train"))
    assert alone.budget is not None and not alone.budget.over
    resumed = go(machine, None, resume=True)
    assert 100 + alone.took + resumed.took < 300 + sum(MIN_SECONDS.values())


@pytest.mark.parametrize("alone", [True, False])
def test_more_is_charged_to_no_budget_also_after_a_kill(go: Go, alone: bool) -> None:
    machine, more = Machine(), {"after": "there", "seconds": 600.0}
    go(machine, 300.0)
    stages = ("ingest", "sfm", "normalise", "effects", "train", "report")
    machine.killed_at = [machine.now + 500]
    with pytest.raises(Killed):
        go(machine, None, resume=True, alone=alone, stages=stages, train=more)
    resumed = go(machine, None, resume=True, train=more)
    assert resumed.budget is not None
    account: dict[str, Any] = resumed.budget.shown(STAGES)
    assert set(account["allocated"]) == set(account["spent"]) == {"evaluate", "render", "mesh"}
    assert all(seconds > 0.3 * 300 for seconds in account["allocated"].values())


def test_planning_counts_as_time_of_its_stage(go: Go, tmp_path: Path) -> None:
    runner = go(Machine(), 300.0)
    for stage in ("evaluate", "render", "mesh"):
        assert manifest(tmp_path, stage)["seconds"] == pytest.approx(spent(runner)[stage], abs=0.1)


def test_a_plan_that_is_found_again_counts_once(go: Go, tmp_path: Path) -> None:
    """Half a second of planning came before the work that was killed."""
    machine = Machine()
    machine.killed_at = [machine.now + 280]
    with pytest.raises(Killed):
        go(machine, 300.0)
    done = {path.parent.parent.name for path in (tmp_path / "w.nerf").glob("*/*/manifest.json")}
    (stage,) = [name for name in ("render", "mesh") if name not in done][:1]
    resumed = go(machine, 300.0)
    assert manifest(tmp_path, stage)["seconds"] == pytest.approx(spent(resumed)[stage], abs=0.3)


def test_an_input_that_is_made_again_is_charged_once(go: Go, tmp_path: Path) -> None:
    machine = Machine()
    go(machine, 300.0)
    shutil.rmtree(tmp_path / "w.nerf/mesh")
    (result,) = (tmp_path / "w.nerf/train").glob("*/result.json")
    result.write_text(result.read_text().replace("1", "2"))
    again = go(machine, None, resume=True)
    assert sum(spent(again).values()) == pytest.approx(again.took, abs=1)


# --- reading the photos


def test_training_that_reads_many_photos_ends_in_time(go: Go) -> None:
    machine = Machine()
    machine.megapixels = 1000.0 * processors()  # 40 seconds
    runner = go(machine, 300.0)
    assert runner.took == pytest.approx(300, rel=0.1)
    assert runner.budget is not None
    assert spent(runner)["train"] == pytest.approx(runner.budget.allocated["train"], abs=5)


def test_reading_takes_its_time_of_every_budget() -> None:
    assert reading_seconds(50 * 0.75, 2) == pytest.approx(0.75)
    assert step_seconds(300.0, 40.0) == pytest.approx(step_seconds(300.0, 0.0) - 40, rel=0.01)
    later: dict[str, float | None] = {"evaluate": None, "render": None, "mesh": None}
    assert allocated("train", 10.0, later, 60.0, 40.0) == MIN_SECONDS["train"] + 40
    before = allocated("sfm", 90.0, {"train": None, **later}, 600.0)
    assert allocated("sfm", 90.0, {"train": None, **later}, 600.0, 40.0) == pytest.approx(before - 40)
    assert least(EXPECTED, 40.0) == pytest.approx(least(EXPECTED) + 40)
    assert least(later, 40.0) == least(later), "what is trained already is not read again"
