"""Training by several processes, as the stage starts them: the same field, a killed one, resuming with another
number."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from nerf.training.hash_grid_trainer import HashGridTrainer
from stages.effects.decisions import Decisions, write_decisions
from stages.hardware import ranks
from stages.train import Config
from stages.train.training import ranks_of
from tests.refusals import refused
from tests.stages.photo_scene import photographed
from tests.stages.train.launched import SETTINGS
from tests.stages.train.test_train import OUTPUTS, Killed, tiny, trained

ROOT = Path(__file__).parents[3]
FINAL = "checkpoints/000000024.safetensors"  # the optimiser, too


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    """A scene with effects whose parameters are learnt."""
    folders, _ = photographed(tmp_path)
    learnt = {name: {} for name in ("view_dependence", "exposure", "vignetting", "pose_refinement")}
    write_decisions(folders["effects"], Decisions(learnt))
    return folders


def same_files(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in (*OUTPUTS, FINAL))


def strike(monkeypatch: pytest.MonkeyPatch, step: int, blow: Callable[[], None]) -> None:
    """Have ``blow`` happen in this process, rank 0, as it takes that step."""
    take = HashGridTrainer.step

    def struck(self: HashGridTrainer, number: int, *rest: float):
        if number == step:
            blow()
        return take(self, number, *rest)

    monkeypatch.setattr(HashGridTrainer, "step", struck)


def test_one_process_and_two_resume_each_other(
    tmp_path: Path, inputs: dict[str, Path], progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One process is killed, two go on, the second of them is killed, one goes on again."""
    trained(tmp_path / "whole", inputs, progress, **SETTINGS)

    def killed() -> None:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        strike(patch, 8, killed)
        trained(tmp_path / "cut", inputs, progress, **SETTINGS)
    start, started = ranks._child, list[subprocess.Popen[bytes]]()

    def remembered(*arguments: int) -> ranks.Child:
        child = start(*arguments)
        started.append(child[0])
        return child

    with monkeypatch.context() as patch, refused("hardware.rank-lost", "rank 1", "signal 9"):
        patch.setattr("stages.hardware.ranks._child", remembered)
        strike(patch, 16, lambda: os.kill(started[0].pid, signal.SIGKILL))
        trained(tmp_path / "cut", inputs, progress, devices=2, **SETTINGS)
    assert not (tmp_path / "cut" / "field.json").exists()
    trained(tmp_path / "cut", inputs, progress, **SETTINGS)
    assert [text.count(" 8 of 24") for text in progress.said("train.resumes")] == [1, 0]
    assert same_files(tmp_path / "whole", tmp_path / "cut")


def test_two_processes_train_the_field_of_one(tmp_path: Path, inputs: dict[str, Path], progress) -> None:
    """Started by the stage, and by torchrun."""
    trained(tmp_path / "alone", inputs, progress, **SETTINGS)
    result = trained(tmp_path / "both", inputs, progress, devices=2, **SETTINGS)
    assert same_files(tmp_path / "alone", tmp_path / "both")
    assert result.facts["ranks"] == {"size": 2, "backend": "gloo", "table_gradient": "sparse"}
    assert 1e3 < result.facts["received_bytes_per_step"] < 1e6 and 0 < result.facts["exchange_share"] < 1
    assert progress.names("train.ranks", 2, "gloo")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    words = [*torchrun, "-m", "tests.stages.train.launched", str(tmp_path)]
    said = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert "2 ranks" in said.stdout
    assert same_files(tmp_path / "alone", tmp_path / "launched")


def test_one_process_has_no_ranks(inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.setattr("stages.hardware.ranks.leading", lambda *_: pytest.fail("nobody is to be started"))
    with ranks_of(tiny("grid"), inputs) as none:
        assert none is None


def test_a_process_on_another_device_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "compute_device", lambda: "another")
    with refused("hardware.rank-lost", "rank 1 computes on", "rank 0 on another"), ranks.leading(2, {}):
        pass


def test_devices_that_cannot_share_a_step_are_refused(inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    few, both = (tiny("grid", devices=count, grid={"micro_batches": 2}) for count in (3, 2))
    with refused("hardware.too-many-devices", 3, 2), ranks_of(few, inputs):
        pass
    with pytest.raises(ValueError, match=r"train\.devices has no effect"):
        Config(field="vanilla", devices=2)
    for name, value in dict(zip(ranks.OF_LAUNCHER, ("1", "0", "4", "127.0.0.1", "1"), strict=True)).items():
        monkeypatch.setenv(name, value)
    with refused("train.one-device"), ranks_of(tiny("vanilla"), inputs):
        pass
    with refused("hardware.two-launchers", 4, 2), ranks_of(both, inputs):
        pass
