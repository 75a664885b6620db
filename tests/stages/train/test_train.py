import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.vanilla_trainer import VanillaTrainer
from stages import train
from stages.contract import Progress
from stages.hardware.device import cores
from stages.io.field_files import load_field
from stages.io.files import read_json
from stages.io.photos import Photo, write_photos
from stages.train import Config
from stages.train.config import GRID_ONLY, PAPER_ONLY
from stages.train.data import training_dataset
from stages.train.fields.hash_grid import LEARNING_RATES
from stages.train.training import prepare
from stages.train.validation_images import unseen_photos, with_validation
from tests.refusals import refused
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed

TINY: dict[str, Any] = {
    "depth": 2,
    "width": 16,
    "samples_coarse": 8,
    "samples_fine": 8,
    "position_frequencies": 4,
    "batch_rays": 64,
    "downscale": 1.0,
    "learning_rate": 5e-3,
}
TINY_GRID: dict[str, Any] = {"levels": 2, "log2_rows": 10, "finest": 32, "batch_samples": 1024, "downscale": 1.0}
TRAINERS = {"grid": HashGridTrainer, "paper": VanillaTrainer}
OUTPUTS = ("field.safetensors", "field.json")


class Killed(BaseException):
    """Stands for kill -9."""


def trained(folder: Path, inputs: dict[str, Path], progress, **settings):
    folder.mkdir(exist_ok=True)
    tiny = TINY_GRID if settings.get("field") == "grid" else TINY
    return train.run(Config(**(tiny | settings)), inputs, folder, progress)


