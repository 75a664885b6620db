"""Which scenes a folder holds."""

import os
import sys
from pathlib import Path

import pytest

from pipeline.batch.scenes import find_scenes
from tests.refusals import refused


def touch(*files: Path) -> None:
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()


def test_each_folder_and_each_video_is_a_scene(tmp_path: Path):
    touch(tmp_path / "b" / "x.jpg", tmp_path / "a" / "images" / "x.jpg", tmp_path / "c.mp4", tmp_path / "notes.txt")
    assert [scene.name for scene in find_scenes(tmp_path)] == ["a", "b", "c"]


def test_a_video_named_like_a_folder_keeps_its_ending(tmp_path: Path):
    touch(tmp_path / "c" / "x.jpg", tmp_path / "c.mp4", tmp_path / "c.mov")
    assert sorted(scene.name for scene in find_scenes(tmp_path)) == ["c", "c.mov", "c.mp4"]


def test_previews_beside_videos_are_no_scenes(tmp_path: Path):
    touch(*(tmp_path / name for name in ("GX01.MP4", "GX01.LRV", "DJI_1.MOV", "DJI_1.LRF")))
    assert [scene.photos.name for scene in find_scenes(tmp_path)] == ["DJI_1.MOV", "GX01.MP4"]


def test_no_two_scenes_share_a_name(tmp_path: Path):
    touch(tmp_path / "a.mp4" / "x.jpg", tmp_path / "a" / "x.jpg", tmp_path / "a.mp4.mov", tmp_path / "b.mov")
    names = [scene.name for scene in find_scenes(tmp_path)]
    assert len(set(names)) == len(names) == 4


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have names of text alone")
def test_a_name_that_is_no_text_is_written_as_one(tmp_path: Path):
    os.mkdir(os.fsencode(tmp_path) + b"/caf\xe9")
    (scene,) = find_scenes(tmp_path)
    assert scene.name == "caf\\udce9" and scene.photos.is_dir()


def test_workspaces_batches_and_hidden_folders_are_none(tmp_path: Path):
    touch(
        tmp_path / "a" / "x.jpg",
        tmp_path / "a.nerf" / "run.json",
        tmp_path / "out" / "batch.json",
        tmp_path / ".b" / "x",
    )
    assert [scene.name for scene in find_scenes(tmp_path)] == ["a"]


@pytest.mark.parametrize("file", ["x.JPG", "images/x.jpg", "transforms.json", "transforms_train.json"])
def test_one_scene_is_not_taken_for_a_folder_of_scenes(tmp_path: Path, file: str):
    touch(tmp_path / file, tmp_path / "sparse" / "0" / "cameras.bin")
    with refused("pipeline.one-scene", tmp_path):
        find_scenes(tmp_path)


def test_a_folder_without_scenes_is_refused(tmp_path: Path):
    with refused("pipeline.no-scenes", tmp_path):
        find_scenes(tmp_path)
    with refused("pipeline.scenes-unreadable", tmp_path / "gone"):
        find_scenes(tmp_path / "gone")
