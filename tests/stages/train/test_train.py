import json
import time
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.vanilla_trainer import VanillaTrainer
from stages import train
from stages.contract import Progress, run_stage
from stages.depth.consistency import DepthMap
from stages.depth.files import depth_map_file, write_depth_map
from stages.hardware.device import cores
from stages.io.field_files import load_field
from stages.io.files import read_json
from stages.io.photos import Photo, write_photos
from stages.train import Config
from stages.train.config import FIELD_NAMES, OPTIONS_OF_FIELD, FieldName
from stages.train.data import training_dataset
from stages.train.fields.hash_grid import LEARNING_RATES
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.training import prepare
from stages.train.validation_images import held_out_evaluation, with_validation_split
from tests.refusals import refused
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed

TINY: dict[FieldName, dict[str, Any]] = {
    "grid": {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024},
    "vanilla": {
        "depth": 2,
        "width": 16,
        "samples_coarse": 8,
        "samples_fine": 8,
        "position_frequencies": 4,
        "batch_rays": 64,
    },
}
TRAINERS: dict[FieldName, Any] = {"grid": HashGridTrainer, "vanilla": VanillaTrainer}
ABLATIONS: list[dict[str, Any]] = [{"vanilla": {"positional_encoding": False}}, {"vanilla": {"hierarchical": False}}]
OUTPUTS = ("field.safetensors", "field.json")


class Killed(BaseException):
    """Stands for kill -9."""


def tiny(field: FieldName = "vanilla", **settings: Any) -> Config:
    """A small field: ``settings`` of the stage, and of the field under its name."""
    options: dict[str, Any] = {"downscale": 1.0, "learning_rate": 5e-3 if field == "vanilla" else None} | settings
    return Config(**options | {"field": field, field: TINY[field] | settings.get(field, {})})


def trained(folder: Path, inputs: dict[str, Path], progress, field: FieldName = "vanilla", **settings):
    folder.mkdir(exist_ok=True)
    return run_stage(train.STAGE, tiny(field, **settings), inputs, folder, progress)


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
    (sizes,) = progress.said("train.sizes")
    assert "120 steps" in sizes and "6 photos at 1/1" in sizes


def test_the_grid_field_trains_from_photos_too(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=120, grid={"micro_batches": 2})
    flat = 11.0  # dB, of the best single colour
    assert flat + 2 < result.facts["probe_psnr"] < 60
    _, info = load_field(tmp_path / "train")
    assert (info["kind"], info["background"], result.facts["field"]) == ("grid", [1, 1, 1], "grid")
    assert (info["settings"]["num_levels"], info["settings"]["max_res"]) == (2, 32)
    assert 120 * 8 < info["rays"] < 120 * 8192
    colours = result.facts["colours_per_second"] / result.facts["rays_per_second"]
    assert 0.5 < colours < 100, "of a ray"
    (sizes,), (step,) = progress.said("train.sizes"), progress.said("train.step")
    assert "2^10" in sizes and "2.3 k pixels" in sizes and "1,024" in step and "0.057" in step


def test_depth_maps_are_used_where_asked_for(tmp_path: Path, progress) -> None:
    inputs, scene = photographed(tmp_path)
    for view in scene.of_split("train"):
        path = depth_map_file(tmp_path / "depth", view.file)
        path.parent.mkdir(parents=True, exist_ok=True)
        distance = np.array([[0, (view.near + view.far) / 2]], np.float32)
        write_depth_map(path, DepthMap(distance, distance / 100, (distance > 0).astype(np.uint8)))
    fields = []
    for depth in (False, True):
        given = inputs | ({"depth": tmp_path / "depth"} if depth else {})
        trained(tmp_path / f"train{depth}", given, progress, field="grid", steps=4, depth=depth)
        assert set(train.more_inputs(Config(depth=depth))) == given.keys() - inputs.keys()
        fields.append((tmp_path / f"train{depth}" / "field.safetensors").read_bytes())
    assert fields[0] != fields[1]
    (known,) = progress.said("train.depth-maps")
    assert "50%" in known


