"""What a new effect costs: its model and statistic (tests/nerf/effects/veil.py) and one entry of the list."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from nerf.effects.appearance import AppearanceModel
from nerf.effects.exposure import ExposureModel
from pipeline.cli.options import Settings, with_effects
from pipeline.engine.display import SilentDisplay
from stages import effects, evaluate, render, train
from stages.contract import run_stage
from stages.effects.effect_list import EFFECTS, Effect, EffectParts
from stages.effects.image_effects import photo_effects
from stages.io.field_files import load_field
from stages.io.files import read_json, read_scene
from stages.render.renderer import load_renderer
from stages.render.video import with_appearance
from stages.report.effects import effects_table
from stages.train.fields.hash_grid_options import HashGridOptions
from tests.effect_scenes import Effects, effect_scene
from tests.nerf.effects import veil
from tests.nerf.effects.veil import VeilModel

ENTRY = Effect("veil", "stray light lies over photos", lambda: EffectParts(veil.statistic, colours=VeilModel))


@pytest.fixture
def listed() -> Iterator[None]:
    EFFECTS.append(ENTRY)
    yield
    EFFECTS.remove(ENTRY)


@pytest.fixture
def trained(listed: None, tmp_path: Path) -> dict[str, Path]:
    """The folders of a scene after its effects were decided and a few steps of training."""
    inputs = effect_scene(tmp_path / "scene", Effects(exposure_ev=1.0, alpha=True), views=10)
    inputs |= {name: tmp_path / name for name in ("effects", "train", "evaluate", "render")}
    for name in ("effects", "train", "evaluate", "render"):
        inputs[name].mkdir()
    decide = with_effects(Settings(), ["veil=on", "exposure=on"]).effects.model_copy(update={"pilots": 0})
    run_stage(effects.STAGE, decide, inputs, inputs["effects"], SilentDisplay())
    grid = HashGridOptions(num_levels=2, log2_hashmap_size=8, max_res=16, target_samples=512)
    run_stage(train.STAGE, train.Config(downscale=8.0, steps=5, grid=grid), inputs, inputs["train"], SilentDisplay())
    return inputs


def test_an_effect_is_one_file_and_one_entry(trained: dict[str, Path]) -> None:
    table = json.loads((trained["effects"] / "effects.json").read_text("utf-8"))
    assert table["veil"]["on"] and table["veil"]["statistic"] == 1.0
    rows: Any = effects_table(table)
    assert "veil" in [row["name"] for row in rows["rows"]]

    scene, field = read_scene(trained["normalise"]), read_json(trained["train"] / "field.json")
    photos = {view.name for view in scene.of_split("train")}
    assert list(field["effects"]) == ["exposure", "veil"]
    assert all(set(learnt) == photos for learnt in field["effects"].values())
    levels = [row[0] for row in field["effects"]["veil"].values()]
    assert min(levels) == 0 < max(levels), "it was learnt, and its gauge is fixed"

    shown, _ = load_field(trained["train"])
    assert isinstance(shown, AppearanceModel)
    assert [type(effect) for effect in shown.effects] == [ExposureModel, VeilModel]
    assert shown.effects[1].rows.tolist() == [[0.0]], "a new view is as clear as the clearest photo"


def test_photos_are_rendered_and_scored_through_a_new_effect(trained: dict[str, Path]) -> None:
    scene, file = read_scene(trained["normalise"]), trained["train"] / "field.json"
    field, test = read_json(file), scene.of_split("test")[0]
    field["effects"]["veil"] = {name: [0.25] for name in field["effects"]["veil"]}
    field["effects"]["veil"][scene.of_split("train")[0].name] = [0.0]
    file.write_text(json.dumps(field))

    _, level = photo_effects(field, scene, test)
    assert 0 < float(level.rows) <= 0.25, "a test photo is veiled as its neighbours are"
    chosen = evaluate.Config(downscale=8.0)
    run_stage(evaluate.STAGE, chosen, trained, trained["evaluate"], SilentDisplay())
    metrics = read_json(trained["evaluate"] / "metrics.json")
    assert metrics["appearance"] == [ExposureModel.held_out_words, VeilModel.held_out_words]
    without = {**field, "effects": {"exposure": field["effects"]["exposure"]}}
    file.write_text(json.dumps(without))
    (trained["evaluate"].parent / "plain").mkdir()
    run_stage(evaluate.STAGE, chosen, trained, trained["evaluate"].parent / "plain", SilentDisplay())
    assert read_json(trained["evaluate"].parent / "plain" / "metrics.json")["psnr"] != metrics["psnr"]

    file.write_text(json.dumps(field))
    like = scene.of_split("train")[3].name
    rendered = run_stage(
        render.STAGE,
        render.Config(frames=2, width=32, match_exposure=like),
        trained,
        trained["render"],
        SilentDisplay(),
    )
    assert rendered.facts["appearance"] == f"exposed like {like}"
    as_photo, _ = with_appearance(load_renderer(trained["train"]), like, trained["train"], scene, SilentDisplay())
    assert isinstance(as_photo.model, AppearanceModel)
    assert torch.equal(as_photo.model.effects[1].rows, torch.tensor([[0.25]]))


def test_a_new_effect_is_unknown_where_it_is_not_listed() -> None:
    assert "veil" not in [effect.name for effect in EFFECTS]
    with pytest.raises(ValueError, match="there is no effect 'veil'; there are: background, exposure"):
        effects.Config(force={"veil": "on"})


def test_every_listed_effect_has_its_parts() -> None:
    for effect in EFFECTS:
        parts = effect.load()
        assert not (parts.rays and parts.colours) and effect.description
