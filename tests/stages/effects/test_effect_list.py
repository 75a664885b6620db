"""What a new effect costs: its model and statistic (tests/nerf/effects/falloff.py) and one entry of the list."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from nerf.effects.exposure import ExposureModel
from nerf.fields.hash_grid import HashGridField
from nerf.kernels import torch as reference
from nerf.training.hash_grid_trainer import HashGridTrainer
from pipeline.cli.settings import Settings, with_effects
from stages import effects
from stages.effects.decisions import image_effects, read_decisions
from stages.effects.effect_list import EFFECTS, Effect, EffectParts
from stages.io.files import read_scene
from stages.report.effects import effects_table
from stages.train.data import guided_dataset
from tests.effect_scenes import Effects, effect_scene
from tests.nerf.effects import falloff
from tests.nerf.effects.falloff import FalloffModel
from tests.nerf.training.test_hash_grid_trainer import FIELD, TRAINER
from tests.synthetic_photos import Quiet

ENTRY = Effect("falloff", "light falls off", lambda: EffectParts(falloff.statistic, colours=FalloffModel.initial))


@pytest.fixture
def listed() -> Iterator[None]:
    EFFECTS.append(ENTRY)
    yield
    EFFECTS.remove(ENTRY)


@pytest.mark.usefixtures("listed")
def test_an_effect_is_one_file_and_one_entry(tmp_path: Path) -> None:
    inputs = effect_scene(tmp_path / "scene", Effects(exposure_ev=1.0, alpha=True), views=10)
    config = with_effects(Settings(), ["falloff=on", "exposure=on"]).effects.model_copy(update={"pilots": 0})
    (out := tmp_path / "effects").mkdir()
    result = effects.run(config, inputs, out, Quiet())
    table = json.loads((out / "effects.json").read_text("utf-8"))
    assert table["falloff"]["on"] and table["falloff"]["statistic"] == 1.0 and "falloff on (" in result.line
    rows: Any = effects_table(table)
    assert "falloff" in [row["name"] for row in rows["rows"]]

    scene = read_scene(inputs["normalise"])
    views, dataset = scene.of_split("train"), guided_dataset(inputs, scene, 4.0, Quiet())
    made = image_effects(read_decisions(out), views, dataset)
    assert [type(effect) for effect in made.colours] == [ExposureModel, FalloffModel] and not made.rays
    trainer = HashGridTrainer(HashGridField(FIELD, 0, reference), dataset, TRAINER, made)
    before = {name: part.clone() for name, part in made.parameters.items()}
    for step in range(5):
        trainer.step(step, step / 5)
    moved = {name for name, part in made.parameters.items() if not torch.equal(part, before[name])}
    assert moved == {"exposure.log_gain", "falloff.slope"} <= {name.removeprefix("image.") for name in trainer.state()}
    held_out = trainer.effects.of_held_out(torch.full((1, len(views)), 1 / len(views)))
    assert [len(rows) for rows in held_out.parameters.values()] == [1, 1]


def test_a_new_effect_is_unknown_where_it_is_not_listed() -> None:
    assert "falloff" not in [effect.name for effect in EFFECTS]
    with pytest.raises(ValueError, match="there is no effect 'falloff'; there are: background, exposure"):
        effects.Config(force={"falloff": "on"})


def test_every_listed_effect_has_its_parts() -> None:
    for effect in EFFECTS:
        parts = effect.load()
        assert not (parts.rays and parts.colours) and effect.description
