"""Rates far too high, numbers that are none, damaged checkpoints: never a bad model that looks like a good one."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from nerf.training.evaluation_pixels import evaluate, sample_evaluation_pixels
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.ray_dataset import CENTRE, NEAR_AND_FAR, ROTATION, RayDataset
from nerf.training.vanilla_trainer import VanillaTrainer
from stages import train
from stages.contract import StageError, StageResult, run_stage
from stages.effects.decisions import read_decisions, write_decisions
from stages.ingest.decoding import DecodeError, decode
from stages.io.field_files import load_field
from stages.io.files import read_scene
from stages.train import loop
from stages.train.checkpoints import failure_reason
from stages.train.data import training_dataset
from stages.train.fields.field_list import make_trainer, with_defaults
from stages.train.fields.hash_grid_options import HashGridOptions
from tests.refusals import refused
from tests.stages.photo_scene import photographed

GRID: dict[str, Any] = {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024}
KINDS: dict[str, dict[str, Any]] = {
    "torch": {"grid": GRID | {"backend": "torch"}, "learning_rate": 2e-2},
    "warp": {"grid": GRID | {"backend": "warp"}, "learning_rate": 2e-2},
    "vanilla": {
        "vanilla": {"depth": 2, "width": 16, "samples_coarse": 8, "samples_fine": 8, "batch_rays": 64},
        "learning_rate": 5e-3,
    },
}
WARM_UP = 40
NAMED = ("training diverged", "the field does not learn")


@pytest.fixture(autouse=True)
def short_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "MIN_HEALTHY_STEPS", WARM_UP)
    monkeypatch.setattr("stages.train.training.write_profile", lambda *_: [])
    monkeypatch.setattr("stages.train.validation_images.EVALUATION_PIXELS", 256)


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    return photographed(tmp_path, channels=4)[0]


def trained(kind: str, inputs: dict[str, Path], folder: Path, progress: Any, **settings: Any) -> StageResult:
    folder.mkdir(exist_ok=True)
    config: dict[str, Any] = {"downscale": 1.0} | KINDS[kind] | settings
    return run_stage(train.STAGE, train.Config(**config), inputs, folder, progress)


def seen(folder: Path, inputs: dict[str, Path], progress: Any) -> tuple[float, float]:
    """PSNR of the field in ``folder`` on training photos, and that of a flat colour."""
    dataset = training_dataset(inputs["ingest"], read_scene(inputs["normalise"]), "train", 1.0, progress)
    pixels = sample_evaluation_pixels(dataset, 512, torch.ones(3), 0)
    return evaluate(load_field(folder)[0], pixels).psnr, pixels.mean_colour_psnr


@pytest.mark.parametrize("steps", [WARM_UP - 20, WARM_UP + 20])
@pytest.mark.parametrize("rate", [*(pytest.param(rate, marks=pytest.mark.slow) for rate in (1e-1, 1.0)), 10.0])
@pytest.mark.parametrize("kind", KINDS)
def test_a_far_too_high_rate_is_never_silent(
    kind: str, rate: float, steps: int, inputs: dict[str, Path], tmp_path: Path, progress: Any
) -> None:
    try:
        result = trained(kind, inputs, tmp_path / "train", progress, steps=steps, learning_rate=rate)
    except StageError as refusal:
        assert refusal.what in NAMED and "--train.learning-rate" in refusal.hint
        assert steps > WARM_UP or refusal.what == "training diverged"
        return
    psnr, flat = seen(tmp_path / "train", inputs, progress)
    if psnr > flat + 1:  # the loop looks at other pixels
        assert result.facts["failure_reason"] is None
    if psnr < flat - 1:
        assert steps < WARM_UP and str(result.facts["failure_reason"]) in result.line
        assert "train.undertrained" in progress.codes


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_lost_after_warm_up_goes_back(
    kind: str, inputs: dict[str, Path], tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil_once_at(WARM_UP + 20, _forget, monkeypatch, kind)
    result = trained(kind, inputs, tmp_path / "train", progress, steps=WARM_UP + 20, checkpoint_seconds=0.1)
    assert (result.facts["rollbacks"], result.facts["failure_reason"]) == (1, None)
    assert progress.names("train.rolled-back", "the field has collapsed")
    psnr, flat = seen(tmp_path / "train", inputs, progress)
    assert flat + 1 < psnr < 60


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_lost_again_and_again_is_refused_by_name(
    kind: str, inputs: dict[str, Path], tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil_at(WARM_UP + 20, _forget, monkeypatch, kind)
    with refused("train.diverged", "after 60 steps", "3 roll-backs"):
        trained(kind, inputs, tmp_path / "train", progress, steps=WARM_UP + 20, checkpoint_seconds=0.1)
    assert not (tmp_path / "train" / "field.json").exists()


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", KINDS)
def test_weights_that_the_last_update_broke_are_never_kept(
    kind: str, poison: float, inputs: dict[str, Path], tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_one_weight(trainer: Any) -> None:
        weights = trainer.state()
        weights["model.table" if kind != "vanilla" else "model.fine.trunk.0.weight"].view(-1)[7] = poison

    spoil_once_at(12, break_one_weight, monkeypatch, kind)
    result = trained(kind, inputs, tmp_path / "train", progress, steps=12)
    assert result.facts["rollbacks"] == 1
    assert progress.names("train.rolled-back", "not finite", "back to step 0")
    assert weights_are_finite(tmp_path / "train")


# Of the dataset: near and far, the cameras' places, their rotations; and how ray directions change from pixel to pixel.
ROWS = {
    "near": ("view_geometry", NEAR_AND_FAR.start),
    "far": ("view_geometry", NEAR_AND_FAR.stop - 1),
    "centres": ("view_geometry", CENTRE.start),
    "rotations": ("view_geometry", ROTATION.start + 4),
}
ROWS["ray_directions"] = ("patches", 1)


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("kind", KINDS)
def test_rays_that_are_no_numbers_end_training_by_name(
    kind: str,
    row: str,
    poison: float,
    inputs: dict[str, Path],
    tmp_path: Path,
    progress: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def poisoned(dataset: RayDataset) -> None:
        table, number = ROWS[row]
        getattr(dataset, table)[number, ::2] = poison

    spoil_at(5, lambda trainer: poisoned(trainer.dataset), monkeypatch, kind)
    with refused("train.diverged", "geometry of rays", "3 roll-backs", "cameras"):
        trained(kind, inputs, tmp_path / "train", progress, steps=10)
    assert progress.names("train.rolled-back", "the geometry of rays of step 5")
    assert (tmp_path / "train" / "nonfinite_5.safetensors").is_file()


@pytest.mark.parametrize("effect", ["pose_refinement", "exposure"])
@pytest.mark.parametrize("kind", KINDS)
def test_per_image_parameters_are_gated_and_rolled_back(
    kind: str, effect: str, inputs: dict[str, Path], tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_decisions(inputs["effects"], read_decisions(inputs["effects"]).having(effect))
    monkeypatch.setattr(loop, "MIN_HEALTHY_STEPS", 3 * WARM_UP)  # the rate is halved: at first it looks collapsed

    def poison(trainer: Any) -> None:
        next(iter(trainer.effects.parameters.values())).detach().view(-1)[::2] = float("nan")

    spoil_once_at(20, poison, monkeypatch, kind)
    result = trained(kind, inputs, tmp_path / "train", progress, steps=3 * WARM_UP + 21)
    assert result.facts["rollbacks"] == 1 and "nonfinite_20.safetensors" in result.records
    assert weights_are_finite(tmp_path / "train")


def weights_are_finite(folder: Path) -> bool:
    return all(tensor.isfinite().all() for tensor in load_file(folder / "field.safetensors").values())


@pytest.mark.parametrize("kind", KINDS)
def test_every_checkpoint_of_a_sound_run_is_sound(kind: str, inputs: dict[str, Path], tmp_path: Path, progress: Any):
    result = trained(kind, inputs, tmp_path / "train", progress, steps=WARM_UP + 20, checkpoint_seconds=0.05)
    assert (result.facts["rollbacks"], result.facts["restarts"], result.facts["failure_reason"]) == (0, 0, None)
    assert not {"train.restarted", "train.undertrained"} & {*progress.codes}


@pytest.mark.parametrize("other", [{"log2_hashmap_size": 11}, {"max_res": 31}, {"num_levels": 3}])
def test_a_checkpoint_of_another_field_is_named_and_skipped(
    other: dict[str, int], inputs: dict[str, Path], tmp_path: Path, progress: Any
) -> None:
    _checkpoint_of_another(tmp_path, inputs, progress, "torch", {"grid": KINDS["torch"]["grid"] | other})


@pytest.mark.parametrize("other", [{"width": 18}, {"depth": 3}, {"density_activation": "relu"}, {"spacing": "log"}])
def test_so_is_one_of_another_vanilla_field(
    other: dict[str, Any], inputs: dict[str, Path], tmp_path: Path, progress: Any
) -> None:
    _checkpoint_of_another(tmp_path, inputs, progress, "vanilla", {"vanilla": KINDS["vanilla"]["vanilla"] | other})


def _checkpoint_of_another(
    folder: Path, inputs: dict[str, Path], progress: Any, kind: str, other: dict[str, Any]
) -> None:
    """Of step 20, beside our own of step 10."""
    mine, theirs = folder / "mine", folder / "theirs"
    trained(kind, inputs, mine, progress, steps=10)
    trained(kind, inputs, theirs, progress, steps=20, **other)
    expected = (mine / "field.safetensors").read_bytes()
    for file in (theirs / "checkpoints").glob("*20.*"):
        shutil.copy(file, mine / "checkpoints")
    again = trained(kind, inputs, mine, progress, steps=10)
    assert again.facts["steps"] == 10
    assert progress.names("train.checkpoint-skipped", "step 20", "another training")
    assert (mine / "field.safetensors").read_bytes() == expected


def test_nan_is_a_failure_reason(inputs: dict[str, Path], progress: Any) -> None:
    """Comparisons with NaN are false: neither empty nor worse than a flat colour would be said of it."""
    dataset = training_dataset(inputs["ingest"], read_scene(inputs["normalise"]), "train", 1.0, progress)
    trainer = train_loop_trainer(inputs, dataset)
    pixels = sample_evaluation_pixels(dataset, 64, torch.ones(3), 0)
    trainer.model.colour_out[:] = float("nan")
    assert failure_reason(trainer, pixels) == "its model.colour_out is not finite"
    trainer.model.colour_out[:] = 3e38
    trainer.model.colour_hidden[:] = 3e38
    reason = failure_reason(trainer, pixels)
    assert reason is None or "not finite" in reason or "flat colour" in reason


def train_loop_trainer(inputs: dict[str, Path], dataset: RayDataset) -> HashGridTrainer:
    asked = train.Config(downscale=1.0, steps=1, grid=HashGridOptions(**GRID, micro_batches=1, backend="torch"))
    config = with_defaults(asked.model_copy(update={"space": "bounded", "view_dependence": True}))
    trainer = make_trainer(config, read_scene(inputs["normalise"]), dataset, 0)
    assert isinstance(trainer, HashGridTrainer)
    return trainer


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), float("-inf")])
def test_a_float_photo_with_nan_is_refused_by_name(tmp_path: Path, poison: float) -> None:
    values = np.full((20, 30), 0.5, np.float32)
    Image.fromarray(values).save(tmp_path / "fine.tif")
    values[3, 4] = poison
    Image.fromarray(values).save(tmp_path / "poisoned.tif")
    assert decode(tmp_path / "fine.tif").pixels.shape == (20, 30, 3)
    with pytest.raises(DecodeError, match="1 of its 600") as refusal:
        decode(tmp_path / "poisoned.tif")
    assert refusal.value.code == "ingest.not-finite"


@pytest.mark.parametrize(
    "head", [b"\x76\x2f\x31\x01\x02\x00\x00\x00", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n\x02\x02"]
)
def test_openexr_and_radiance_files_are_no_photos(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "light.bin").write_bytes(head + bytes(range(256)))
    with pytest.raises(DecodeError) as refusal:
        decode(tmp_path / "light.bin")
    assert refusal.value.code == "ingest.not-an-image"


def _forget(trainer: Any) -> None:
    """The weights of a field that is empty everywhere, all of them finite."""
    with torch.no_grad():
        if isinstance(trainer, VanillaTrainer):
            trainer.model.fine.density_head.weight.zero_()
            trainer.model.fine.density_head.bias.fill_(-100)
        else:
            for name, value in {"table": 1.0, "density_hidden": 1.0, "density_out": -1.0}.items():
                getattr(trainer.model, name).fill_(value)


def spoil_at(step: int, spoil: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """``spoil`` the trainer whenever it has taken so many steps."""
    trainer = VanillaTrainer if kind == "vanilla" else HashGridTrainer
    take = trainer.step

    def spoiled(self: Any, number: int, *rest: float):
        result = take(self, number, *rest)
        if number + 1 == step:
            spoil(self)
        return result

    monkeypatch.setattr(trainer, "step", spoiled)


def spoil_once_at(step: int, spoil: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """:func:`spoil_at`, only the first time."""
    done = []

    def first_time(trainer: Any) -> None:
        if not done:
            done.append(step)
            spoil(trainer)

    spoil_at(step, first_time, monkeypatch, kind)
