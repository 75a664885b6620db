"""Going on from a finished training: what is said of the sizes that it keeps."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nerf.geometry.scene import Camera, Scene
from stages import train
from stages.io.files import read_json, write_json
from stages.train import Config
from stages.train.continuation import training_name
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.planning import larger_photos_words
from tests.stages.photo_scene import photographed

DIGEST = "d" * 64
NAME = training_name("k" * 64, DIGEST)


FIELD: dict[str, Any] = {"field": "vanilla", "vanilla": VanillaOptions(batch_rays=3000)}


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    """Those of a workspace whose finished training took 60 s for 1,000 steps of 3,000 rays of photos at 1/2."""
    made, _ = photographed(tmp_path / "made")
    inputs = {}
    for stage, folder in made.items():
        inputs[stage] = tmp_path / "w" / stage / "key"
        inputs[stage].parent.mkdir(parents=True)
        folder.rename(inputs[stage])
        write_json(inputs[stage] / "manifest.json", {"outputs_digest": DIGEST})
    scene = Scene.from_json(read_json(inputs["normalise"] / "scene.json"))
    write_json(inputs["normalise"] / "scene.json", photographed_large(scene).to_json())
    before = tmp_path / "w" / "train" / NAME.split("/")[0]
    before.mkdir(parents=True)
    config = Config(steps=1000, downscale=2.0, space="bounded", view_dependence=False, **FIELD).model_dump()
    manifest: dict[str, Any] = {"outputs_digest": DIGEST, "facts": {"train_seconds": 60.0}, "config": config}
    write_json(before / "manifest.json", manifest | {"inputs": dict.fromkeys(made, DIGEST)})
    write_json(before / "field.json", {"steps": 1000})
    return inputs


def photographed_large(scene: Scene) -> Scene:
    """Six training photos of 2 megapixels: at half their width they have 3 million pixels."""
    return replace(scene, cameras=(Camera("PINHOLE", 2000, 1000, (1700.0, 1700.0, 1000.0, 500.0)),))


def words(inputs: dict[str, Path], **more: Any) -> str | None:
    scene = Scene.from_json(read_json(inputs["normalise"] / "scene.json"))
    config = Config(after=NAME, downscale=2.0, **more).model_copy(update=FIELD)
    return larger_photos_words(config, inputs, scene, {})


def test_photos_larger_by_a_fifth_are_named(inputs: dict[str, Path]) -> None:
    by_time, by_steps = words(inputs, more_seconds=180.0) or "", words(inputs, more_steps=1000) or ""
    assert all(value in by_time for value in ("at 1/2 of", "4 min", "1/1:", "--train.seconds 240"))
    assert all(value in by_steps for value in ("at 1/2 of", "2,000 steps", "1/1.4:", "--train.steps 2000"))


def test_a_little_more_is_worth_no_word(inputs: dict[str, Path]) -> None:
    assert words(inputs, more_seconds=20.0) is None and words(inputs, more_steps=300) is None


def test_photo_sizes_are_told_once_unless_asked_for(inputs: dict[str, Path], progress: Any) -> None:
    open_size = Config(after=NAME, more_seconds=180.0)
    whole = train.plan(open_size, inputs, progress)
    assert (whole.downscale, whole.more_seconds) == (2.0, 180.0)
    assert progress.codes == ["train.larger-photos"]
    for settled in (whole, open_size.model_copy(update={"downscale": 2.0})):
        assert train.plan(settled, inputs, progress) == whole
    assert len(progress.notes) == 1
