"""Only the photos that a list names: what a line may look like, what belongs to them, and lists that are refused."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import ingest
from stages.ingest import Config
from stages.ingest.listing import read_photo_list, write_photo_list
from stages.ingest.sources import find_source, photos_without_frame
from stages.io.photos import read_photos
from tests.refusals import refused
from tests.stages.ingest.test_ingest import put
from tests.stages.ingest.test_sources import names, touch, transforms


def listing(folder: Path, content: str | bytes) -> Path:
    file = folder / "list.txt"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def chosen(photos: Path, content: str | bytes, cameras: Path | None = None) -> list[str]:
    return names(find_source(photos, cameras, listing(photos, content)))


def test_only_listed_photos_are_decoded(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.png", "b.png", "c.png", "sub/d.png", "sub/e.png")
    photo_list = listing(tmp_path, "sub/d.png\na.png\nsub/d.png\n")
    result = ingest.run(Config(photos=tmp_path / "in", photo_list=photo_list), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["a.png", "sub/d.png"]
    assert "2 of 5 photos listed in list.txt" in result.line
    assert result.facts["rejected"] == [] and progress.notes == []


def test_a_list_of_all_photos_gives_the_same_bytes(tmp_path: Path, progress: Any) -> None:
    put(tmp_path / "in", "a.png", "b.png")
    results = [
        ingest.run(Config(photos=tmp_path / "in", photo_list=photo_list), {}, tmp_path / name, progress)
        for name, photo_list in {"all": None, "listed": listing(tmp_path, "b.png\na.png")}.items()
    ]
    assert results[0].outputs == results[1].outputs
    assert len({(tmp_path / name / "photos.json").read_bytes() for name in ("all", "listed")}) == 1


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("b.jpg\na.jpg", ["a.jpg", "b.jpg"]),
        ("\ufeffa.jpg\r\nb.jpg\r\n", ["a.jpg", "b.jpg"]),
        ("# chosen by hand\n\n  a.jpg \n \t\n  # b.jpg\n", ["a.jpg"]),
        ("sub\\ c.jpg\n./a.jpg\n", ["a.jpg", "sub/ c.jpg"]),
        ("sub/ c.jpg\nsub/é d.jpg\n", ["sub/ c.jpg", "sub/é d.jpg"]),
        (" e.jpg\nf.jpg \n", [" e.jpg", "f.jpg "]),
        ("./#1.jpg\n", ["#1.jpg"]),
        ("sub/e\u0301 d.jpg\n", ["sub/é d.jpg"]),
    ],
    ids=[
        "any order",
        "of Windows",
        "comments",
        "other spellings",
        "spaces inside",
        "spaces around",
        "number sign",
        "accents",
    ],
)
def test_lines_are_names(content: str, found: list[str], tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "b.jpg", "sub/ c.jpg", "sub/é d.jpg", " e.jpg", "f.jpg ", "#1.jpg")
    assert chosen(tmp_path, content) == found


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    odd = [" e.jpg", "#1.jpg", "a.jpg", "a\\b.jpg", "c\u2028d.jpg", "f.jpg ", "sub/é.jpg"]
    touch(tmp_path, *odd, "left.jpg")
    write_photo_list(tmp_path / "lists/2.txt", odd)
    source = find_source(tmp_path, None, tmp_path / "lists/2.txt")
    assert names(source) == sorted(odd) and source.unlisted == 1
    assert len(read_photo_list(tmp_path / "lists/2.txt")) == len(odd)


def test_names_are_relative_to_images(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images/b.jpg")
    assert chosen(tmp_path, "b.jpg") == ["b.jpg"]
    with refused("ingest.photo-list-names", "images/b.jpg (perhaps b.jpg)"):
        chosen(tmp_path, "images/b.jpg")


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (["a.jpg", "IMG_0003.jpg"], ["1 of its 2", "IMG_0003.jpg (perhaps IMG_0002.jpg)"]),
        (["img_0002.JPG"], ["img_0002.JPG (perhaps IMG_0002.jpg)"]),
        (["/elsewhere/IMG_0002.jpg"], ["/elsewhere/IMG_0002.jpg (perhaps IMG_0002.jpg)"]),
        ([f"{letter * 9}" for letter in "pqrstuv"], ["7 of its 7", "ttttttttt and 2 more"]),
        (["q\x1b[2J"], ["'q\\x1b[2J'"]),
        (["a_mask.png"], ["a_mask.png (perhaps a.jpg)"]),
    ],
    ids=["similar", "capitals", "other folder", "many", "control characters", "mask"],
)
def test_names_of_no_photo_are_told(lines: Sequence[str], told: Sequence[str], tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "a_mask.png", "IMG_0002.jpg")
    with refused("ingest.photo-list-names", "list.txt", tmp_path, *told):
        chosen(tmp_path, "\n".join(lines))


@pytest.mark.parametrize(
    ("content", "code", "told"),
    [
        (b"", "empty", ""),
        (b"\xef\xbb\xbf\r\n# nothing\r\n", "empty", ""),
        ("a.jpg\n".encode("utf-16"), "encoding", "0xff"),
        ("é.jpg\n".encode("latin-1"), "encoding", "0xe9"),
    ],
)
def test_lists_that_name_nothing_are_refused(content: bytes, code: str, told: str, tmp_path: Path) -> None:
    with refused(f"ingest.photo-list-{code}", "list.txt", told):
        chosen(touch(tmp_path, "a.jpg"), content)


def test_lists_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "photos/a.jpg")
    for path in (tmp_path / "gone.txt", tmp_path / "photos"):
        with refused("ingest.photo-list-unreadable", path):
            find_source(tmp_path / "photos", None, path)


def test_frames_of_a_video_cannot_be_listed(tmp_path: Path) -> None:
    for photos in (touch(tmp_path, "clip.mp4"), tmp_path / "clip.mp4"):
        with refused("ingest.photo-list-of-video", "clip.mp4"):
            chosen(tmp_path, "frame_000001.jpg") if photos == tmp_path else find_source(photos, None, photos)


def test_masks_and_copies_follow_their_photos(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{name}.jpg" for name in "abcd"), *(f"masks/{name}.png" for name in "abcx"))
    touch(tmp_path, "a_depth.png", "b_depth.png", "dynamic_mask_d.png")
    source = find_source(tmp_path, None, listing(tmp_path, "a.jpg\nc.jpg"))
    assert sorted(mask.name for _, mask in source.masks) == ["a.png", "c.png", "x.png"], "x is no photo's"
    assert source.excluded == {"a_depth.png": "a.jpg"}


def test_of_a_transforms_file_only_listed_frames_count(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "images/c.jpg", "images/extra.jpg")
    cameras = transforms(tmp_path / "transforms.json", *(f"images/{name}.jpg" for name in "abc"))
    source = find_source(cameras, None, listing(tmp_path, "images/c.jpg\nimages/a.jpg"))
    assert (names(source), source.unlisted) == (["images/a.jpg", "images/c.jpg"], 1)
    assert photos_without_frame(source) == ["images/extra.jpg"], "the file names the one that is left out"


def test_rows_of_llff_stay_those_of_all_photos(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "b.jpg", "c.jpg")
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))
    source = find_source(tmp_path, tmp_path / "poses_bounds.npy", listing(tmp_path, "c.jpg"))
    assert names(source) == ["c.jpg"] and source.frames["2"] == "c.jpg"
