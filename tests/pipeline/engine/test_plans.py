"""What of a plan stands, and what is taken as it is given now."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.display import SilentDisplay
from pipeline.engine.failures import StageFailed
from pipeline.engine.runner import Runner
from pipeline.engine.status import explain, status_of
from pipeline.engine.workspace import Workspace
from pipeline.schedule.forecast import Forecast
from stages.contract import StageError
from stages.io.files import read_json
from tests.pipeline.engine import fake_stages
from tests.pipeline.engine.fake_stages import FakeSettings, calls, declare
from tests.pipeline.schedule import made_up_machine

Bring = Callable[..., None]


@pytest.fixture
def bring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bring:
    """Runs stages ingest and sfm of the fake chain with options of sfm."""
    monkeypatch.setattr("pipeline.engine.runner.STAGES", fake_stages.STAGES)
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "photos/0.png")

    def go(replan: tuple[str, ...] = (), **sfm: Any) -> None:
        calls.clear()
        settings = FakeSettings.model_validate({"ingest": {"photos": tmp_path / "photos"}, "sfm": sfm})
        with Workspace(tmp_path / "w.nerf") as workspace:
            runner = Runner(workspace, settings, SilentDisplay())  # type: ignore[arg-type]
            runner.run(("ingest", "sfm"), replan=replan)

    return go


def test_unhashed_options_change_after_planning(bring: Bring, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a longer --sfm.max-seconds, once a shorter one was not enough."""
    declare(monkeypatch, "sfm", not_hashed=("fail",))
    with pytest.raises(StageFailed):
        bring(fail=True)
    bring(fail=False)
    assert calls == ["sfm"], "the plan stands"


def test_seconds_that_a_budget_gave_stand_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go, machine = made_up_machine.runs_on(tmp_path, monkeypatch), made_up_machine.Machine()
    machine.killed_at = [machine.now + 20]
    with pytest.raises(made_up_machine.Killed):
        go(machine, 300.0)
    go(machine, 300.0, resume=True)
    (result,) = (tmp_path / "w.nerf/sfm").glob("*/result.json")
    assert read_json(result)["config"]["seconds"] == 150.0


def test_only_the_plans_of_the_stages_named_are_made_anew(bring: Bring, tmp_path: Path) -> None:
    bring()
    with Workspace(tmp_path / "w.nerf") as workspace:
        run = workspace.read_run()
        run.plans["train"] = {"asked": {"steps": 3}}
        workspace.write_run(run)
    bring(replan=("sfm",))
    assert calls == ["plan sfm"]
    assert Workspace(tmp_path / "w.nerf").read_run().plans == run.plans


def test_status_explains_stale_stages_without_a_plan(
    bring: Bring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.engine.status.STAGES", fake_stages.STAGES)
    bring(offset=7)
    for number, sfm, why in (
        (1, {"fail": True}, "sfm.fail: False → True"),
        (1, {}, "its automatic options are chosen again"),
        (50, {"fail": True}, "sfm.fail: False → True; ingest has another result"),
    ):
        given = {"ingest": {"photos": tmp_path / "photos", "number": number}, "sfm": sfm}
        workspace, settings = Workspace(tmp_path / "w.nerf"), FakeSettings.model_validate(given)
        with workspace:
            Runner(workspace, settings, SilentDisplay()).run(("ingest",))  # type: ignore[arg-type]
        runner = Runner(workspace, settings, SilentDisplay())  # type: ignore[arg-type]
        found = status_of(workspace, runner, "sfm")
        assert (found.state, found.text) == ("stale", why)
        assert explain(workspace, runner, "sfm")[1].startswith("It would run, unless a finished result has its key")
        assert explain(workspace, runner, "train")[1].endswith("known when sfm has run.")


def test_status_shows_what_a_plan_failed_of(bring: Bring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.engine.status.STAGES", fake_stages.STAGES)

    def fail(*_: Any) -> None:
        raise StageError("sfm.fake", "too little memory", "it was told to", "Do not tell it to.")

    def found(**sfm: Any) -> tuple[str, str]:
        given = {"ingest": {"photos": tmp_path / "photos"}, "sfm": sfm}
        runner = Runner(Workspace(tmp_path / "w.nerf"), FakeSettings.model_validate(given), SilentDisplay())  # type: ignore[arg-type]
        said = status_of(runner.workspace, runner, "sfm")
        return said.state, said.text

    with monkeypatch.context() as patch, pytest.raises(StageFailed):
        declare(patch, "sfm", plan=fail)
        bring()
    assert found() == ("failed", f"too little memory; `pipeline resume {tmp_path / 'w.nerf'}` tries again")
    assert found(fail=True) == ("never", ""), "these options were not tried"
    bring()
    assert found() == ("cached", "doubled") and not [*(tmp_path / "w.nerf/sfm").glob("*.partial")]


def test_a_run_replans_its_stages_and_one_stage_alone_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[str, ...]] = []
    monkeypatch.setattr(
        "pipeline.engine.runner.Runner.run", lambda *_, replan, **__: seen.append(tuple(replan)) or False
    )
    monkeypatch.chdir(tmp_path)
    run = {"version": 2, "options": {}, "plans": {}, "keys": {}, "stages": ["ingest", "sfm"]}
    (tmp_path / "run.json").write_text(json.dumps(run))
    for command in ("resume", "render", "tradeoff"):
        assert run_command([command, ".", "--replan"]) == run_command([command, "."]) == 0
    assert seen == [("ingest", "sfm"), (), ("render",), (), ("tradeoff",), ()]


def test_what_is_planned_again_is_expected_to_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    anew: list[frozenset[str]] = []
    monkeypatch.setattr("pipeline.engine.runner.Runner.run", lambda *_, **__: False)
    monkeypatch.setattr(Runner, "forecast", lambda *given: anew.append(given[2]) or Forecast([], {}))
    monkeypatch.chdir(tmp_path)
    run = {"version": 2, "options": {}, "plans": {"train": {"asked": {}}}, "keys": {}, "stages": ["ingest", "train"]}
    (tmp_path / "run.json").write_text(json.dumps(run))
    for words in (["resume", "."], ["resume", ".", "--replan"], ["ingest", ".", "--replan", "--force"]):
        assert run_command(words) == 0
    assert anew == [set(), {"train"}, {"ingest"}], "what has no plan does not run for that"
