"""``--more``: training goes on, and nothing that is finished is lost."""

import json
from pathlib import Path

import pytest

from nerf.training.hash_grid_trainer import HashGridTrainer
from pipeline.cli.commands import run_command
from tests.small_scenes import write_blender_scene

SMALL = (
    "--train.grid.num-levels 2 --train.grid.log2-hashmap-size 8 --train.grid.max-res 16"
    " --train.grid.target-samples 512 --train.grid.micro-batches 1"
).split()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Photos, and a workspace with 12 steps of training."""
    folder = tmp_path_factory.mktemp("more")
    photos = str(write_blender_scene(folder / "photos", train=6, test=2, size=24))
    workspace = str(folder / "w.nerf")
    words = [*SMALL, "--train.steps", "12", "--effect", "view_dependence=off", "--effect", "exposure=off"]
    assert run_command(["run", photos, "-o", workspace, "--until", "train", *words]) == 0
    return photos, workspace


def run_of(workspace: str) -> dict:
    return json.loads((Path(workspace) / "run.json").read_text())


def result(workspace: str) -> Path:
    return Path(workspace) / "train" / run_of(workspace)["keys"]["train"][:16]


def steps_of(workspace: str) -> int:
    return json.loads((result(workspace) / "field.json").read_text())["steps"]


def test_more_chains_folders_of_its_own(trained, monkeypatch: pytest.MonkeyPatch):
    photos, workspace = trained
    first, before = result(workspace), (result(workspace) / "manifest.json").read_bytes()
    assert run_command(["run", photos, "-o", workspace, "--until", "train", "--more", "8steps"]) == 0
    second = result(workspace)
    assert second != first and steps_of(workspace) == 20
    assert (first / "manifest.json").read_bytes() == before, "the first stays as it was"
    linked = (Path(workspace) / "output" / "curve.json").resolve()
    assert linked == (second / "curve.json").resolve()
    assert [json.loads((folder / "curve.json").read_text())["single_cycle"] for folder in (first, second)] == [
        True,
        False,
    ]

    moved = Path(workspace).rename(Path(workspace).with_name("moved.nerf"))
    try:
        assert run_command(["resume", str(moved)]) == 0
        assert steps_of(str(moved)) == 20, "nothing to do, wherever the workspace lies"
        assert run_command(["train", str(moved), "--more", "5steps"]) == 0
        assert steps_of(str(moved)) == 25
        folders = [moved / "train" / first.name, moved / "train" / second.name, result(str(moved))]
        stages = [json.loads((folder / "manifest.json").read_text()) for folder in folders]
        took = [stage["seconds"] for stage in stages]
        assert [stage["facts"]["earlier_seconds"] for stage in stages] == pytest.approx([0, took[0], took[0] + took[1]])
        assert run_command(["train", str(moved), "--train.steps", "12"]) == 0
        assert result(str(moved)) == moved / "train" / first.name, "a budget of its own takes back the first"
    finally:
        moved.rename(workspace)


def test_an_interrupted_more_is_taken_up_by_the_same_words(trained, monkeypatch: pytest.MonkeyPatch):
    photos, workspace = trained
    words = ["run", photos, "-o", workspace, "--until", "train", "--more", "9steps"]
    assert run_command(["train", workspace, "--train.steps", "12"]) == 0
    first, step = result(workspace), HashGridTrainer.step

    def interrupted(self: HashGridTrainer, number: int, *rest: float):
        if number == 15:
            raise KeyboardInterrupt
        return step(self, number, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(HashGridTrainer, "step", interrupted)
        assert run_command([*words, "--train.checkpoint-seconds", "1e-9"]) == 130
    assert run_command(["clean", workspace]) == 0
    assert (first / "field.safetensors").is_file(), "the training goes on from it"
    assert run_command(words) == 0
    assert steps_of(workspace) == 21
    cut = (result(workspace) / "field.safetensors").read_bytes()
    assert run_command(["train", workspace, "--force"]) == 0
    assert (result(workspace) / "field.safetensors").read_bytes() == cut, "the same bytes in one piece"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--more", "10"], 2, "'10' is not a duration; write it like 90s, 10m or 1h30m"),
        (["--more", "0steps"], 2, "--more needs at least one step"),
        (["--more", "5steps", "--train.steps", "99"], 2, "--more and --train.steps both set the training time"),
        (["--more", "5steps", "--train.preset", "high"], 2, "--more and --train.preset both set the training time"),
        (["--more", "5steps", "--train.learning-rate", "0.5"], 14, "Give --train.learning-rate 0.02. Train"),
    ],
)
def test_what_does_not_go_together_is_said(trained, capsys: pytest.CaptureFixture[str], words, code, message):
    photos, workspace = trained
    assert run_command(["run", photos, "-o", workspace, "--until", "train", *words]) == code
    assert message in capsys.readouterr().err


def test_more_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    photos = write_blender_scene(tmp_path / "photos", train=6, test=2, size=24)
    assert run_command(["run", str(photos), "-o", str(tmp_path / "w"), "--more", "10m"]) == 3
    assert "is not a workspace" in capsys.readouterr().err
    assert run_command(["run", str(photos), "-o", str(tmp_path / "w"), "--until", "ingest"]) == 0
    assert run_command(["run", str(photos), "-o", str(tmp_path / "w"), "--more", "10m"]) == 3
    said = capsys.readouterr().err
    assert "no training is finished there" in said and f"Run this first: pipeline train {tmp_path / 'w'}" in said


def test_more_belongs_to_training(trained, capsys: pytest.CaptureFixture[str]):
    assert run_command(["evaluate", trained[1], "--more", "10m"]) == 2
    assert "--more belongs to `pipeline train` and `pipeline run`, not to evaluate" in capsys.readouterr().err


def test_a_training_of_another_version_is_not_gone_on_with(trained, capsys: pytest.CaptureFixture[str], monkeypatch):
    def refuse(self: object, state: dict) -> None:
        raise RuntimeError("this state belongs to another field: settings differ")

    photos, workspace = trained
    before = sorted(path for path in result(workspace).rglob("*") if path.is_file())
    monkeypatch.setattr("nerf.training.hash_grid_trainer.HashGridTrainer.load_state", refuse)
    words = ["--more", "6steps", "--train.learning-rate", "0.02"]  # the workspace remembers the rate of another test
    assert run_command(["run", photos, "-o", workspace, "--until", "train", *words]) == 14
    said = capsys.readouterr().err
    assert "another version of this program made" in said and "without --more" in said
    assert all(path.is_file() for path in before), "the finished training stays whole"


def test_the_budget_that_the_workspace_was_made_with_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """What stages were planned by it would be planned anew, and training could not go on with another plan."""
    photos, workspace = write_blender_scene(tmp_path / "photos", train=6, test=2, size=24), str(tmp_path / "w")
    words = ["run", str(photos), "-o", workspace, "--until", "train"]
    few = [*SMALL, "--train.seconds", "0.5", "--effect", "view_dependence=off", "--effect", "exposure=off"]
    assert run_command([*words, *few, "--budget", "2m"]) == 0
    before = run_of(workspace)
    assert " of 2 min spent →" in capsys.readouterr().out
    assert run_command([*words, "--more", "4steps"]) == 0
    assert "spent" not in capsys.readouterr().out, "none of it was: that would be what the first run took"
    after = run_of(workspace)
    assert after["budget"]["total"] == before["budget"]["total"] == 120
    assert after["keys"]["train"] != before["keys"]["train"]
    for stage in ("sfm", "effects"):
        assert after["plans"][stage] == before["plans"][stage]
