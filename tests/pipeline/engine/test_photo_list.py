"""A list of photos in the key of stage ingest: by what it names, wherever it lies."""

import json
from pathlib import Path

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.display import SilentDisplay
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.workspace import Workspace
from stages.ingest import Config
from tests.refusals import refused


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for side in (20, 24, 28):
        Image.effect_noise((side, 20), 90).convert("RGB").save(folder / f"{side}.png")
    return folder


def listing(file: Path, *lines: str) -> Path:
    file.write_text("\n".join(lines))
    return file


def key(photos: Path, photo_list: Path | None) -> str:
    settings = Settings(ingest=Config(photos=photos, photo_list=photo_list))
    return Runner(Workspace(photos.parent / "w.nerf"), settings, SilentDisplay()).resolve("ingest").key


def test_the_key_changes_with_what_is_listed(photos: Path, tmp_path: Path):
    first = listing(tmp_path / "list.txt", "20.png", "24.png")
    before = key(photos, first)
    assert key(photos, None) != before
    assert key(photos, first.rename(tmp_path / "moved.txt")) == before
    assert key(photos, listing(tmp_path / "list.txt", "20.png", "28.png")) != before


def test_photos_that_are_not_listed_change_no_key(photos: Path, tmp_path: Path):
    before = key(photos, listing(tmp_path / "list.txt", "20.png", "24.png"))
    (photos / "28.png").unlink()
    assert key(photos, tmp_path / "list.txt") == before
    (photos / "24.png").write_bytes((photos / "20.png").read_bytes())
    assert key(photos, tmp_path / "list.txt") != before


def test_the_workspace_remembers_its_list(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    listing(tmp_path / "list.txt", "20.png", "24.png")
    run = ["run", "photos", "--until", "ingest"]
    assert run_command([*run, "--ingest.photo-list", "list.txt"]) == 0
    monkeypatch.chdir(photos)
    workspace = tmp_path / "photos.nerf"
    kept = [photo["name"] for photo in json.loads((workspace / "output/photos.json").read_text())["photos"]]
    assert kept == ["20.png", "24.png"]
    (finished,) = [folder for folder in (workspace / "ingest").iterdir() if folder.is_dir()]
    assert run_command(["resume", str(workspace)]) == 0
    assert [folder for folder in (workspace / "ingest").iterdir() if folder.is_dir()] == [finished]


def test_a_list_that_moved_keeps_results_under_its_new_path(photos: Path, tmp_path: Path):
    run = ["run", str(photos), "-o", str(tmp_path / "w.nerf"), "--until", "ingest", "--ingest.photo-list"]
    assert run_command([*run, str(listing(tmp_path / "list.txt", "20.png", "24.png"))]) == 0
    (finished,) = (tmp_path / "w.nerf/ingest").iterdir()
    moved = (tmp_path / "list.txt").rename(tmp_path / "moved.txt")
    assert run_command(["resume", str(tmp_path / "w.nerf")]) == 10
    assert run_command([*run, str(moved)]) == 0
    assert [*(tmp_path / "w.nerf/ingest").iterdir()] == [finished]


def test_a_wrong_list_leaves_results_in_place(photos: Path, tmp_path: Path):
    workspace = tmp_path / "w.nerf"
    run = ["run", str(photos), "-o", str(workspace), "--until", "ingest"]
    assert run_command(run) == 0
    before = (workspace / "run.json").read_bytes()
    assert run_command([*run, "--ingest.photo-list", str(listing(tmp_path / "list.txt", "30.png"))]) == 10
    assert (workspace / "run.json").read_bytes() == before
    assert run_command(["ingest", str(workspace), "--ingest.photo-list", str(tmp_path / "gone.txt")]) == 10
    assert (workspace / "output/photos.json").is_file()


def test_photos_that_are_gone_stand_for_no_other_list(photos: Path, tmp_path: Path):
    first, second = listing(tmp_path / "1.txt", "20.png", "24.png"), listing(tmp_path / "2.txt", "20.png", "28.png")
    run = ["run", str(photos), "-o", str(tmp_path / "w.nerf"), "--until", "ingest", "--ingest.photo-list"]
    assert run_command([*run, str(first)]) == 0
    photos.rename(tmp_path / "elsewhere")
    settings = Settings(ingest=Config(photos=photos, photo_list=second))
    with Workspace(tmp_path / "w.nerf") as workspace, refused("ingest.no-such-photos"):
        Runner(workspace, settings, SilentDisplay()).run(["ingest"])
