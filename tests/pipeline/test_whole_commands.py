"""Commands in which the command line, the engine and the demo meet: the work that these hand on is replaced here."""

import json
from pathlib import Path

import pytest
from PIL import Image

from pipeline.cli.commands import command_demo, run_command
from pipeline.engine.run_digests import RunDigests
from pipeline.engine.settings import Settings
from stages.contract import StageError


def test_a_photo_now_unreadable_fails_its_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    assert run_command(["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w.nerf"), "--until", "ingest"]) == 0

    def unreadable(_: RunDigests) -> str:
        raise StageError("ingest.cannot-read", "cannot read 1.png", "Permission denied", "Check its permissions.")

    monkeypatch.setattr(RunDigests, "of_photos", unreadable)
    assert run_command(["resume", str(tmp_path / "w.nerf")]) == 10
    assert "cannot read 1.png" in capsys.readouterr().err


def test_the_demo_leaves_a_study_as_it_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[float] = []

    def run_stages(_root: Path, settings: Settings, *_: object, **__: object) -> int:
        seen.append(settings.tradeoff.seconds)
        return 1

    workspace = tmp_path / "demo.nerf"
    workspace.mkdir()
    run = {"version": 2, "options": {"tradeoff": {"seconds": 1200}}, "plans": {}, "keys": {}}
    (workspace / "run.json").write_text(json.dumps(run))
    monkeypatch.setattr("pipeline.cli.commands._run_stages", run_stages)
    monkeypatch.setattr("pipeline.demo.photograph", lambda photos, display: ("made", 0.0))
    monkeypatch.setattr("pipeline.cli.commands.with_source", lambda settings, *_: settings)
    monkeypatch.setattr("pipeline.demo.truth_lines", lambda *_: ["compared"])
    assert command_demo(["-o", str(tmp_path)]) == 1
    assert seen == [1200]
