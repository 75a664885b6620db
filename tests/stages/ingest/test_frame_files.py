"""The files of transforms files where these spell their names in another way than the disk does."""

import json
import os
import unicodedata
from pathlib import Path

import pytest

from stages.contract import StageError
from stages.ingest.sources import find_source, unused_masks
from stages.ingest.sources.frame_files import FrameFiles
from tests.refusals import refused
from tests.stages.ingest.test_sources import names, refusal, touch, transforms


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
        (" images/a.jpg\n", "images/a.jpg"),
        ("file:///me/images/a.jpg\n", "images/a.jpg"),
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
    touch(tmp_path, "another.jpg", *there)
    assert written in names(find_source(transforms(tmp_path / "transforms.json", written, "another.jpg")))


def test_a_file_of_the_very_name_goes_first(tmp_path: Path) -> None:
    touch(tmp_path, "a.JPG", "a.jpg", "b.JPG", "b.png")
    assert names(find_source(transforms(tmp_path / "transforms.json", "a.jpg", "b"))) == ["a.jpg", "b.png"]


def test_another_spelling_leads_out_of_no_folder(tmp_path: Path) -> None:
    touch(tmp_path, "secret.jpg", "set/b.jpg")
    (tmp_path / "set/a.JPG").symlink_to(tmp_path / "secret.jpg")
    with refused("ingest.outside-folder", "'a.JPG'"):
        find_source(transforms(tmp_path / "set/transforms.json", "a.jpg", "b.jpg"))


def test_a_linked_photo_folder_may_lack_its_cameras(tmp_path: Path) -> None:
    touch(tmp_path, "disk/images/a.jpg", "secret.jpg", "set/notes")
    (tmp_path / "set/images").symlink_to(tmp_path / "disk/images")
    cameras = transforms(tmp_path / "set/transforms.json", "images/a.jpg")
    with refused("ingest.outside-folder", "pipeline run PHOTOS --cameras FILE"):
        find_source(cameras)
    for photos in ("set/images", "set"):
        assert names(find_source(tmp_path / photos, cameras)) == ["a.jpg"]


def test_links_to_photos_are_followed_in_given_folders(tmp_path: Path) -> None:
    """As they are without cameras; a transforms file alone opens nothing outside of its folder."""
    touch(tmp_path, "store/a.jpg", "store/deep/b.jpg", "set/images/c.jpg")
    (tmp_path / "set/images/a.jpg").symlink_to(tmp_path / "store/a.jpg")
    (tmp_path / "set/images/deep").symlink_to(tmp_path / "store/deep")
    cameras = transforms(tmp_path / "set/transforms.json", "images/a.jpg", "images/c.jpg")
    with refused("ingest.outside-folder", "'images/a.jpg'"):
        find_source(cameras)
    for photos in ("set/images", "set"):
        assert names(find_source(tmp_path / photos, cameras)) == ["a.jpg", "c.jpg"]
    elsewhere = transforms(tmp_path / "t.json", "/home/me/a.jpg", "/home/me/c.jpg")
    assert names(find_source(tmp_path / "set/images", elsewhere)) == ["a.jpg", "c.jpg"]
    with refused("ingest.outside-folder", "'images/deep/b.jpg'"):
        find_source(tmp_path / "set", transforms(cameras, "images/deep/b.jpg"))


@pytest.mark.parametrize(
    "prefix",
    [
        "/content/drive/MyDrive/set/images/",
        "C:\\Users\\me\\set\\Images\\",
        "\\\\server\\share\\",
        "../../images/",
        "old/",
    ],
)
def test_paths_of_another_machine_are_matched_by_their_ends(tmp_path: Path, prefix: str) -> None:
    touch(tmp_path, "photos/left/0.jpg", "photos/right/0.jpg", "photos/right/ONE.JPG")
    written = [prefix + name for name in ("left/0.jpg", "right/0.jpg", "right/one")]
    source = find_source(tmp_path / "photos", transforms(tmp_path / "cameras/transforms.json", *written))
    assert list(source.frames.values()) == ["left/0.jpg", "right/0.jpg", "right/ONE.JPG"]


