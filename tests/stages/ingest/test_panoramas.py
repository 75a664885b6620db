"""Panoramas are told from photos, by what their files say and by their ends."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import ingest
from stages.contract import StageError
from stages.ingest import Config
from stages.ingest.panoramas import is_panorama
from stages.ingest.video.frames import take_frames
from stages.io.photos import read_photos
from stages.io.video import video_writer
from tests.blots import blots

ATTRIBUTE = '<rdf:Description GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4000"/>'
ELEMENT = "<GPano:ProjectionType> equirectangular </GPano:ProjectionType>"


def all_around(seed: int, width: int = 320) -> np.ndarray:
    """A picture whose last column is followed by its first."""
    return np.roll(blots(seed, width, width // 2), width // 3, axis=1)


def test_a_whole_turn_is_told_by_its_ends() -> None:
    for seed in range(5):
        assert is_panorama(all_around(seed))
        assert not is_panorama(all_around(seed)[1:])  # not 2 : 1
        assert not is_panorama(blots(seed, 320, 160))


def test_ends_that_agree_as_everything_does_tell_nothing() -> None:
    boards = np.tile(np.random.default_rng(0).integers(0, 256, (160, 1, 3), np.uint8), (1, 320, 1))
    before_white = np.full((160, 320, 3), 255, np.uint8)
    before_white[:, 60:260] = blots(1, 320, 160)[:, 60:260]
    sky = np.repeat(np.linspace(250, 20, 160).astype(np.uint8)[:, None, None], 3, axis=2).repeat(320, axis=1)
    for picture in (boards, before_white, sky, np.dstack([before_white, before_white[..., 0]])):
        assert not is_panorama(picture)


@pytest.mark.parametrize("xmp", [ATTRIBUTE, ELEMENT, ATTRIBUTE.encode(), "GPano:ProjectionType='cylindrical'"])
def test_what_the_file_says_is_believed_of_a_wide_picture(xmp: str | bytes) -> None:
    picture = blots(0, 320, 160)
    assert is_panorama(picture[:100], xmp)
    assert not is_panorama(picture[:, :240], xmp)  # a view that was cut out of it and kept its metadata
    assert not is_panorama(picture, "<rdf:Description/>")


def test_photos_cut_to_the_shape_of_a_panorama_are_none(shared_data: Path) -> None:
    for scene in ("fox", "fountain_p11", "banana"):
        with Image.open(min((shared_data / scene / "images").iterdir())) as image:
            pixels = np.asarray(image.convert("RGB"))
        half = pixels.shape[1] // 2
        cut = pixels[-half:, : 2 * half]
        assert not is_panorama(cut)
        assert is_panorama(np.roll(cut, 300, axis=1))


def test_panoramas_are_refused_by_name(tmp_path: Path, progress: Any) -> None:
    (tmp_path / "in").mkdir()
    for seed in range(2):
        Image.fromarray(blots(seed, 320, 160)).save(tmp_path / f"in/{seed}.jpg")
    Image.fromarray(all_around(2)).save(tmp_path / "in/round.jpg", quality=90)
    Image.fromarray(blots(3, 320, 120)).save(tmp_path / "in/swept.jpg", xmp=ATTRIBUTE.encode())
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["0.jpg", "1.jpg"]
    begin = "a panorama: cut it into perspective views, for example with ffmpeg -i PHOTO -vf v360=e:flat:"
    for name, note in zip(("round", "swept"), progress.notes, strict=True):
        assert note.startswith(f"rejected {name}.jpg: {begin}")


def test_a_video_of_panoramas_is_refused(tmp_path: Path, progress: Any) -> None:
    with video_writer(tmp_path / "a.mp4", 320, 160, 10) as write:
        for step in range(6):
            write(np.ascontiguousarray(np.roll(all_around(0), 8 * step, axis=1)))
    with pytest.raises(StageError) as error:
        take_frames(tmp_path / "a.mp4", 300, tmp_path, progress)
    assert (error.value.what, error.value.why) == ("cannot take photos from a.mp4", "its frames are panoramas")
    assert error.value.hint.startswith(
        "Cut it into perspective views, for example with ffmpeg -i a.mp4 -vf v360=e:flat:"
    )
