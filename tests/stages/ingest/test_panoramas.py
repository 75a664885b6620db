"""Panoramas are told from photos, by what their files say and by their ends."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import ingest
from stages.contract import StageError
from stages.ingest import Config
from stages.ingest.panoramas import panorama_kind
from stages.ingest.sources import find_source
from stages.ingest.video.frames import take_frames
from stages.io.files import read_json
from stages.io.photos import read_photos
from stages.io.video import video_writer
from tests.blots import blots
from tests.refusals import refused
from tests.stages.ingest.photo_files import exif_with

ATTRIBUTE = '<rdf:Description GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4000"/>'
ELEMENT = "<GPano:ProjectionType> equirectangular </GPano:ProjectionType>"


def all_around(seed: int, width: int = 320) -> np.ndarray:
    """A picture whose last column is followed by its first."""
    return np.roll(blots(seed, width, width // 2), width // 3, axis=1)


def test_a_whole_turn_is_told_by_its_ends() -> None:
    for seed in range(5):
        assert panorama_kind(all_around(seed))
        assert not panorama_kind(all_around(seed)[1:])  # not 2 : 1
        assert not panorama_kind(blots(seed, 320, 160))


def test_ends_that_agree_as_everything_does_tell_nothing() -> None:
    boards = np.tile(np.random.default_rng(0).integers(0, 256, (160, 1, 3), np.uint8), (1, 320, 1))
    before_white = np.full((160, 320, 3), 255, np.uint8)
    before_white[:, 60:260] = blots(1, 320, 160)[:, 60:260]
    sky = np.repeat(np.linspace(250, 20, 160).astype(np.uint8)[:, None, None], 3, axis=2).repeat(320, axis=1)
    for picture in (boards, before_white, sky, np.dstack([before_white, before_white[..., 0]])):
        assert not panorama_kind(picture)


@pytest.mark.parametrize("xmp", [ATTRIBUTE, ELEMENT, ATTRIBUTE.encode(), "GPano:ProjectionType='cylindrical'"])
def test_what_the_file_says_is_believed_of_a_wide_picture(xmp: str | bytes) -> None:
    picture = blots(0, 320, 160)
    assert panorama_kind(picture[:100], xmp)
    assert not panorama_kind(picture[:, :240], xmp)  # a view that was cut out of it and kept its metadata
    assert not panorama_kind(picture, "<rdf:Description/>")


@pytest.mark.parametrize(("width", "height"), [(380, 200), (200, 380), (640, 160)])
def test_a_sweep_is_told_by_exif(width: int, height: int) -> None:
    picture = blots(0, width, height)
    assert panorama_kind(picture, None, 6) == "swept"
    assert panorama_kind(picture, None, 7) is panorama_kind(picture) is None  # a portrait
    assert panorama_kind(picture[:190, :190], None, 6) is None


def radii(width: int, *middles: float, height: int = 160) -> np.ndarray:
    """Of each pixel how far the nearest of circles' middles is, which are at half the height, in halves of that."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.min([np.hypot(x - middle, y - height / 2) for middle in middles], axis=0) / (height / 2)


def two_circles(seed: int, radius: float = 1.0) -> np.ndarray:
    picture = blots(seed, 320, 160)
    picture[radii(320, 80, 240) > radius] = 8
    return picture


@pytest.mark.parametrize("radius", [0.94, 1.0, 1.1])
def test_two_fisheye_circles_are_told_by_their_shape(radius: float) -> None:
    picture = two_circles(1, radius)
    assert panorama_kind(picture) == panorama_kind(np.dstack([picture, picture[..., :1]])) == "dual fisheye"
    assert panorama_kind(picture[1:]) is panorama_kind(np.roll(picture, 80, axis=1)) is None
    picture[80:] = 0  # night
    assert panorama_kind(picture) is None


def test_dark_and_vignetted_photos_have_no_two_circles() -> None:
    photo, stars = blots(2, 320, 160), np.zeros((160, 320, 3), np.uint8)
    stars[::9, ::9] = 255
    one, cut = (np.where((radii(320, 160) < radius)[..., None], photo, 0) for radius in (1.0, 1.9))
    vignetted = photo * np.exp(-1.5 * radii(320, 160) ** 2)[..., None]
    framed = photo.copy()
    framed[:24], framed[-24:] = 0, 0
    left = np.where((radii(320, 80) < 1)[..., None], photo, 0)
    for picture in (photo, photo // 16, stars, one, cut, vignetted, framed, left):
        assert panorama_kind(np.ascontiguousarray(picture, np.uint8)) is None


def test_photos_cut_to_the_shape_of_a_panorama_are_none(shared_data: Path) -> None:
    for scene in ("fox", "fountain_p11", "banana"):
        with Image.open(min((shared_data / scene / "images").iterdir())) as image:
            pixels = np.asarray(image.convert("RGB"))
        half = pixels.shape[1] // 2
        cut = pixels[-half:, : 2 * half]
        assert not panorama_kind(cut)
        assert panorama_kind(np.roll(cut, 300, axis=1))


def test_panoramas_are_refused_by_name(tmp_path: Path, progress: Any) -> None:
    (tmp_path / "in").mkdir()
    for seed in range(2):
        Image.fromarray(blots(seed, 320, 160)).save(tmp_path / f"in/{seed}.jpg")
    Image.fromarray(all_around(2)).save(tmp_path / "in/round.jpg", quality=90)
    Image.fromarray(blots(3, 320, 120)).save(tmp_path / "in/tagged.jpg", xmp=ATTRIBUTE.encode())
    Image.fromarray(two_circles(4)).save(tmp_path / "in/two.insp", "JPEG")
    exif = exif_with(CustomRendered=6, Make="Apple")
    Image.fromarray(blots(5, 120, 320)).save(tmp_path / "in/up.jpg", exif=exif)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == ["0.jpg", "1.jpg"]
    rejected = {one["name"]: one["code"] for one in read_json(tmp_path / "out/photos.json")["rejected"]}
    assert rejected == {
        "round.jpg": "ingest.panorama",
        "tagged.jpg": "ingest.panorama",
        "two.insp": "ingest.dual-fisheye",
        "up.jpg": "ingest.swept-panorama",
    }
    begin = ", for example with ffmpeg -i PHOTO -vf v360="
    for name, projection in (("round.jpg", "e:flat:h_fov"), ("two.insp", "dfisheye:flat:ih_fov=190:iv_fov=190:h_fov")):
        assert progress.names("ingest.rejected", name, begin + projection)


@pytest.mark.parametrize("ending", ["mp4", "insv"])
def test_a_video_of_two_fisheye_circles_is_refused(ending: str, tmp_path: Path, progress: Any) -> None:
    with video_writer(tmp_path / "a.mp4", 320, 160, 10) as write:
        for seed in range(3):
            write(two_circles(seed))
    video = (tmp_path / "a.mp4").rename(tmp_path / f"a.{ending}")
    assert find_source(tmp_path).kind == find_source(video).kind == "video"
    with refused("ingest.dual-fisheye-video", video.name, f"-i {video.name} -vf v360=dfisheye:flat:ih_fov=190:"):
        take_frames(video, 300, tmp_path, progress)


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