def test_an_absolute_path_may_lie_in_the_folder(tmp_path: Path) -> None:
    touch(tmp_path, "images/0.jpg", "other/0.jpg")
    source = find_source(transforms(tmp_path / "transforms.json", str(tmp_path / "other/0.jpg"), "images/0.jpg"))
    assert names(source) == ["images/0.jpg", "other/0.jpg"]


def test_a_missing_photo_is_not_replaced_by_its_namesake(tmp_path: Path) -> None:
    touch(tmp_path, "left/0.jpg", "left/1.jpg", "old/1.jpg")
    assert "right/1.jpg" in names(find_source(transforms(tmp_path / "transforms.json", "left/0.jpg", "right/1.jpg")))


@pytest.mark.parametrize("written", ["elsewhere/0.jpg", "/home/me/0.jpg", "C:\\set\\0.jpg", "../0.png"])
def test_ends_that_two_photos_share_are_named(tmp_path: Path, written: str) -> None:
    touch(tmp_path, "a/0.jpg", "b/0.jpg", "c/1.jpg")
    others = [] if written[0] == "e" else ["/home/me/1.jpg"]
    with refused("ingest.ambiguous-path", repr(written), "a/0.jpg, b/0.jpg", tmp_path):
        find_source(transforms(tmp_path / "transforms.json", written, *others))


@pytest.mark.parametrize(
    "written",
    [
        "images/photo%201%20%C3%A9.jpg",
        "file:///home/me/photo%201%20é.jpg",
        "file://C:/me/photo%201%20é.jpg",
        "https://host/set/photo%201%20é.jpg?raw=1#x",
    ],
)
def test_paths_may_be_urls(tmp_path: Path, written: str) -> None:
    touch(tmp_path, "images/photo 1 é.jpg", "images/100%25.jpg")
    source = find_source(transforms(tmp_path / "transforms.json", written, "images/100%25.jpg"))
    assert list(source.frames.values()) == ["images/photo 1 é.jpg", "images/100%25.jpg"]


def test_a_url_leads_out_of_no_folder(tmp_path: Path) -> None:
    touch(tmp_path, "secret.jpg", "set/b.jpg")
    assert refusal(transforms(tmp_path / "set/transforms.json", "b.jpg", "%2e%2e/secret.jpg")).code == (
        "ingest.outside-folder"
    )


def test_photos_of_another_ending_are_taken_where_none_is_there(tmp_path: Path) -> None:
    touch(tmp_path, "images/0.jpg", "images/1.jpg", "images/2.tif")
    written = ["images/0.png", "images/1.png", "images/2.png"]
    source = find_source(transforms(tmp_path / "transforms.json", *written))
    assert list(source.frames.values()) == ["images/0.jpg", "images/1.jpg", "images/2.tif"]
    assert dict(source.other_endings) == source.frames
    touch(tmp_path, "images/0.png")
    source = find_source(transforms(tmp_path / "transforms.json", *written))
    assert source.frames["images/1.png"] == "images/1.png", "of a set that is there nothing is guessed"
    assert source.other_endings == {}


def test_an_end_leads_to_nothing_outside(tmp_path: Path) -> None:
    touch(tmp_path, "secret.jpg", "set/b.jpg")
    (tmp_path / "set/c.jpg").symlink_to(tmp_path / "secret.jpg")
    for name in ("/home/me/secret.jpg", "/home/me/c.jpg"):
        with refused("ingest.outside-folder", repr(name)):
            find_source(transforms(tmp_path / "set/transforms.json", "b.jpg", name))


