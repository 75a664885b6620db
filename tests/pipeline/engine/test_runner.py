"""The runner on three tiny stages: what runs, what is cached, what an interruption leaves."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.engine import status
from pipeline.engine.display import SilentDisplay
from pipeline.engine.failures import StageFailed
from pipeline.engine.job import NotReady
from pipeline.engine.run_digests import RunDigests
from pipeline.engine.runner import Runner
from pipeline.engine.workspace import Workspace
from stages.contract import Inputs, StageError, StageResult
from stages.ingest.sources import find_source
from tests.pipeline.engine import fake_stages
from tests.pipeline.engine.fake_stages import FakeSettings, calls, declare
from tests.refusals import refused

ALL = ("ingest", "sfm", "train")
Bring = Callable[..., bool]


@pytest.fixture(autouse=True)
def fake_chain(monkeypatch: pytest.MonkeyPatch):
    for module in ("runner", "status"):
        monkeypatch.setattr(f"pipeline.engine.{module}.STAGES", fake_stages.STAGES)
    calls.clear()


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        Image.new("RGB", (4, 4), (k, 0, 0)).save(folder / f"{k}.png")
    return folder


@pytest.fixture
def bring(tmp_path: Path, photos: Path) -> Bring:
    """Run the fake chain with options like sfm={"offset": 1}; says whether anything ran, and clears ``calls``."""

    def go(root: Path = tmp_path / "w.nerf", stages=ALL, force=(), replan=(), verify=False, **options: dict) -> bool:
        calls.clear()
        options["ingest"] = {"photos": photos} | options.get("ingest", {})
        settings = FakeSettings.model_validate(options)
        with Workspace(root) as workspace:
            runner = Runner(workspace, settings, SilentDisplay())  # type: ignore[arg-type]
            return runner.run(stages, force=frozenset(force), replan=replan, verify=verify)

    return go


@pytest.mark.parametrize("again", [(), ("train",)], ids=["resumed", "forced"])
def test_a_forecast_is_of_what_is_left(again, bring: Bring, tmp_path: Path, photos: Path, monkeypatch):
    seen = list[Any]()
    declare(monkeypatch, "train", expected_seconds=lambda config, work: seen.append(work.partial("train")))
    settings = FakeSettings.model_validate({"ingest": {"photos": photos}, "train": {"die_at": 2}})
    with Workspace(tmp_path / "w.nerf") as workspace:
        Runner(workspace, settings, SilentDisplay()).forecast(ALL, ())  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        bring(train={"die_at": 2})
    assert seen and set(seen) == {None}
    with Workspace(tmp_path / "w.nerf") as workspace:
        runner = Runner(workspace, settings, SilentDisplay())  # type: ignore[arg-type]
        runner.forecast(ALL, again)
    (partial,) = (tmp_path / "w.nerf" / "train").glob("*.partial")
    assert set(seen) == ({None} if again else {None, partial})


def reader(root: Path) -> tuple[Workspace, Runner]:
    workspace = Workspace.existing(root)
    options = FakeSettings.model_validate(workspace.read_run().options)
    return workspace, Runner(workspace, options, SilentDisplay())  # type: ignore[arg-type]


def test_everything_runs_once(bring: Bring):
    assert bring() is True
    assert calls == ["ingest", "plan sfm", "sfm", "train"]
    assert bring() is False
    assert calls == []


def test_only_what_changed_runs_again(bring: Bring):
    bring()
    bring(train={"steps": 4})
    assert calls == ["train"]
    bring(sfm={"offset": 7}, train={"steps": 4})
    assert calls == ["plan sfm", "sfm", "train"]


def test_a_changed_mask_changes_the_photos(bring: Bring, photos: Path):
    bring()
    (photos / "masks").mkdir()
    for level in (0, 255):
        Image.new("L", (4, 4), level).save(photos / "masks/0.png")
        assert bring() and calls[0] == "ingest"
        assert not bring()


@pytest.mark.parametrize("known", [True, False])
def test_photos_are_listed_once(bring: Bring, tmp_path: Path, known: bool, monkeypatch: pytest.MonkeyPatch):
    bring(stages=ALL if known else ("ingest",))
    if not known:
        Image.new("RGB", (4, 4), (9, 9, 9)).save(tmp_path / "photos/new.png")
    workspace, runner = reader(tmp_path / "w.nerf")
    found, listed = find_source, []
    monkeypatch.setattr("pipeline.engine.run_digests.find_source", lambda *given: listed.append(given) or found(*given))
    with workspace:
        assert [runner.found(stage) is not None for stage in ALL] == [known] * 3
        runner.run(ALL)
    assert len(listed) == 1


def test_going_back_to_old_settings_runs_nothing(bring: Bring):
    bring()
    bring(train={"steps": 4})
    assert bring() is False


def test_equal_upstream_bytes_leave_downstream_cached(bring: Bring):
    bring(ingest={"number": 11})
    assert bring(ingest={"number": 12}) is True
    assert calls == ["ingest"]


def test_photos_are_keyed_by_name_and_content(bring: Bring, photos: Path):
    bring()
    os.utime(photos / "0.png")
    assert bring() is False
    photos.rename(photos.with_name("moved"))
    assert bring(ingest={"photos": photos.with_name("moved")}) is False
    Image.new("RGB", (4, 4), (9, 9, 9)).save(photos.with_name("moved") / "0.png")
    bring(ingest={"photos": photos.with_name("moved")})
    assert calls == ["ingest"]


def test_a_workspace_can_be_moved(bring: Bring, tmp_path: Path):
    bring()
    (tmp_path / "w.nerf").rename(tmp_path / "elsewhere.nerf")
    assert bring(tmp_path / "elsewhere.nerf") is False


def test_a_finished_workspace_outlives_its_photos(bring: Bring, photos: Path, tmp_path: Path):
    bring()
    photos.rename(tmp_path / "gone")
    assert bring() is False


def test_a_plan_stands_until_the_options_change_or_replan(bring: Bring, tmp_path: Path):
    bring()
    (plan,) = json.loads((tmp_path / "w.nerf/run.json").read_text())["plans"]["sfm"].values()
    assert plan["offset"] == 5
    bring(train={"steps": 9})
    assert "plan sfm" not in calls
    bring(replan=ALL)
    assert calls == ["plan sfm"]  # the same answer: the same key, nothing runs


def test_going_back_to_old_options_finds_the_old_plan(bring: Bring):
    bring(sfm={"fail": False})
    bring(sfm={"offset": 9})
    bring(sfm={"fail": False})
    assert calls == []


def test_a_kill_between_manifest_and_rename_loses_nothing(bring: Bring, tmp_path: Path):
    bring()
    (folder,) = (tmp_path / "w.nerf/train").iterdir()
    partial = folder.with_name(folder.name + ".partial")
    folder.rename(partial)
    (partial / "checkpoint.json").write_text("9")  # what finish() had not yet dropped
    bring()
    assert calls == []
    assert sorted(p.name for p in folder.iterdir()) == ["manifest.json", "result.json"]


def test_unhashed_options_do_not_run_a_stage_again(bring: Bring, monkeypatch: pytest.MonkeyPatch):
    declare(monkeypatch, "train", not_hashed=("die_at",))
    bring()
    bring(train={"die_at": 99})
    assert calls == []


def given_to_train(monkeypatch: pytest.MonkeyPatch, **declarations: tuple[str, ...]) -> list[set[str]]:
    """Let train declare these inputs; returns what each run of it is given."""
    run, given = fake_stages.STAGES["train"].run, list[set[str]]()

    def noted(config: Any, inputs: Inputs, *rest: Any) -> StageResult:
        given.append({*inputs})
        return run(config, inputs, *rest)

    declare(monkeypatch, "train", run=noted, **declarations)
    return given


def test_optional_inputs_neither_run_nor_make_stale(bring: Bring, monkeypatch: pytest.MonkeyPatch):
    seen = given_to_train(monkeypatch, inputs=("ingest",), optional_inputs=("sfm",))
    bring(stages=("ingest", "train"))
    bring(stages=("ingest", "sfm"))
    bring(stages=("ingest", "train"))
    assert seen == [{"ingest"}]
    bring(stages=("ingest", "train"), force=frozenset({"train"}))
    assert seen[1:] == [{"ingest", "sfm"}]


def test_damaged_optional_inputs_are_left_out_in_place(bring: Bring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen, notes = given_to_train(monkeypatch, inputs=("ingest",), optional_inputs=("sfm",)), list[str]()
    monkeypatch.setattr(SilentDisplay, "note", lambda _, code, message: notes.append(message))
    bring(stages=("ingest", "sfm"))
    (folder,) = (tmp_path / "w.nerf/sfm").iterdir()
    flip(folder / "deep/number.json")
    bring(stages=("ingest", "train"))
    assert seen == [{"ingest"}] and calls == ["train"]
    assert [p.name for p in folder.parent.iterdir()] == [folder.name], "nobody would make it again"
    (note,) = notes
    assert note.startswith(f"sfm is damaged and left out; `pipeline sfm {tmp_path / 'w.nerf'} --verify` rebuilds it (")
    bring(stages=("ingest", "sfm", "train"), verify=True, force={"train"})
    assert "sfm" in calls and seen[1:] == [{"ingest", "sfm"}]


def test_output_shows_nothing_of_other_settings(bring: Bring, tmp_path: Path):
    bring()
    output = tmp_path / "w.nerf/output"
    assert (output / "result.json").is_file()
    bring(stages=("ingest", "sfm"), sfm={"offset": 1})
    assert (output / "deep/number.json").is_file()
    assert not (output / "result.json").is_symlink(), "the result of train belongs to another sfm"


def test_a_failed_stage_leaves_no_old_link(bring: Bring, tmp_path: Path):
    bring()
    with pytest.raises(StageFailed):
        bring(sfm={"fail": True})
    assert not (tmp_path / "w.nerf/output/deep").exists()


def test_force_runs_again_and_replaces(bring: Bring, tmp_path: Path):
    bring()
    assert bring(force=("sfm",)) is True
    assert calls == ["sfm"]  # its bytes are equal, so train stays cached
    assert len([p for p in (tmp_path / "w.nerf/sfm").iterdir() if p.suffix == ""]) == 1


def test_an_interrupted_stage_goes_on_from_its_checkpoint(bring: Bring, tmp_path: Path):
    with pytest.raises(KeyboardInterrupt):
        bring(train={"steps": 6, "die_at": 4})
    workspace, runner = reader(tmp_path / "w.nerf")
    assert [s.state for s in status.all_statuses(workspace, runner, deep=False)] == ["cached", "cached", "partial"]
    bring(train={"steps": 6, "die_at": 4})
    manifest = next((tmp_path / "w.nerf/train").glob("*/manifest.json"))
    assert json.loads(manifest.read_text())["line"] == "2 steps taken"


def test_a_finished_folder_holds_what_its_manifest_lists(bring: Bring, tmp_path: Path):
    bring()
    for stage in ALL:
        (folder,) = (tmp_path / "w.nerf" / stage).iterdir()
        manifest = json.loads((folder / "manifest.json").read_text())
        listed = {*manifest["outputs"], *manifest["records"], "manifest.json"}
        assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == listed


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "manifest.json").write_text("{"),
        lambda folder: (folder / "manifest.json").write_text("{}"),
        lambda folder: (folder / "manifest.json").unlink(),
        lambda folder: (folder / "result.json").write_text("longer than before, much longer"),
        lambda folder: (folder / "result.json").unlink(),
    ],
    ids=["torn manifest", "empty manifest", "no manifest", "changed output", "missing output"],
)
def test_a_damaged_result_is_set_aside_and_made_again(bring: Bring, tmp_path: Path, damage: Callable[[Path], object]):
    bring()
    (folder,) = (tmp_path / "w.nerf/train").iterdir()
    damage(folder)
    bring()
    assert calls == ["train"]
    assert (folder.with_name(folder.name + ".bad")).is_dir()
    assert json.loads((folder / "result.json").read_text()) == {"steps": 3}


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def test_a_flipped_bit_is_found_before_anything_reads_it(bring: Bring, tmp_path: Path):
    bring()
    (folder,) = (tmp_path / "w.nerf/sfm").iterdir()
    flip(folder / "deep/number.json")
    assert not bring(), "a command with nothing to do looks at sizes alone"
    bring(train={"steps": 5})
    assert calls == ["sfm", "train"]
    assert folder.with_name(folder.name + ".bad").is_dir()


def test_a_record_counts_too_where_asked_to_verify(bring: Bring, tmp_path: Path):
    bring()
    (folder,) = (tmp_path / "w.nerf/sfm").iterdir()
    flip(folder / "log.txt")
    assert [s.state for s in status.all_statuses(*reader(tmp_path / "w.nerf"), deep=False)] == ["cached"] * 3
    assert [s.state for s in status.all_statuses(*reader(tmp_path / "w.nerf"), deep=True)][1] == "damaged"
    bring(verify=True)
    assert calls == ["sfm"]


def test_a_flipped_bit_in_the_books_is_found(bring: Bring, tmp_path: Path):
    bring()
    run_file = tmp_path / "w.nerf/run.json"
    run_file.write_text(run_file.read_text().replace('"steps": 3', '"steps": 7'))
    with refused("pipeline.run-file"):
        Workspace.existing(tmp_path / "w.nerf").read_run()


def test_ctrl_c_reads_no_photos(bring: Bring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bring()

    def interrupted(*_: object) -> None:
        reads.append("photos")
        raise KeyboardInterrupt

    reads: list[str] = []
    monkeypatch.setattr(RunDigests, "of_photos", interrupted)
    with pytest.raises(KeyboardInterrupt):
        bring()
    assert reads == ["photos"]
    assert (tmp_path / "w.nerf/output/result.json").exists(), "nothing was at work, so nothing is out of date"


def test_a_full_disk_under_the_books_is_the_workspaces_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with Workspace(tmp_path / "w.nerf") as workspace:
        monkeypatch.setattr("pipeline.engine.run_file.write_durably", full)
        with refused("pipeline.cannot-write", "No space left on device"):
            workspace.write_run(workspace.read_run())
    monkeypatch.setattr(Path, "write_text", full)
    with refused("pipeline.cannot-write", "No space left on device"), Workspace(tmp_path / "other.nerf"):
        pass
    monkeypatch.undo()
    with Workspace(tmp_path / "other.nerf"):
        pass  # the lock is free again


def test_a_stage_error_names_its_stage_and_keeps_the_rest(bring: Bring, tmp_path: Path):
    with pytest.raises(StageFailed) as caught:
        bring(sfm={"fail": True})
    assert (caught.value.stage, caught.value.error.what) == ("sfm", "it failed")
    bring()
    assert "ingest" not in calls


def test_output_links_point_at_the_latest_result(bring: Bring, tmp_path: Path):
    bring(train={"steps": 3})
    bring(train={"steps": 5})
    output = tmp_path / "w.nerf/output"
    assert json.loads((output / "result.json").read_text()) == {"steps": 5}
    assert (output / "deep/number.json").is_file()
    assert not os.readlink(output / "result.json").startswith("/"), "links survive moving the workspace"


def test_status_and_explain_say_what_changed(bring: Bring, tmp_path: Path):
    bring(train={"steps": 3})
    with Workspace(tmp_path / "w.nerf") as workspace:
        run = workspace.read_run()
        run.options["train"]["steps"] = 8
        workspace.write_run(run)
    workspace, runner = reader(tmp_path / "w.nerf")
    states = status.all_statuses(workspace, runner, deep=False)
    assert [s.state for s in states] == ["cached", "cached", "stale"]
    assert states[2].text == "train.steps: 3 → 8"
    assert "  train.steps: 3 → 8" in status.explain(workspace, runner, "train")
    assert "It would not run: a finished result has this key." in status.explain(workspace, runner, "sfm")
    assert calls[-1:] == ["train"], "looking runs nothing"


def test_status_of_a_chain_that_stopped_early(bring: Bring, tmp_path: Path):
    bring(stages=("ingest",))
    workspace, runner = reader(tmp_path / "w.nerf")
    assert [s.state for s in status.all_statuses(workspace, runner, deep=False)] == ["cached", "never", "never"]
    with pytest.raises(NotReady):
        runner.resolve("train")


def test_two_runs_on_one_workspace(bring: Bring, tmp_path: Path):
    bring()
    with Workspace(tmp_path / "w.nerf"), refused("pipeline.workspace-in-use") as caught:
        bring()
    assert str(os.getpid()) in caught.value.why


def test_a_folder_that_is_no_workspace(tmp_path: Path):
    with refused("pipeline.no-workspace", "run.json"):
        Workspace.existing(tmp_path)
    with refused("pipeline.no-workspace", "no such folder"):
        Workspace.existing(tmp_path / "nowhere")


def test_clean_keeps_what_is_used(bring: Bring, tmp_path: Path):
    bring(train={"steps": 3})
    bring(train={"steps": 5})
    workspace = Workspace.existing(tmp_path / "w.nerf")
    stale = workspace.stale_folders(workspace.read_run().keys, list(ALL))
    assert [p.parent.name for p in stale] == ["train"]
    assert bring(train={"steps": 5}) is False


@pytest.fixture
def dispensable_sfm(monkeypatch: pytest.MonkeyPatch) -> list[set[str]]:
    """Train reads ingest, and sfm where it has a result; returns what each run of it was given."""
    return given_to_train(monkeypatch, inputs=("ingest", "sfm"), dispensable=("sfm",))


def test_a_run_goes_on_without_what_later_stages_can_spare(
    bring: Bring, tmp_path: Path, dispensable_sfm: list[set[str]], monkeypatch: pytest.MonkeyPatch
):
    codes: list[str] = []
    monkeypatch.setattr(SilentDisplay, "note", lambda _, code, message: codes.append(code))
    with pytest.raises(StageFailed) as caught:
        bring(sfm={"fail": True})
    assert caught.value.stage == "sfm" and dispensable_sfm == [{"ingest"}] and codes == ["pipeline.goes-on"]
    assert (tmp_path / "w.nerf/output/result.json").is_file() and not (tmp_path / "w.nerf/output/deep").exists()
    states = [s.state for s in status.all_statuses(*reader(tmp_path / "w.nerf"), deep=False)]
    assert states == ["cached", "failed", "cached"]
    with pytest.raises(StageFailed):
        bring(sfm={"fail": True})
    assert calls == ["sfm"], "what was made without it stays"
    bring()
    assert dispensable_sfm == [{"ingest"}, {"ingest", "sfm"}], "what has it now is made anew"


def test_the_first_failure_decides_the_end(
    bring: Bring, dispensable_sfm: list[set[str]], monkeypatch: pytest.MonkeyPatch
):
    def fail(*_: object) -> None:
        raise StageError("train.fake", "it failed", "as well", "Nothing.")

    codes: list[str] = []
    monkeypatch.setattr(SilentDisplay, "note", lambda _, code, message: codes.append(code))
    declare(monkeypatch, "train", run=fail)
    with pytest.raises(StageFailed) as caught:
        bring(sfm={"fail": True})
    assert caught.value.stage == "sfm" and codes == ["pipeline.goes-on", "pipeline.failed-too"]
    with pytest.raises(StageFailed) as caught:
        bring()
    assert caught.value.stage == "train"


def test_a_failure_ends_the_run_of_what_needs_it(
    bring: Bring, dispensable_sfm: list[set[str]], monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(StageFailed):
        bring(sfm={"fail": True}, stages=("ingest", "sfm"))
    declare(monkeypatch, "train", dispensable=())
    with pytest.raises(StageFailed):
        bring(sfm={"fail": True})
    assert dispensable_sfm == []