def test_that_samples_stand_farther_apart_with_distance_is_said(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, bounded=False)
    trained(tmp_path / "train", inputs, progress, field="grid", steps=1, grid={"micro_batches": 1, "backend": "torch"})
    (step,) = progress.said("train.step")
    assert "0.042" in step and "16.7%" in step


@pytest.mark.parametrize("field", TRAINERS)
def test_forty_steps_are_twenty_a_kill_and_twenty_more(
    field: FieldName, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
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
    (resumed,) = progress.said("train.resumes")
    assert "20 of 40" in resumed
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
    assert "step 30" in progress.said("train.rolled-back")[0]
    assert 13 < result.facts["probe_psnr"] < 60


def test_an_empty_hash_grid_field_is_given_up(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    monkeypatch.setattr("stages.train.loop.MIN_HEALTHY_STEPS", 3)
    step = HashGridTrainer.step

    def emptied(self: HashGridTrainer, number: int, *rest: float):
        result = step(self, number, *rest)
        for part, value in ((self.model.table, 1.0), (self.model.density_hidden, 1.0), (self.model.density_out, -99.0)):
            part.fill_(value)
        return result

    monkeypatch.setattr(HashGridTrainer, "step", emptied)
    with refused("train.collapsed", "after 3 steps", "empty", "3 different seeds"):
        trained(tmp_path / "train", inputs, progress, field="grid", steps=20)


def test_another_seed_is_another_field(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    for seed in (0, 1):
        trained(tmp_path / str(seed), inputs, progress, steps=2, seed=seed)
    assert (tmp_path / "0" / OUTPUTS[0]).read_bytes() != (tmp_path / "1" / OUTPUTS[0]).read_bytes()


@pytest.mark.parametrize("ablation", [{"view_dependence": False}, *ABLATIONS])
def test_every_ablation_trains_and_comes_back(ablation: dict[str, Any], tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path)
    trained(tmp_path / "train", inputs, progress, steps=2, **ablation)
    _, info = load_field(tmp_path / "train")
    left_out = ablation.get("vanilla", ablation)
    assert info["settings"] | left_out == info["settings"]


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
    held_out = held_out_evaluation(Config(downscale=2.0), inputs["ingest"], scene, "test", "cpu", progress)
    assert held_out
    ball_and_white = {(30, 60, 200), (255, 255, 255)}
    assert {*map(tuple, (held_out.pixels.colours * 255).round().int().tolist())} == ball_and_white
    assert not {*map(tuple, dataset.pixels[:, :3].tolist())} <= ball_and_white, "at the trained size edges are mixed"


def test_test_photos_of_which_masks_leave_nothing_stop_no_training(tmp_path: Path, progress) -> None:
    """Validation photos, by which a run is to end, do."""
    inputs, masked = photographed(tmp_path, mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    config = Config(downscale=2.0)
    assert held_out_evaluation(config, inputs["ingest"], masked, "test", "cpu", progress) is None
    why = "the masks ignore every pixel of the test photos at this size"
    assert progress.codes == ["train.no-test-photos"] and why in progress.notes[0]
    with refused("train.all-masked"):
        held_out_evaluation(config, inputs["ingest"], with_validation_split(masked), "validation", "cpu", progress)


def test_two_budgets_are_refused_in_words() -> None:
    with pytest.raises(ValidationError, match=r"--train\.steps 500 and --train\.seconds 60 both set the training time"):
        Config(steps=500, seconds=60)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"field": "grid", "vanilla": {"width": 64}}, "vanilla.width has no effect with --train.field grid; leave out"),
        ({"field": "grid", "preset": "paper"}, "preset paper has no effect with --train.field grid"),
        (
            {"field": "grid", "vanilla": {"hierarchical": False}},
            "vanilla.hierarchical has no effect with --train.field",
        ),
        ({"field": "vanilla", "depth": True}, "depth has no effect with --train.field vanilla"),
        ({"preset": "paper", "grid": {"num_levels": 4}}, "grid.num-levels has no effect with --train.preset paper"),
        ({"field": "vanilla", "grid": {"num_levels": 4}}, "grid.num-levels has no effect with --train.field vanilla"),
        ({"grid": {"max_res": 64}, "vanilla": {"depth": 4}}, "vanilla.depth has no effect with --train.grid.max-res"),
    ],
)
def test_contradicting_options_are_refused_in_words(given: dict, message: str) -> None:
    with pytest.raises(ValidationError, match=f"--train.{message}"):
        Config(**given)