def test_masks_of_transforms_files_are_found_in_another_spelling(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "masks/a.PNG")
    frame = {"file_path": "a.jpg", "mask_path": "masks/a.png", "transform_matrix": []}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    assert find_source(tmp_path / "transforms.json").masks[0] == ("a.jpg.png", tmp_path / "masks/a.PNG")


@pytest.mark.parametrize("given", ["set/transforms.json", "set", "set/images"])
@pytest.mark.parametrize("folder", ["/home/me/masks/", "C:\\me\\masks\\", "file:///me/masks/"])
def test_masks_of_another_machine_are_no_photos(tmp_path: Path, folder: str, given: str) -> None:
    """A photo has the name of its mask but for the ending, or the whole of it."""
    touch(tmp_path, "set/images/a.jpg", "set/images/b.png", "set/images/c.png", "set/masks/a.png", "set/masks/b.png")
    frames = [
        {"file_path": f"images/{photo}", "mask_path": f"{folder}{photo[0]}.png", "transform_matrix": []}
        for photo in ("a.jpg", "b.png")
    ]
    cameras = tmp_path / "set/transforms.json"
    cameras.write_text(json.dumps({"frames": frames}))
    source = find_source(tmp_path / given, None if given.endswith("json") else cameras)
    assert [file.relative_to(tmp_path / "set").as_posix() for _, file in source.masks[:2]] == [
        "masks/a.png",
        "masks/b.png",
    ]
    (tmp_path / "set/masks/b.png").unlink()
    assert source.other_endings == {}
    try:
        lost = find_source(tmp_path / given, None if given.endswith("json") else cameras).masks[1][1]
        assert not lost.is_file(), "which is said of its photo"
    except StageError as error:
        assert error.code == "ingest.outside-folder"


def test_masks_named_by_our_export_are_copies(tmp_path: Path) -> None:
    touch(tmp_path, "set/a.jpg", "w.nerf/output/masks/a.jpg.png")
    frame = {"file_path": "images/a.jpg", "photo": "a.jpg", "mask_path": "masks/a.jpg.png", "transform_matrix": []}
    cameras = tmp_path / "w.nerf/output/transforms.json"
    cameras.write_text(json.dumps({"frames": [frame]}))
    without = find_source(tmp_path / "set", cameras)
    assert without.masks == () and unused_masks(without) == cameras.parent / "masks"
    touch(tmp_path, "set/masks/a.png")
    found = find_source(tmp_path / "set", cameras)
    assert found.masks == (("a.png", tmp_path / "set/masks/a.png"),) and unused_masks(found) is None


def test_a_reduced_folder_stands_in_for_the_named_one(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images/left/b.JPG", "images_4/a.jpg", "images_4/left/b.jpg", "other_4/a.jpg")
    cameras = transforms(tmp_path / "transforms.json", "images/a.jpg", "./images/left/b.JPG")
    assert names(find_source(tmp_path / "images_4", cameras)) == ["a.jpg", "left/b.jpg"]
    assert refusal(tmp_path / "other_4", cameras).code == "ingest.photo-outside", "another folder is no reduction"
    assert names(find_source(tmp_path / "images", cameras)) == ["a.jpg", "left/b.JPG"]


def test_each_folder_is_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = [f"train/{index}" for index in range(9)]
    touch(tmp_path, *(f"{name}.PNG" for name in written))
    listed, real = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda folder: listed.append(folder) or real(folder))
    assert len(names(find_source(transforms(tmp_path / "transforms.json", *written, "gone")))) == 10
    assert listed.count(tmp_path / "train") == 1 and listed.count(tmp_path) == 1


def test_each_photo_is_looked_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = [f"train/{index}" for index in range(3)]
    touch(tmp_path, *(f"{name}.png" for name in written))
    sought, real = [], FrameFiles._photo
    monkeypatch.setattr(FrameFiles, "_photo", lambda self, *names: sought.append(names) or real(self, *names))
    assert len(names(find_source(transforms(tmp_path / "transforms.json", *written)))) == 3
    assert sought == [(name,) for name in written]
