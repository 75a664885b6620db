"""The files of transforms files where these spell their names in another way than the disk does."""

import json
import os
import shutil
import unicodedata
from pathlib import Path

import pytest

from stages.sources import find_source
from tests.stages.test_sources import names, refusal, touch, transforms


def apart(name: str) -> str:
    """With accents as letters of their own, as macOS writes them."""
    return unicodedata.normalize("NFD", name)


@pytest.mark.parametrize(
    ("written", "there"),
    [
        ("./train/r_0", "train/r_0.PNG"),
        ("./train/r_0", "train/r_0.JPG"),
        ("train/r_0.5", "train/r_0.5.webp"),
        ("train\\r_0", "train/r_0.tif"),
        ("images/a.jpg", "images/a.JPG"),
        ("images/a.JPG", "images/a.jpg"),
        ("images/Küche_01.jpg", apart("images/Küche_01.jpg")),
        (apart("images/Küche_01.jpg"), "images/Küche_01.jpg"),
        ("Küche/01.jpg", apart("Küche/01.JPG")),
        ("Küche/ä", apart("Küche/ä.png")),
    ],
)
def test_a_photo_is_found_in_another_spelling(tmp_path: Path, written: str, there: str) -> None:
    touch(tmp_path, there, "images/other.jpg", "train/r_0_depth.PNG")
    source = find_source(transforms(tmp_path / "transforms.json", written))
    assert source.files == (tmp_path / there,)
    assert source.frames == {written: there}


@pytest.mark.parametrize(
    ("written", "there"),
    [
        ("r_0", ["r_0.webp", "r_0.TIF"]),
        ("a.jpg", ["a.JPG", "a.Jpg"]),
        ("a.jpg", ["A.jpg", "a.jpeg"]),
        ("shot.A", ["shot.a.png"]),
        ("ä/b.jpg", ["a/b.jpg"]),
        ("a", ["a.txt"]),
    ],
)
def test_nothing_is_guessed(tmp_path: Path, written: str, there: list[str]) -> None:
    source = find_source(transforms(touch(tmp_path, *there) / "transforms.json", written))
    assert names(source) == [written]


def test_a_file_of_the_very_name_goes_first(tmp_path: Path) -> None:
    touch(tmp_path, "a.JPG", "a.jpg", "b.JPG", "b.png")
    assert names(find_source(transforms(tmp_path / "transforms.json", "a.jpg", "b"))) == ["a.jpg", "b.png"]


def test_another_spelling_leads_out_of_the_folder_no_more_than_the_name(tmp_path: Path) -> None:
    touch(tmp_path, "secret.jpg", "set/b.jpg")
    (tmp_path / "set/a.JPG").symlink_to(tmp_path / "secret.jpg")
    error = refusal(transforms(tmp_path / "set/transforms.json", "a.jpg"))
    assert error.what == "refused the photo 'a.JPG'"


def test_a_set_of_links_is_refused_with_the_way_on(tmp_path: Path) -> None:
    """As `output/` of a workspace is one: its images/ is a link."""
    touch(tmp_path, "kept/a.jpg")
    (tmp_path / "output").mkdir()
    (tmp_path / "output/images").symlink_to("../kept")
    error = refusal(transforms(tmp_path / "output/transforms.json", "images/a.jpg"))
    assert error.why == f"it leads out of the folder {tmp_path / 'output'}" and "(cp -rL)" in error.hint
    shutil.copytree(tmp_path / "output", tmp_path / "copy")
    assert names(find_source(tmp_path / "copy/transforms.json")) == ["images/a.jpg"]


def test_masks_of_transforms_files_are_found_in_another_spelling(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "masks/a.PNG")
    frame = {"file_path": "a.jpg", "mask_path": "masks/a.png", "transform_matrix": []}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    assert find_source(tmp_path / "transforms.json").masks[0] == ("a.jpg.png", tmp_path / "masks/a.PNG")


def test_each_folder_is_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = [f"train/{index}" for index in range(9)]
    touch(tmp_path, *(f"{name}.PNG" for name in written))
    listed, real = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda folder: listed.append(folder) or real(folder))
    assert len(names(find_source(transforms(tmp_path / "transforms.json", *written, "gone")))) == 10
    assert listed.count(tmp_path / "train") == 1 and listed.count(tmp_path) == 1