def test_options_of_a_field_ask_for_it() -> None:
    vanilla: list[dict[str, Any]] = [
        *({"preset": "paper"}, {"field": "vanilla"}, {"field": "vanilla", "preset": "paper"}),
        *({"vanilla": {"width": 64}}, {"vanilla": {"hierarchical": False}}),
    ]
    grid: list[dict[str, Any]] = [
        {},
        {"steps": 3},
        {"learning_rate": 1e-3},
        {"grid": {"num_levels": 4}},
        {"field": "grid"},
    ]
    assert {Config(**given).kind for given in vanilla} == {"vanilla"}
    assert {Config(**given).kind for given in grid} == {"grid"}


def test_every_field_has_its_options_under_its_name() -> None:
    assert {name: Config.model_fields[name].annotation for name in FIELD_NAMES} == OPTIONS_OF_FIELD


@pytest.mark.parametrize("given", [{}, {"grid": {"num_levels": 4}}, {"preset": "paper"}, {"vanilla": {"width": 9}}])
def test_recorded_options_are_of_one_field_alone(given: dict) -> None:
    config = Config(**given)
    assert {*config.model_dump(mode="json")} & {*FIELD_NAMES} == {config.kind}
    assert {*config.model_dump(include={*FIELD_NAMES})} == {config.kind}
    assert Config.model_validate_json(config.model_dump_json()) == config


@pytest.mark.parametrize("bounded", [True, False])
def test_plan_answers_everything_for_the_grid_field(
    bounded: bool, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.01)
    inputs, _ = photographed(tmp_path, bounded=bounded)
    planned = train.plan(Config(), inputs, progress)
    assert (planned.field, planned.seconds, planned.space) == ("grid", 180, "bounded" if bounded else "contracted")
    assert "3 min" in progress.said("train.photo-size")[0]
    assert (planned.downscale, planned.background) == (1.0, "random")
    assert None not in planned.grid.model_dump().values()
    assert planned.learning_rate == LEARNING_RATES["bounded" if bounded else "contracted"]
    assert train.plan(Config.model_validate(planned.model_dump()), inputs, progress) == planned
    assert train.plan(Config(grid=HashGridOptions(num_levels=3, max_res=64)), inputs, progress).grid.num_levels == 3


