"""From whatever lies in the folder to decoded photos with ASCII names, and words for the rest."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageFilter

from stages import ingest
from stages.contract import StageError
from stages.ingest import Config
from stages.ingest.masks import STILL_BACKGROUND_HINT
from stages.io.files import read_json
from stages.io.photos import read_frame_names, read_photos
from stages.io.pixels import load_pixels
from stages.io.video import video_writer
from tests.blots import blots, cut_out
from tests.stages.ingest.photo_files import exif_with


def picture(seed: int, width: int = 32, height: int = 24) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8))


def put(folder: Path, *names: str) -> Path:
    for seed, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        picture(seed).save(folder / name, format="JPEG" if name.lower().endswith("jpg") else "PNG")
    return folder


def digests(folder: Path) -> dict[str, str]:
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def failure(photos: Path, out: Path, progress: Any) -> StageError:
    with pytest.raises(StageError) as caught:
        ingest.run(Config(photos=photos), {}, out, progress)
    return caught.value


def test_plain_photos_are_copied_byte_for_byte(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "b.JPG", "a.png", "sub/c.jpg")
    result = ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert [photo.name for photo in photos] == ["a.png", "b.JPG", "sub/c.jpg"]
    assert [photo.file for photo in photos] == ["images/a.png", "images/b.JPG", "images/sub/c.jpg"]
    for photo in photos:
        assert (tmp_path / "out" / photo.file).read_bytes() == (tmp_path / "in" / photo.name).read_bytes()
    assert result.line == "3 photos 32×24, 2 cameras, no EXIF focal length"
    assert result.outputs == ("images", "photos.json")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["images", "photos.json"]
    assert progress.updates[-2:] == [
        ("decoded 3 of 3 photos", 1.0),
        ("looking for near-duplicates", None),
    ]


def test_everything_else_is_written_upright_as_png(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.png")
    turned = picture(7)
    exif = Image.Exif()
    exif[0x0112] = 6
    turned.save(tmp_path / "in/turned.png", exif=exif)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    photo = read_photos(tmp_path / "out")[1]
    assert (photo.file, photo.width, photo.height) == ("images/turned.png", 24, 32)
    assert np.array_equal(load_pixels(tmp_path / "out" / photo.file, 24, 32), np.rot90(np.asarray(turned), -1))


def test_the_same_photos_give_the_same_bytes_wherever_they_lie(tmp_path: Path, progress: Any) -> None:
    names = ["a.jpg", "b.png", "é.jpg", "c d.jpg", *(f"n{index}.png" for index in range(12))]
    for place in ("one", "two"):
        ingest.run(Config(photos=put(tmp_path / place, *names)), {}, tmp_path / f"{place}.out", progress)
    first = digests(tmp_path / "one.out")
    assert len(first) == len(names) + 1
    assert first == digests(tmp_path / "two.out")


def test_refused_files_are_named_and_do_not_stop_the_rest(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg", "b.jpg", "whole.jpg")
    data = (folder / "whole.jpg").read_bytes()
    (folder / "whole.jpg").unlink()
    (folder / "cut.jpg").write_bytes(data[:-200])
    (folder / "notes.jpg").write_text("not a photo at all\n")
    (folder / "z copy of a.jpg").write_bytes((folder / "a.jpg").read_bytes())
    result = ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    assert result.line == "2 photos 32×24, one camera, no EXIF focal length, 3 rejected"
    refused = read_json(tmp_path / "out/photos.json")["rejected"]
    assert [rejection["name"] for rejection in refused] == ["cut.jpg", "notes.jpg", "z copy of a.jpg"]
    codes = [rejection["code"] for rejection in refused]
    assert codes == ["ingest.damaged-file", "ingest.not-an-image", "ingest.identical"]
    assert refused == result.facts["rejected"]
    assert progress.codes == ["ingest.rejected"] * 3
    for rejection in refused:
        assert progress.names("ingest.rejected", rejection["name"], rejection["reason"])


def test_too_few_photos_in_words_that_fit(tmp_path: Path, progress: Any) -> None:
    error = failure(put(tmp_path / "one", "a.jpg"), tmp_path / "out1", progress)
    assert error.code == "ingest.one-photo" and "a.jpg" in error.why

    (tmp_path / "none").mkdir()
    (tmp_path / "none/a.jpg").write_text("text")
    error = failure(tmp_path / "none", tmp_path / "out2", progress)
    assert error.code == "ingest.no-usable-photo" and f"1 file in {tmp_path}/none" in error.what
    assert error.why.startswith("a.jpg: ")

    for ending, data, helps in (("cr3", b"raw", "JPEG"), ("jpg", b"<html>", "download"), ("jpg", b"", "again")):
        for file in (tmp_path / "none").iterdir():
            file.unlink()
        (tmp_path / f"none/a.{ending}").write_bytes(data)
        assert helps in failure(tmp_path / "none", tmp_path / "out2", progress).hint

    put(tmp_path / "same", "a.png")
    (tmp_path / "same/b.png").write_bytes((tmp_path / "same/a.png").read_bytes())
    error = failure(tmp_path / "same", tmp_path / "out3", progress)
    assert error.code == "ingest.identical-photos" and "a.png" in error.why

    put(tmp_path / "rest", "a.jpg")
    (tmp_path / "rest/b.jpg").write_text("text")
    error = failure(tmp_path / "rest", tmp_path / "out4", progress)
    assert error.code == "ingest.one-usable-photo" and "a.jpg" in error.what and "1 other file " in error.why


def test_cameras_are_told_apart(tmp_path: Path, progress: Any) -> None:
    put(tmp_path, "a.png", "b.png")
    picture(8, width=40).save(tmp_path / "c.png")
    exif = Image.Exif()
    exif[271] = "Maker"
    exif.get_ifd(0x8769)[41989] = 50
    picture(9).save(tmp_path / "d.png", exif=exif)
    result = ingest.run(Config(photos=tmp_path), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert [photo.camera_group for photo in photos] == [0, 0, 1, 2]
    assert photos[3].focal_px == pytest.approx(50 / 43.27 * 40)
    assert result.line == "4 photos in 2 sizes, 3 cameras, EXIF focal length for 1"
    assert result.facts["sizes"] == [[32, 24], [40, 24]]


def exif_of(make: str, model: str, lens: str = "") -> Image.Exif:
    exif = Image.Exif()
    exif[271], exif[272] = make, model
    exif.get_ifd(0x8769)[42036] = lens
    return exif


def groups(folder: Path, out: Path, progress: Any) -> list[int]:
    ingest.run(Config(photos=folder), {}, out, progress)
    return [photo.camera_group for photo in read_photos(out)]


def test_a_phone_held_in_any_way_is_one_camera(tmp_path: Path, progress: Any) -> None:
    for orientation in range(1, 9):
        picture(orientation).save(tmp_path / f"{orientation}.jpg", exif=exif_with(orientation, Make="A", Model="1"))
    mirrored = [2, 4, 5, 7]  # no camera takes such photos
    found = groups(tmp_path, tmp_path / "out", progress)
    assert {found[orientation - 1] for orientation in (1, 3, 6, 8)} == {0}
    assert len({0, *(found[orientation - 1] for orientation in mirrored)}) == 1 + len(mirrored)


def test_heic_photos_held_both_ways_are_of_one_camera(tmp_path: Path, progress: Any) -> None:
    for orientation in (1, 6, 8):
        pixels = pillow_heif.from_pillow(picture(orientation, width=96))
        pixels.save(tmp_path / f"{orientation}.heic", exif=exif_with(orientation, Make="A", Model="1").tobytes())
    assert groups(tmp_path, tmp_path / "out", progress) == [0, 0, 0]
    photos = read_photos(tmp_path / "out")
    assert [photo.orientation for photo in photos] == [1, 6, 8]
    assert [photo.width > photo.height for photo in photos] == [True, False, False]


def test_two_phones_in_one_folder_are_two_cameras(tmp_path: Path, progress: Any) -> None:
    cameras = [("A", "1"), ("B", "1"), ("A", "1"), ("A", "2"), ("A", "1", "tele")]
    (tmp_path / "in/more").mkdir(parents=True)
    for seed, camera in enumerate(cameras):
        folder = tmp_path / "in/more" if seed == 2 else tmp_path / "in"
        picture(seed).save(folder / f"{seed}.jpg", exif=exif_of(*camera))
    # in order of name 0 1 3 4 more/2
    assert groups(tmp_path / "in", tmp_path / "out", progress) == [0, 1, 2, 3, 0]


def test_without_exif_each_folder_is_a_camera(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.png", "b.png", "left/a.png", "left/b.png", "left/deep/a.png", "right/a.png")
    assert groups(tmp_path / "in", tmp_path / "out", progress) == [0, 0, 1, 1, 2, 3]


def test_where_photos_were_taken_is_written_down(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.png")
    exif = exif_of("A", "1")
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 30.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0), 5: b"\0", 6: 341.5})
    picture(1).save(tmp_path / "in/b.jpg", exif=exif)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    places = [(photo.latitude, photo.longitude, photo.altitude_m) for photo in read_photos(tmp_path / "out")]
    assert places == [(None, None, None), (48.5, 9.0, 341.5)]


def test_a_blurred_photo_is_named_and_kept(tmp_path: Path, progress: Any) -> None:
    (tmp_path / "in").mkdir()
    for index in range(6):
        wall = blots(index, 240, 180)
        Image.fromarray(cv2.blur(wall, (9, 9)) if index == 2 else wall).save(tmp_path / f"in/{index}.png")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    relative = [photo.relative_sharpness for photo in read_photos(tmp_path / "out")]
    assert relative[2] is not None and 0 < relative[2] < 0.1
    assert all(one is not None and 0.5 < one < 2 for index, one in enumerate(relative) if index != 2)
    assert progress.codes == ["ingest.blurred"]
    assert progress.names("ingest.blurred", "1 photo", f"2.png ({relative[2]:.2f} ×)")


def shifted(folder: Path, *shifts: float, blurred: int | None = None) -> Path:
    """Photos of a wall, each moved by so many pixels."""
    folder.mkdir()
    wall = blots(0, 500, 300)
    for index, shift in enumerate(shifts):
        view = cut_out(wall, 20 + shift, 20, 320, 240)
        Image.fromarray(cv2.blur(view, (3, 3)) if index == blurred else view).save(folder / f"{index}.png")
    return folder


def test_of_nearly_the_same_pictures_the_sharpest_goes_on(tmp_path: Path, progress: Any) -> None:
    folder = shifted(tmp_path / "in", 0, 2, 40, 41.5, 120, blurred=0)
    result = ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert [photo.near_duplicate_of for photo in photos] == ["1.png", None, None, "2.png", None]
    assert all((tmp_path / "out" / photo.file).is_file() for photo in photos)
    assert result.line == "5 photos 320×240, one camera, no EXIF focal length"
    assert progress.codes == ["ingest.near-duplicates"]
    assert progress.names("ingest.near-duplicates", "2 photos", "0.png (as 1.png), 3.png (as 2.png)")


def test_photos_that_are_all_nearly_the_same_are_no_scene(tmp_path: Path, progress: Any) -> None:
    error = failure(shifted(tmp_path / "in", 0, 1, 2), tmp_path / "out", progress)
    assert error.code == "ingest.same-picture" and "all 3 photos" in error.what
    assert error.hint.endswith(STILL_BACKGROUND_HINT)


def test_with_given_cameras_all_photos_are_used(tmp_path: Path, progress: Any) -> None:
    folder = shifted(tmp_path / "in", 0, 1, 2)
    frames = [{"file_path": f"{index}.png", "transform_matrix": np.eye(4).tolist()} for index in range(3)]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    ingest.run(Config(photos=folder / "transforms.json"), {}, tmp_path / "out", progress)
    assert [photo.near_duplicate_of for photo in read_photos(tmp_path / "out")] == [None] * 3


def mask_for(folder: Path, name: str, ignored_columns: int, size: tuple[int, int] = (32, 24)) -> None:
    mask = np.full(size[::-1], 255, np.uint8)
    mask[:, :ignored_columns] = 0
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(folder / name)


def test_masks_go_with_their_photos(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.png", "left/ö b.jpg", "c.png", "d.png", "e.png")
    mask_for(folder, "masks/a.png", 8)
    mask_for(folder, "masks/left/ö b.jpg.png", 32, (64, 48))
    mask_for(folder, "masks/d.png", 0)  # ignores nothing
    mask_for(folder, "masks/stranger.png", 8)
    turned = Image.Exif()
    turned[0x0112] = 6
    picture(9, 24, 32).save(folder / "t.png", exif=turned)  # upright 32 × 24
    stored = np.full((32, 24), 255, np.uint8)
    stored[-16:] = 0  # its lower half is the left half of the upright photo
    Image.fromarray(stored).save(folder / "masks/t.png")
    result = ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert result.outputs == ("images", "photos.json", "masks")
    assert [photo.mask is not None for photo in photos] == [True, False, True, False, True, True]
    assert [photo.used_share for photo in photos] == [0.75, 1, 1, 1, 0.5, 0.5]
    for photo, columns in zip([photos[0], photos[2], photos[4], photos[5]], (8, 0, 16, 16), strict=True):
        file = f"masks/{photo.file.removeprefix('images/')}.png"
        mask = np.asarray(Image.open(tmp_path / "out" / file))
        assert photo.mask == file
        assert np.array_equal(mask, np.broadcast_to(np.where(np.arange(32) < columns, 0, 255), (24, 32)))
    assert progress.codes == ["ingest.stray-masks", "ingest.masks"]
    assert progress.names("ingest.stray-masks", "masks/stranger.png")
    assert progress.names("ingest.masks", "4 of 6 photos", "31%", "1 are turned", "1 are resized")


def test_masks_that_are_all_white_say_nothing(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.png", "b.png")
    for name in ("masks/a.png", "masks/b.png"):
        mask_for(folder, name, 0)
    assert ingest.run(Config(photos=folder), {}, tmp_path / "out", progress).outputs == ("images", "photos.json")
    assert not any(photo.mask for photo in read_photos(tmp_path / "out")) and progress.codes == []


def test_a_photo_whose_mask_cannot_be_used_is_refused(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.png", "b.png", "c.png", "d.png")
    mask_for(folder, "masks/a.png", 8, (30, 30))
    mask_for(folder, "masks/b.png", 32)
    ingest.run(Config(photos=folder), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["c.png", "d.png"]
    assert progress.codes == ["ingest.rejected", "ingest.rejected"]
    assert progress.names("ingest.rejected", "a.png", "30×30", "32×24")
    assert progress.names("ingest.rejected", "b.png", "0 of 255")


def test_a_video_becomes_photos_with_times(tmp_path: Path, progress: Any) -> None:
    wall = blots(0, 500, 200)
    with video_writer(tmp_path / "my clip.mp4", 160, 120, 10) as write:
        for step in range(24):
            write(np.ascontiguousarray(wall[20:140, 20 + 8 * step : 180 + 8 * step]))
    result = ingest.run(Config(photos=tmp_path / "my clip.mp4", frames=10), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert 5 < len(photos) <= 10
    assert (
        result.line
        == f"{len(photos)} frames 160×120, one camera, no EXIF focal length, {photos[-1].time_s:.1f} s of video"
    )
    for photo in photos:
        assert photo.time_s is not None and photo.name == f"frame_{round(10 * photo.time_s):06d}.jpg"
        assert photo.file == f"images/{photo.name}" and photo.camera_group == 0
        assert Image.open(tmp_path / "out" / photo.file).size == (160, 120)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["images", "photos.json"]
    assert result.facts["source"] == "video"


def test_sharpness_orders_blur(tmp_path: Path, progress: Any) -> None:
    sharp = picture(0, 64, 64)
    for index, radius in enumerate((0, 1, 3)):
        sharp.filter(ImageFilter.GaussianBlur(radius)).save(tmp_path / f"{index}.png")
    ingest.run(Config(photos=tmp_path), {}, tmp_path / "out", progress)
    sharpness = [photo.sharpness for photo in read_photos(tmp_path / "out")]
    assert sharpness[0] > 4 * sharpness[1] > 16 * sharpness[2] > 0


def test_odd_names_stay_inside_and_become_ascii(tmp_path: Path, progress: Any) -> None:
    odd = ["-rf.jpg", "a b.jpg", "line\nbreak.jpg", "…jpg", "Größe/ñ.jpg", "$(x);'.jpg", "[red]x.jpg", "..jpg.jpg"]
    put(tmp_path / "in", *odd[:-1], "ok.jpg")
    (tmp_path / "in" / os.fsdecode(b"\xff.jpg")).write_bytes((tmp_path / "in/ok.jpg").read_bytes()[:40])
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert {photo.name for photo in photos} == {*odd[:-1], "ok.jpg"}
    for photo in photos:
        assert (tmp_path / "out" / photo.file).resolve().is_relative_to(tmp_path / "out/images")
        assert (tmp_path / "out" / photo.file).is_file()
    assert progress.codes == ["ingest.rejected"] and progress.names("ingest.rejected", "\\xff.jpg", "Truncated File")


def test_terminal_codes_in_names_are_not_printed(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.jpg", "b.jpg")
    (tmp_path / "in/\x1b[2J.jpg").write_text("text")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert progress.codes == ["ingest.rejected"] and progress.names("ingest.rejected", r"'\x1b[2J.jpg'")


def test_only_photos_named_by_the_cameras_are_taken(tmp_path: Path, progress: Any) -> None:
    tmp_path = tmp_path / "set"  # beside it lie the folders of other tests, some of them with masks
    put(tmp_path, "images/a.png", "images/b.png", "images/unused.png")
    (tmp_path / "images/copy.png").write_bytes((tmp_path / "images/a.png").read_bytes())
    paths = ["images/a", "images/b.png", "images/copy.png", "images/gone.png"]
    frames = [{"file_path": path, "transform_matrix": np.eye(4).tolist()} for path in paths]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    result = ingest.run(Config(photos=tmp_path / "transforms.json"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == [
        "images/a.png",
        "images/b.png",
        "images/copy.png",
    ]
    assert read_frame_names(tmp_path / "out")["images/a"] == "images/a.png"
    assert result.line == "3 photos 32×24, poses imported, 1 rejected"
    assert progress.codes == ["ingest.photos-without-frame", "ingest.rejected"] and progress.names(
        "ingest.rejected", "images/gone.png"
    )


def test_what_is_opaque_is_noted(tmp_path: Path, progress: Any) -> None:
    cut_out = np.asarray(picture(1).convert("RGBA")).copy()
    cut_out[..., 3] = 0
    cut_out[6:12, 8:24, 3] = 255
    (tmp_path / "in").mkdir()
    Image.fromarray(cut_out).save(tmp_path / "in" / "a.png")
    put(tmp_path / "in", "b.jpg")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.opaque for photo in read_photos(tmp_path / "out")] == [(0.25, 0.25, 0.75, 0.5), None]


def test_an_alpha_channel_without_transparent_parts_is_none(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.jpg")
    for name, alpha in (("b.png", 255), ("c.png", 254), ("d.png", 127)):
        with_alpha = np.dstack([np.asarray(picture(1)), np.full((24, 32), 254, np.uint8)])
        with_alpha[4, 3, 3] = alpha
        Image.fromarray(with_alpha).save(tmp_path / "in" / name)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    photos = read_photos(tmp_path / "out")
    assert [photo.has_alpha for photo in photos] == [False, False, False, True]
    assert [photo.opaque_share for photo in photos] == [1, 1, 1, 1 - 1 / (32 * 24)]
    assert [photo.opaque_mask for photo in photos] == [None, None, None, "opaque/d.png.png"]


def test_a_full_disk_is_said_in_words(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    error = failure(put(tmp_path / "in", "a.jpg", "b.jpg"), tmp_path / "out", progress)
    assert error.code == "ingest.cannot-write" and str(tmp_path / "out") in error.what
    assert error.why == "No space left on device"


@pytest.mark.parametrize(
    ("scene", "line"),
    [
        ("sceaux_castle", "11 photos 1416×1064, one camera, EXIF focal length 1433 px"),
        ("room_no_overlap", "8 photos in 2 sizes, 2 cameras, no EXIF focal length"),
        ("lego_400", "125 photos 400×400 with alpha, poses imported"),
    ],
)
def test_real_sets(shared_data: Path, tmp_path: Path, progress: Any, scene: str, line: str) -> None:
    assert ingest.run(Config(photos=shared_data / scene), {}, tmp_path, progress).line == line
    assert progress.notes == []
