"""Studies on the command line: asked for by name, with a time of their own, and left alone by what does not ask."""

import json
from pathlib import Path

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine import stage_list
from pipeline.engine.settings import Settings
from stages.train.config import Config


def test_a_study_is_asked_for_by_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[Settings, list[str]]] = []

    def remember(_root: Path, settings: Settings, stages: list[str], *_: object, **__: object) -> None:
        seen.append((settings, stages))

    monkeypatch.setattr("pipeline.cli.commands._run_stages", remember)
    (tmp_path / "run.json").write_text('{"version": 2, "options": {}, "plans": {}, "keys": {}}')
    run_command(["tradeoff", str(tmp_path), "--budget", "30m"])
    run_command(["tradeoff", str(tmp_path), "--tradeoff.seconds", "60"])
    assert [settings.tradeoff.seconds for settings, _ in seen] == [1800, 60]
    assert seen[0][1] == ["ingest", "sfm", "normalise", "effects", "tradeoff"]


def test_a_run_leaves_a_study_as_it_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[float] = []
    monkeypatch.setattr(
        "pipeline.cli.commands._run_stages", lambda root, settings, *_, **__: seen.append(settings.tradeoff.seconds)
    )
    photos, workspace, file = tmp_path / "photos", tmp_path / "w", tmp_path / "options.toml"
    photos.mkdir()
    workspace.mkdir()
    Image.new("RGB", (40, 30)).save(photos / "a.jpg")
    file.write_text("[tradeoff]\nseeds = 2")
    for recorded in ({"seconds": 1200}, {"seconds": 1200, "of_another_version": 1}):
        run = {"version": 2, "options": {"tradeoff": recorded, "mesh": {"gone": 1}}, "plans": {}, "keys": {}}
        (workspace / "run.json").write_text(json.dumps(run))
        for words in ([], ["--tradeoff.seconds=1800"], ["--config", str(file)], ["-o", str(tmp_path / "new")]):
            assert not run_command(["run", str(photos), "-o", str(workspace), *words])
    assert seen == [1200, *[1800] * 7]


@pytest.mark.parametrize("words", [["--until", "tradeoff"], ["-o", "tradeoff"], ["-o", "tradeoff.nerf"]], ids=" ".join)
def test_the_name_of_a_study_is_no_option_of_it(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[float] = []
    monkeypatch.setattr(
        "pipeline.cli.commands._run_stages", lambda root, settings, *_, **__: seen.append(settings.tradeoff.seconds)
    )
    monkeypatch.chdir(tmp_path)
    run = {"version": 2, "options": {"tradeoff": {"seconds": 1200}}, "plans": {}, "keys": {}}
    Path("photos").mkdir()
    for workspace in ("photos.nerf", "tradeoff", "tradeoff.nerf"):
        Path(workspace).mkdir()
        Path(workspace, "run.json").write_text(json.dumps(run))
    Image.new("RGB", (40, 30)).save("photos/a.jpg")
    run_command(["run", "photos", *words])
    assert seen == [1200]


def test_the_budget_of_a_study_belongs_to_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "run.json").write_text('{"version": 2, "options": {}, "plans": {}, "keys": {}}')
    assert run_command(["mesh", str(tmp_path), "--budget", "30m"]) == 2
    assert "--budget belongs to `pipeline tradeoff`, not to mesh" in capsys.readouterr().err
    assert run_command(["tradeoff", str(tmp_path), "--budget", "soon"]) == 2
    assert "'soon' is not a duration" in capsys.readouterr().err


def test_a_run_has_no_study_unless_it_is_named():
    assert "tradeoff" not in stage_list.usual() and stage_list.usual()[-1] == "report"
    assert "tradeoff" not in stage_list.up_to("mesh") and stage_list.up_to("tradeoff")[-1] == "tradeoff"
    assert stage_list.needed_for("report", {}) == ["report"]


def test_depth_runs_where_training_reads_it():
    without, with_depth = (dict(Settings(train=Config(depth=depth))) for depth in (False, True))
    for options, runs in ((without, False), (with_depth, True)):
        assert ("depth" in stage_list.up_to("report", options)) == runs
        assert ("depth" in stage_list.needed_for("mesh", options)) == runs
        assert "depth" not in stage_list.up_to("normalise", options) + stage_list.needed_for("effects", options)
    stages = stage_list.up_to("report", with_depth)
    assert stages.index("depth") < stages.index("train")


def test_a_budget_does_not_pay_for_depth(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    words = ["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w"), "--budget", "5m", "--train.depth"]
    assert run_command(words) == 2
    assert "--budget and --train.depth" in capsys.readouterr().err