def test_masked_pixels_do_not_count_for_photo_size(
    tmp_path: Path, progress: Progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.MIN_LONG_SIDE", 2)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[: HEIGHT // 4] = 255
    grid = HashGridOptions(num_levels=2, log2_hashmap_size=8, max_res=16, target_samples=256)
    chosen = []
    for name, given, opaque in (("all", None, None), ("some", mask, None), ("cut out", mask, "yes")):
        inputs, scene = photographed(tmp_path / name, mask=given)
        plain = Photo("", "", WIDTH, HEIGHT, 0, None, None, True, 1.0, opaque_share=0.25)
        photos = [
            replace(plain, name=v.name, file=v.file, used_share=0.5 if opaque else 0.25, opaque_mask=opaque and v.mask)
            for v in scene.views
        ]
        write_photos(inputs["ingest"], photos, [], {})
        chosen.append(train.plan(Config(steps=2, grid=grid), inputs, progress).downscale)
    assert chosen[0] == pytest.approx(2 * chosen[1], abs=0.2) and chosen[1] == chosen[2] > 1


def test_plan_answers_everything_for_the_vanilla_field(
    tmp_path: Path, progress: Progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.01)
    inputs, _ = photographed(tmp_path)
    planned = train.plan(Config(vanilla=VanillaOptions(batch_rays=8)), inputs, progress)
    sizes = planned.vanilla
    assert (planned.field, planned.background, planned.preset) == ("vanilla", "white", "standard")
    assert (sizes.depth, sizes.width, sizes.samples_coarse, sizes.samples_fine) == (4, 64, 32, 32)
    assert (sizes.batch_rays, planned.learning_rate) == (8, 5e-3)
    assert (planned.seconds, planned.steps) == (180, None)
    assert (planned.space, sizes.spacing, planned.downscale) == ("bounded", "linear", 1.0)
    assert train.plan(Config.model_validate(planned.model_dump()), inputs, progress) == planned


def test_presets_are_budgets_unless_one_is_given(tmp_path: Path, progress: Progress) -> None:
    inputs, _ = photographed(tmp_path)
    sizes: dict[str, Any] = {"downscale": 1.0, "grid": {"num_levels": 2, "log2_hashmap_size": 8, "max_res": 16}}

    def budget(**given: Any) -> tuple[float | None, int | None]:
        planned = train.plan(Config(**given), inputs, progress)
        return planned.seconds, planned.steps

    assert [budget(preset=name, **sizes)[0] for name in (None, "draft", "standard", "high")] == [180, 30, 180, 900]
    assert budget(preset="paper", downscale=1.0) == (3600, None)
    assert budget(preset="draft", seconds=7, **sizes) == (7, None)
    assert budget(preset="high", steps=5, **sizes) == (None, 5)


def test_the_published_preset_is_the_published_model(tmp_path: Path, progress: Progress) -> None:
    inputs, _ = photographed(tmp_path, bounded=False)
    planned = train.plan(Config(preset="paper", steps=10, vanilla=VanillaOptions(width=128)), inputs, progress)
    sizes = planned.vanilla
    assert (sizes.depth, sizes.width, sizes.skip) == (8, 128, 4)
    assert (sizes.samples_coarse, sizes.samples_fine) == (64, 128)
    assert (sizes.batch_rays, planned.learning_rate) == (1024, 5e-4)
    assert (planned.space, sizes.spacing) == ("contracted", "log")


def test_every_seed_is_measured_on_the_same_pixels(tmp_path: Path, progress) -> None:
    inputs, scene = photographed(tmp_path, views=12)
    scene = with_validation_split(scene)
    found = []
    for seed in (0, 5):
        (folder := tmp_path / f"train{seed}").mkdir()
        config = train.plan(tiny(steps=1, seed=seed, target_psnr=20.0), inputs, progress)
        evaluation_sets = prepare(config, scene, inputs, folder, progress).evaluation_sets
        assert evaluation_sets.test and evaluation_sets.target
        held_out = (evaluation_sets.test, evaluation_sets.target.held_out)
        others = (pixels for each in held_out for pixels in (each.pixels, each.patches.pixels))
        found.append([pixels.colours for pixels in (evaluation_sets.train, *others)])
    assert len(found[0]) == 5 and all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_a_run_in_seconds_keeps_to_them(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _ = photographed(tmp_path)
    looks = count()  # at a clock that goes on by a hundredth of a second each time
    clock = SimpleNamespace(perf_counter=lambda: 0.01 * next(looks), monotonic=time.monotonic)
    monkeypatch.setattr("stages.train.loop.time", clock)
    result = trained(tmp_path / "train", inputs, progress, seconds=1.0)
    assert result.facts["train_seconds"] == pytest.approx(1, abs=0.2)
    decisions = json.loads((tmp_path / "train" / "schedule.json").read_text())
    assert decisions[-1][1] == result.facts["steps"] > 2


def test_a_target_is_judged_on_validation_photos(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=12, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=400, target_psnr=14.0)
    assert progress.names("train.validation-photos", "1 of 9", "14 dB")
    assert result.facts["steps"] < 400 and result.facts["validation_psnr"] >= 14
    assert "14 dB reached on validation photos after" in result.line
    assert "validation" not in (inputs["normalise"] / "scene.json").read_text()


def test_a_target_that_is_missed_is_said(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=12, channels=4)
    result = trained(tmp_path / "train", inputs, progress, field="grid", steps=20, target_psnr=60.0)
    assert result.facts["steps"] == 20 and "60 dB not reached in" in result.line


def test_too_few_photos_for_a_target(tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, views=5)
    with refused("train.few-photos-for-target", "3 training photos"):
        trained(tmp_path / "train", inputs, progress, steps=20, target_psnr=20.0)