def test_photos_become_a_field_that_beats_a_flat_colour(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    result = trained(tmp_path / "train", inputs, progress, steps=120)
    assert result.outputs == OUTPUTS
    assert all((tmp_path / "train" / name).exists() for name in (*result.outputs, *result.records))
    flat = 11.0  # dB, of the best single colour
    assert flat + 2 < result.facts["probe_psnr"] < 60
    _, info = load_field(tmp_path / "train")
    assert (info["steps"], info["rays"], info["downscale"], info["background"]) == (120, 120 * 64, 1.0, [1, 1, 1])
    assert result.facts["steps"] == 120 and result.facts["restarts"] == result.facts["rollbacks"] == 0
    assert f"{result.facts['probe_psnr']:.1f} dB on test pixels, over time ▁" in result.line
    curve = read_json(tmp_path / "train" / "curve.json")
    assert (curve["device"], curve["threads"], curve["downscale"]) == ("cpu", cores(), 1.0)
    last = curve["points"][-1]
    assert [point["step"] for point in curve["points"]] == [64, 91, 120]
    assert set(last) == {"step", "seconds", "train_psnr", "probe_psnr", "probe_ssim"}
    assert curve["points"][0]["probe_ssim"] < last["probe_ssim"] < 1
    assert progress.notes[0] == "paper field (2 × 16), 120 steps · 6 photos at 1/1 of their size, 2.3 k pixels"


def test_the_grid_field_trains_from_photos_too(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", chunks=2, steps=120)
    flat = 11.0  # dB, of the best single colour
    assert flat + 2 < result.facts["probe_psnr"] < 60
    _, info = load_field(tmp_path / "train")
    assert (info["kind"], info["background"], result.facts["field"]) == ("grid", [1, 1, 1], "grid")
    assert (info["settings"]["num_levels"], info["settings"]["max_res"]) == (2, 32)
    assert 120 * 8 < info["rays"] < 120 * 8192
    colours = result.facts["samples_per_second"] / result.facts["rays_per_second"]
    assert 0.5 < colours < 100, "of a ray"
    assert progress.notes[:2] == [
        "grid field (2 grids of up to 2^10 rows, to 32³), 120 steps · 6 photos at 1/1 of their size, 2.3 k pixels",
        "1,024 colours a step in 2 parts, by warp · samples every 0.057 scene units",
    ]


def test_that_samples_stand_farther_apart_with_distance_is_said(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, bounded=False)
    trained(tmp_path / "train", inputs, progress, field="grid", chunks=1, backend="torch", steps=1)
    assert progress.notes[1] == (
        "1,024 colours a step in 1 part, by torch · samples every 0.042 scene units, "
        "from 0.25 on every 16.7% of the distance"
    )


@pytest.mark.parametrize("field", TRAINERS)
def test_forty_steps_are_twenty_a_kill_and_twenty_more(
    field: str, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    settings = {"field": field, "steps": 40, "background": "random", "checkpoint_seconds": 1e-9}
    trained(tmp_path / "whole", inputs, progress, **settings)
    trainer = TRAINERS[field]
    step = trainer.step

    def killed(self: object, number: int, *rest: float):
        if number == 20:
            raise Killed
        return step(self, number, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "step", killed)
        with pytest.raises(Killed):
            trained(tmp_path / "cut", inputs, progress, **settings)
    assert not (tmp_path / "cut" / "field.json").exists()
    trained(tmp_path / "cut", inputs, progress, **settings)
    assert "going on from step 20 of 40" in progress.notes
    for name in OUTPUTS:
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    final = "checkpoints/000000040.safetensors"  # the optimiser, too
    assert (tmp_path / "cut" / final).read_bytes() == (tmp_path / "whole" / final).read_bytes()


def test_a_grid_field_that_diverges_is_rolled_back(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    step, broken = HashGridTrainer.step, []

    def poisoned(self: HashGridTrainer, number: int, *rest: float):
        if number == 30 and not broken:
            broken.append(number)
            self.model.colour_out[0, 0] = float("nan")
        return step(self, number, *rest)

    monkeypatch.setattr(HashGridTrainer, "step", poisoned)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=60)
    assert result.facts["rollbacks"] == 1
    assert "nonfinite_30.safetensors" in result.records
    assert any("the loss of step 30 is not finite: back to step" in note for note in progress.notes)
    assert 13 < result.facts["probe_psnr"] < 60


def test_an_empty_hash_grid_field_is_given_up(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    monkeypatch.setattr("stages.train.loop.WARM_UP_STEPS", 3)
    monkeypatch.setattr("nerf.fields.mlp.sigma_of", lambda geometry: 0 * geometry[:, 0])
    with refused("train.collapsed", "after 3 steps", "empty", "3 different seeds"):
        trained(tmp_path / "train", inputs, progress, field="grid", steps=20)


def test_another_seed_is_another_field(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    for seed in (0, 1):
        trained(tmp_path / str(seed), inputs, progress, steps=2, seed=seed)
    assert (tmp_path / "0" / OUTPUTS[0]).read_bytes() != (tmp_path / "1" / OUTPUTS[0]).read_bytes()


@pytest.mark.parametrize("ablation", ["view_dependence", "positional_encoding", "hierarchical"])
def test_every_ablation_trains_and_comes_back(ablation: str, tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    trained(tmp_path / "train", inputs, progress, steps=2, **{ablation: False})
    _, info = load_field(tmp_path / "train")
    assert info["settings"][ablation] is False


def test_without_test_photos_nothing_is_held_out(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    scene_file = inputs["normalise"] / "scene.json"
    scene_file.write_text(scene_file.read_text().replace('"test"', '"train"'))
    result = trained(tmp_path / "train", inputs, progress, steps=2)
    assert result.facts["probe_psnr"] is None
    assert "no test photos" in result.line


def test_probes_are_at_the_size_that_photos_are_scored_at(tmp_path: Path, progress) -> None:
    inputs, scene = photographed(tmp_path)
    dataset = training_dataset(inputs["ingest"], scene, "test", 2.0, progress)
    unseen = unseen_photos(Config(downscale=2.0), inputs["ingest"], scene, "test", "cpu", progress)
    assert unseen
    ball_and_white = {(30, 60, 200), (255, 255, 255)}
    assert {*map(tuple, (unseen.probe.colours * 255).round().int().tolist())} == ball_and_white
    assert not {*map(tuple, dataset.pixels[:, :3].tolist())} <= ball_and_white, "at the trained size edges are mixed"


def test_test_photos_of_which_masks_leave_nothing_stop_no_training(tmp_path: Path, progress) -> None:
    """Validation photos, by which a run is to end, do."""
    inputs, masked = photographed(tmp_path, mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    config = Config(downscale=2.0)
    assert unseen_photos(config, inputs["ingest"], masked, "test", "cpu", progress) is None
    why = "the masks ignore every pixel of the test photos at this size"
    assert progress.notes == [f"test photos are not measured while training: {why}"]
    with refused("train.all-masked"):
        unseen_photos(config, inputs["ingest"], with_validation(masked), "validation", "cpu", progress)


def test_two_budgets_are_refused_in_words() -> None:
    with pytest.raises(ValidationError, match=r"steps \(500\) and seconds \(60\) are two budgets; give one"):
        Config(steps=500, seconds=60)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"field": "grid", "width": 64}, r"width \(64\) does not belong to the grid field; leave out one of the two"),
        ({"field": "grid", "preset": "paper"}, r"preset \(paper\) does not belong to the grid field"),
        ({"field": "grid", "hierarchical": False}, r"hierarchical \(False\) does not belong to the grid field"),
        ({"preset": "paper", "levels": 4}, r"levels \(4\) belongs to the grid field and preset \(paper\) to the paper"),
        ({"field": "paper", "levels": 4}, r"levels \(4\) does not belong to the paper field"),
        ({"finest": 64, "depth": 4}, r"finest \(64\) belongs to the grid field and depth \(4\) to the paper field"),
    ],
)
def test_contradicting_options_are_refused_in_words(given: dict, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Config(**given)


def test_options_of_the_paper_field_ask_for_it() -> None:
    of_paper: list[dict[str, Any]] = [{"preset": "paper"}, {"width": 64}, {"hierarchical": False}, {"field": "paper"}]
    of_grid: list[dict[str, Any]] = [{}, {"steps": 3}, {"learning_rate": 1e-3}, {"levels": 4}, {"field": "grid"}]
    assert {Config(**given).kind for given in of_paper} == {"paper"}
    assert {Config(**given).kind for given in of_grid} == {"grid"}


def test_every_option_is_shared_or_of_one_field() -> None:
    shared = {"field", "preset", "steps", "seconds", "learning_rate", "seed", "downscale", "background", "contracted"}
    shared |= {"view_dependence", "checkpoint_seconds", "tensorboard", "target_psnr", "matmul"}
    shared |= {"after", "more_steps", "more_seconds"}
    assert sorted([*shared, *GRID_ONLY, *PAPER_ONLY]) == sorted(Config.model_fields)


@pytest.mark.parametrize("bounded", [True, False])
def test_plan_answers_everything_for_the_grid_field(
    bounded: bool, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.01)
    inputs, _ = photographed(tmp_path, bounded=bounded)
    planned = train.plan(Config(), inputs, progress)
    assert (planned.field, planned.seconds, planned.contracted) == ("grid", 180, not bounded)
    assert any(note.startswith("180 s on this machine draw about ") for note in progress.notes)
    assert (planned.downscale, planned.background) == (1.0, "random")
    assert planned.levels and planned.log2_rows and planned.finest and planned.batch_samples
    assert planned.learning_rate == LEARNING_RATES["bounded" if bounded else "contracted"]
    assert train.plan(Config.model_validate(planned.model_dump()), inputs, progress) == planned
    assert train.plan(Config(levels=3, finest=64), inputs, progress).levels == 3


def test_masked_pixels_do_not_count_for_photo_size(
    tmp_path: Path, progress: Progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.MIN_LONG_SIDE", 2)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[: HEIGHT // 4] = 255
    sizes: dict[str, Any] = {"levels": 2, "log2_rows": 8, "finest": 16, "batch_samples": 256, "steps": 2}
    chosen = []
    for name, given, opaque in (("all", None, None), ("some", mask, None), ("cut out", mask, "yes")):
        inputs, scene = photographed(tmp_path / name, mask=given)
        plain = Photo("", "", WIDTH, HEIGHT, 0, None, None, True, 1.0, opaque_share=0.25)
        photos = [
            replace(plain, name=v.name, file=v.file, used_share=0.5 if opaque else 0.25, opaque_mask=opaque and v.mask)
            for v in scene.views
        ]
        write_photos(inputs["ingest"], photos, [], {})
        chosen.append(train.plan(Config(**sizes), inputs, progress).downscale)
    assert chosen[0] == pytest.approx(2 * chosen[1], abs=0.2) and chosen[1] == chosen[2] > 1


def test_plan_answers_everything_for_the_paper_field(
    tmp_path: Path, progress: Progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.01)
    inputs, _ = photographed(tmp_path)
    planned = train.plan(Config(batch_rays=8), inputs, progress)
    assert (planned.field, planned.background, planned.levels) == ("paper", "white", None)
    assert (planned.preset, planned.depth, planned.width) == ("standard", 4, 64)
    assert (planned.samples_coarse, planned.samples_fine) == (32, 32)
    assert (planned.batch_rays, planned.learning_rate) == (8, 5e-3)
    assert (planned.seconds, planned.steps) == (180, None)
    assert (planned.contracted, planned.spacing, planned.downscale) == (False, "linear", 1.0)
    assert train.plan(Config.model_validate(planned.model_dump()), inputs, progress) == planned


def test_presets_are_budgets_unless_one_is_given(tmp_path: Path, progress: Progress) -> None:
    inputs, _ = photographed(tmp_path)
    sizes: dict[str, Any] = {"downscale": 1.0, "levels": 2, "log2_rows": 8, "finest": 16}

    def budget(**given: Any) -> tuple[float | None, int | None]:
        planned = train.plan(Config(**given), inputs, progress)
        return planned.seconds, planned.steps

    assert [budget(preset=name, **sizes)[0] for name in (None, "draft", "standard", "high")] == [180, 30, 180, 900]
    assert budget(preset="paper", downscale=1.0) == (3600, None)
    assert budget(preset="draft", seconds=7, **sizes) == (7, None)
    assert budget(preset="high", steps=5, **sizes) == (None, 5)


def test_the_published_preset_is_the_published_model(tmp_path: Path, progress: Progress) -> None:
    inputs, _ = photographed(tmp_path, bounded=False)
    planned = train.plan(Config(preset="paper", steps=10, width=128), inputs, progress)
    assert (planned.depth, planned.width, planned.skip) == (8, 128, 4)
    assert (planned.samples_coarse, planned.samples_fine) == (64, 128)
    assert (planned.batch_rays, planned.learning_rate) == (1024, 5e-4)
    assert (planned.contracted, planned.spacing) == (True, "log")


def test_every_seed_is_measured_on_the_same_pixels(tmp_path: Path, progress) -> None:
    inputs, scene = photographed(tmp_path, views=12)
    scene = with_validation(scene)
    found = []
    for seed in (0, 5):
        (folder := tmp_path / f"train{seed}").mkdir()
        config = train.plan(Config(**TINY, steps=1, seed=seed, target_psnr=20.0), inputs, progress)
        probes = prepare(config, scene, inputs, folder, progress).probes
        assert probes.test and probes.target
        unseen = (probes.test, probes.target.photos)
        others = (probe for each in unseen for probe in (each.probe, each.patches.probe))
        found.append([probe.colours for probe in (probes.train, *others)])
    assert len(found[0]) == 5 and all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_a_run_in_seconds_keeps_to_them(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    result = trained(tmp_path / "train", inputs, progress, seconds=1.0)
    assert 0.7 < result.facts["train_seconds"] < 1.5
    decisions = json.loads((tmp_path / "train" / "plan.json").read_text())
    assert decisions[-1][1] == result.facts["steps"] > 2


def test_a_target_is_judged_on_photos_set_aside(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=12, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=400, target_psnr=14.0)
    assert "1 of 9 training photos are set aside to tell when 14 dB are reached" in progress.notes
    assert result.facts["steps"] < 400 and result.facts["validation_psnr"] >= 14
    assert "14 dB reached after" in result.line
    assert "validation" not in (inputs["normalise"] / "scene.json").read_text()


def test_a_target_that_is_missed_is_said(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=12, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=20, target_psnr=60.0)
    assert result.facts["steps"] == 20 and "60 dB not reached in" in result.line


def test_too_few_photos_for_a_target(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=5)
    with refused("train.few-photos-for-target", "3 training photos"):
        trained(tmp_path / "train", inputs, progress, steps=20, target_psnr=20.0)
