"""What ingest says of many files at once: the first few, where all of them stand, and all where that is nowhere."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import ingest
from stages.ingest import Config
from stages.io.files import read_json
from stages.io.photos import read_photos
from tests.refusals import refused


def put(folder: Path, *names: str) -> Path:
    """Photos of noise, no two alike."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        picture(len(list(folder.iterdir()))).save(folder / name)
    return folder


def picture(seed: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (24, 32, 3), np.uint8))


def test_at_most_ten_refusals_are_said(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg", "b.jpg")
    for index in range(13):
        (folder / f"x{index:02d}.jpg").write_bytes(b"")
    ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    assert progress.codes == [*["ingest.rejected"] * 10, "ingest.more-notes"]
    assert progress.names("ingest.more-notes", 3, "photos.json")


def test_all_notes_are_kept(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg", "b.jpg")
    for index in range(7):
        put(folder / "masks", f"stray{index}.png")
    for index in range(11):
        frames = [picture(10 * index + frame) for frame in range(2)]
        frames[0].save(folder / f"c{index:02d}.tif", save_all=True, append_images=frames[1:])
    result = ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    assert (result.records, result.outputs) == (("notes.json",), ("images", "photos.json"))
    notes = read_json(tmp_path / "out/notes.json")
    assert notes[:10] == progress.notes[:10] and len(notes) == 12
    strays = "masks/stray0.png, masks/stray1.png, masks/stray2.png and 4 more"
    assert progress.codes[:11] == ["ingest.stray-masks", *["ingest.assumed"] * 9, "ingest.more-notes"]
    assert progress.names("ingest.stray-masks", strays)
    assert notes[1].startswith("c00.tif: ")
    assert progress.names("ingest.more-notes", 2, "notes.json")


def test_masks_beside_photos_are_used_strays_told_once(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in/photos", "a.jpg", "b.jpg")
    (tmp_path / "in/masks").mkdir()
    for name in ("a.png", "stray.png"):
        Image.fromarray(np.eye(24, 32, dtype=np.uint8) * 255).save(tmp_path / "in/masks" / name)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.mask is not None for photo in read_photos(tmp_path / "out")] == [True, False]
    assert progress.codes.count("ingest.stray-masks") == 1 and progress.names("ingest.stray-masks", "masks/stray.png")


def test_photos_beside_an_images_folder_are_said(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in/images", "a.jpg", "b.jpg")
    put(tmp_path / "in", "c.jpg", "d.jpg")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert progress.codes == ["ingest.photos-beside-images"]
    assert progress.names("ingest.photos-beside-images", "2 photos", f"{tmp_path}/in", "images/")


@pytest.mark.parametrize("folder", ["images", "images_2"])
def test_smaller_copies_of_photos_are_named(folder: str, tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in" / folder, "a.jpg", "b.jpg")
    for photo in (tmp_path / "in" / folder).iterdir():
        (tmp_path / "in/images_8").mkdir(exist_ok=True)
        Image.open(photo).resize((16, 16)).save(tmp_path / "in/images_8" / photo.name)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["a.jpg", "b.jpg"]
    assert progress.codes == ["ingest.smaller-copies"]
    assert progress.names("ingest.smaller-copies", f"{folder}/", "images_8/")


@pytest.mark.parametrize("name", ["sky_masks/{}.png", "mattes/{}.jpg", "{}_sky.png"])
def test_masks_by_any_name_are_no_photos(name: str, tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg", "b.jpg", "c.jpg")
    for index, photo in enumerate("abc"):
        mask = np.zeros((24, 32), np.uint8)
        mask[4 + index :, 10:] = 255
        (folder / name.format(photo)).parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(folder / name.format(photo), quality=90)
    ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["a.jpg", "b.jpg", "c.jpg"]
    assert progress.codes == ["ingest.black-and-white"] and progress.names("ingest.black-and-white", name.format("a"))


def test_where_it_fails_all_refusals_are_said_by_reason(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg")
    put(folder / "masks", "stray.png")
    for index in range(12):
        (folder / f"x{index:02d}.jpg").write_text("text")
    (folder / "y.jpg").write_bytes((folder / "a.jpg").read_bytes())
    with refused("ingest.one-usable-photo"):
        ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    names = ", ".join(f"x{index:02d}.jpg" for index in range(12))
    assert progress.codes == ["ingest.rejected-photos", "ingest.rejected-photos", "ingest.stray-masks"]
    assert progress.names("ingest.rejected-photos", names)
    assert progress.names("ingest.rejected-photos", "y.jpg", "a.jpg")
    assert progress.names("ingest.stray-masks", "masks/stray.png")


def test_a_photo_too_large_for_memory_is_named(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = put(tmp_path / "in", "a.jpg", "b.jpg")
    Image.new("RGB", (500, 400)).save(folder / "raw.dng", "TIFF")
    monkeypatch.setattr("stages.hardware.memory.available_bytes", lambda: 2**20)
    ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    Image.new("RGB", (400, 300)).save(folder / "large.jpg")
    with refused("hardware.not-enough-memory", "the photos", "large.jpg"):
        ingest.run(Config(photos=folder), {}, tmp_path / "again", progress)


@pytest.mark.parametrize(("most", "dark"), [(4095, True), (16383, False)])
def test_twelve_bits_in_files_of_sixteen_are_said(tmp_path: Path, progress: Any, most: int, dark: bool) -> None:
    for index in range(2):
        grey = np.random.default_rng(index).integers(0, most, (24, 32), np.uint16, endpoint=True)
        Image.fromarray(grey).save(tmp_path / f"{index}.png")
    ingest.run(Config(photos=tmp_path), {}, tmp_path / "out", progress)
    assert progress.codes == ["ingest.nearly-black"] * dark
    assert progress.names("ingest.nearly-black", "16 of 255") == dark
