"""A file that a setting names is gone: the stage whose setting it is says so, and no other one minds."""

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.display import SilentDisplay
from pipeline.engine.failures import StageFailed
from pipeline.engine.run_digests import RunDigests
from pipeline.engine.runner import Runner
from pipeline.engine.workspace import Workspace
from stages.contract import StageError
from tests.pipeline.schedule.made_up_machine import Machine, Options, runs_on
from tests.refusals import refused


def test_missing_render_cameras_stop_the_video_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go, machine, path = runs_on(tmp_path, monkeypatch), Machine(), tmp_path / "path.json"
    path.write_text("{}")
    options: dict[str, Any] = {"render": {"cameras": path}}
    go(machine, 300.0, **options)
    path.unlink()
    mesh_alone = {"resume": True, "alone": True, "stages": ("mesh", "report"), "mesh": {"pace": 2.0}}
    assert go(machine, None, **mesh_alone, **options).ran
    assert len([*(tmp_path / "w.nerf/report").glob("*/result.json")]) == 2, "written of what is there"
    settings: Any = Options.model_validate({"ingest": {"photos": tmp_path / "photos"}} | options)
    with Workspace(tmp_path / "w.nerf") as workspace:
        runner = Runner(workspace, settings, SilentDisplay())
        assert runner.found("render") is None and runner.found("evaluate") is not None
    with refused("pipeline.no-such-file", "render", path):
        go(machine, 300.0, **options)


def test_no_report_without_photos_and_their_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go = runs_on(tmp_path, monkeypatch)
    go(Machine(), 300.0)
    monkeypatch.setattr(
        RunDigests, "of_photos", lambda _: (_ for _ in ()).throw(StageError("ingest.cannot-read", "", "", ""))
    )
    with refused("ingest.cannot-read") as caught:
        go(Machine(), 300.0, resume=True, alone=True, stages=("report",))
    assert isinstance(caught.value, StageFailed) and caught.value.stage == "report"


@pytest.mark.parametrize("words", [["--render.cameras", "my.json"], ["--config", "options.toml"]], ids=["flag", "file"])
def test_render_cameras_must_exist_and_are_found_from_anywhere(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).save(tmp_path / f"photos/{k}.png")
    (tmp_path / "options.toml").write_text("render.cameras = 'my.json'")
    monkeypatch.chdir(tmp_path)
    command = ["run", "photos", "--until", "ingest", *words]
    assert run_command(command) == 2
    assert f"--render.cameras {tmp_path}/my.json: there is no such file" in capsys.readouterr().err
    assert not (tmp_path / "photos.nerf").exists()
    (tmp_path / "my.json").write_text("{}")
    assert run_command(command) == 0
    run = json.loads((tmp_path / "photos.nerf/run.json").read_text())
    assert run["options"]["render"]["cameras"] == str(tmp_path / "my.json")
