"""Stage train computes its products at "medium" where that is measured to pay, and only while it trains."""

from pathlib import Path
from typing import Any

import pytest
import torch

from nerf.runtime.matmul_precision import MediumPrecision
from nerf.training.hash_grid_trainer import HashGridTrainer
from stages import train
from stages.contract import run_stage
from stages.effects.decisions import Decisions
from stages.train import Config
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.planning import rays_per_second
from stages.train.precision import chosen_precision
from tests.stages.photo_scene import photographed

TINY: dict[str, Any] = {
    "grid": {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024, "backend": "torch"},
    "downscale": 1.0,
}
FAST, INEXACT, NOTHING = MediumPrecision(2.53, 1.2e-5), MediumPrecision(4.0, 3e-4), MediumPrecision(1.0, 2e-7)
SAID = "train.matmul-medium"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch):
    """Sets what "medium" is on this machine; the widths that it was asked for."""
    widths: list[int] = []

    def is_(medium: MediumPrecision) -> list[int]:
        def measured(device: torch.device, width: int) -> MediumPrecision:
            widths.append(width)
            return medium

        monkeypatch.setattr("stages.train.precision.measure_medium_matmul", measured)
        return widths

    return is_


@pytest.fixture
def trained_at(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """At which precision steps were taken."""
    step, seen = HashGridTrainer.step, list[str]()

    def watched(self: HashGridTrainer, *given: Any):
        seen.append(torch.get_float32_matmul_precision())
        return step(self, *given)

    monkeypatch.setattr(HashGridTrainer, "step", watched)
    return seen


@pytest.mark.parametrize(
    "medium, chosen, notes", [(FAST, "medium", [SAID]), (INEXACT, "highest", []), (NOTHING, "highest", [])]
)
def test_a_run_in_seconds_takes_what_pays(
    medium: MediumPrecision, chosen: str, notes: list[str], here, progress
) -> None:
    widths = here(medium)
    by_torch = HashGridOptions(backend="torch")
    assert chosen_precision(Config(seconds=5, field="grid", grid=by_torch), progress) == chosen
    assert chosen_precision(Config(seconds=5, vanilla=VanillaOptions(width=48)), progress) == chosen
    assert progress.codes == 2 * notes and widths == [64, 48]
    assert progress.names(SAID, "2.5 times faster", "1e-05") == bool(notes)


@pytest.mark.parametrize("device, asked", [("cpu", []), ("cuda", [64])])
def test_warp_multiplies_by_itself_on_a_cpu(device: str, asked: list[int], here, progress, monkeypatch) -> None:
    widths, config = here(FAST), Config(seconds=5, field="grid", grid=HashGridOptions(backend="warp"))
    monkeypatch.setattr("stages.train.fields.hash_grid.compute_device", lambda: device)
    assert chosen_precision(config, progress) == ("medium" if asked else "highest")
    assert widths == asked


def test_a_run_in_steps_depends_on_no_measurement(here, progress) -> None:
    widths = here(FAST)
    assert chosen_precision(Config(steps=5, field="grid"), progress) == "highest"
    assert widths == [] and progress.notes == []


def test_planning_keeps_the_choice_and_what_was_asked_for(tmp_path: Path, here, progress) -> None:
    inputs, _ = photographed(tmp_path)
    here(FAST)
    planned = train.plan(Config(**TINY, seconds=5), inputs, progress)
    assert planned.matmul == "medium" and progress.codes.count(SAID) == 1
    here(NOTHING)
    assert train.plan(planned, inputs, progress) == planned
    assert train.plan(Config(**TINY, steps=5, matmul="medium"), inputs, progress).matmul == "medium"
    assert train.plan(Config(**TINY, seconds=5), inputs, progress).matmul == "highest"


@pytest.mark.parametrize("matmul", ["medium", "highest"])
def test_it_is_set_while_training_alone_and_recorded(matmul, tmp_path: Path, here, trained_at, progress) -> None:
    inputs, _ = photographed(tmp_path)
    here(FAST)
    (tmp_path / "train").mkdir()
    result = run_stage(train.STAGE, Config(**TINY, steps=2, matmul=matmul), inputs, tmp_path / "train", progress)
    assert trained_at == [matmul] * 2 and torch.get_float32_matmul_precision() == "highest"
    facts = {"matmul": matmul, "medium_matmul_speedup": 2.53, "medium_matmul_error": 1.2e-5}
    assert facts.items() <= result.facts.items()


def test_speed_is_measured_as_it_will_be_trained(tmp_path: Path, trained_at, progress, monkeypatch) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.0)
    inputs, scene = photographed(tmp_path)
    config = train.plan(Config(**TINY, steps=5, matmul="medium"), inputs, progress)
    assert rays_per_second(config, scene, Decisions()) > 0
    assert set(trained_at) == {"medium"} and torch.get_float32_matmul_precision() == "highest"


def test_products_that_are_inexact_on_another_machine_are_said(tmp_path: Path, here, progress) -> None:
    inputs, _ = photographed(tmp_path)
    here(INEXACT)
    for matmul in ("medium", "highest"):
        (tmp_path / matmul).mkdir()
        run_stage(train.STAGE, Config(**TINY, steps=1, matmul=matmul), inputs, tmp_path / matmul, progress)
    assert progress.codes.count("train.matmul-inexact") == 1
    assert progress.names("train.matmul-inexact", "3e-04", "--train.matmul highest")
