"""Photos that were ingested and are gone, and photos that cannot be used any more: what was finished stays. And masks
that change places."""

import json
from pathlib import Path

import pytest
from PIL import Image

from pipeline.engine.display import SilentDisplay
from pipeline.engine.runner import Runner
from pipeline.engine.workspace import Workspace
from tests.pipeline.engine import fake_stages
from tests.pipeline.engine.fake_stages import FakeSettings
from tests.refusals import refused


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Photos that the chain of fake stages was run on."""
    monkeypatch.setattr("pipeline.engine.runner.STAGES", fake_stages.STAGES)
    folder = tmp_path / "photos/images"
    folder.mkdir(parents=True)
    Image.new("RGB", (4, 4)).save(folder / "0.png")
    assert run(folder.parent) and links(tmp_path)
    return folder


def run(photos: Path) -> bool:
    settings = FakeSettings.model_validate({"ingest": {"photos": photos}})
    with Workspace(photos.parent / "w.nerf") as workspace:
        return Runner(workspace, settings, SilentDisplay()).run(("ingest", "sfm", "train"))  # type: ignore[arg-type]


def links(folder: Path) -> list[str]:
    return sorted(link.name for link in (folder / "w.nerf/output").iterdir())


def test_an_emptied_folder_is_like_none(photos: Path, tmp_path: Path):
    before = links(tmp_path)
    (photos / "0.png").rename(photos / ".DS_Store")
    assert run(photos.parent) is False
    photos.rename(tmp_path / "elsewhere")
    assert run(photos.parent) is False
    assert links(tmp_path) == before


def test_uningested_photos_are_missed_in_an_empty_folder(photos: Path, tmp_path: Path):
    (tmp_path / "other/photos").mkdir(parents=True)
    with refused("ingest.empty-folder"):
        run(tmp_path / "other/photos")


def test_finished_output_stays_where_photos_are_unusable(photos: Path, tmp_path: Path):
    before = links(tmp_path)
    (photos / "0.png").rename(photos / "notes.txt")
    with refused("ingest.no-photos"):
        run(photos.parent)
    assert links(tmp_path) == before


def test_masks_that_change_places_are_ingested_anew(photos: Path):
    def ran_with(*masks: str) -> bool:
        frames = [{"file_path": "0.png", "transform_matrix": []}, {"file_path": "1.png", "transform_matrix": []}]
        named = [{**frame, "mask_path": mask} for frame, mask in zip(frames, masks, strict=True)]
        (photos / "transforms.json").write_text(json.dumps({"frames": named}))
        return run(photos / "transforms.json")

    assert [ran_with("a.png", "b.png"), ran_with("a.png", "b.png"), ran_with("b.png", "a.png")] == [True, False, True]
