"""What the chain makes of photos that show next to nothing, and of files that lie about what they hold."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.contract import StageError
from stages.ingest.decoding import MAX_PIXELS, DecodeError, decode
from stages.ingest.video.frames import take_frames
from tests.conftest import RecordedProgress
from tests.end_to_end.hard_scenes import RING, Picture, over_white, run, write_set
from tests.fuzz.pictures import clip
from tests.png_files import png


def black(picture: Picture, index: int) -> Picture:
    return np.zeros_like(picture[..., :3])


def white(picture: Picture, index: int) -> Picture:
    return np.ones_like(picture[..., :3])


def another_colour_each(picture: Picture, index: int) -> Picture:
    return np.full_like(picture[..., :3], index / 20)


def transparent(picture: Picture, index: int) -> Picture:
    return picture * [1, 1, 1, 0]


@pytest.mark.parametrize(
    ("develop", "colour"),
    [(black, "#000000"), (white, "#ffffff"), (another_colour_each, "#000000"), (transparent, "transparent")],
)
def test_photos_of_one_colour_are_refused(develop: Callable, colour: str, tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", develop=develop), tmp_path / "w.nerf")
    assert (done.code, done.error_code) == (10, "ingest.plain-photos")
    assert "12 photos" in done.error[0] and "p00.png" in done.error[1] and colour in done.error[1]


def saturated(picture: Picture, index: int) -> Picture:
    """Every channel at its end: as if exposed far too long, and sharpened."""
    return (picture > 0.5).astype(float)


def lens_capped_once(picture: Picture, index: int) -> Picture:
    return picture * (index != 5)


# In black and white every error is a large one: the field shows medians there, and a grey mean scores better.
@pytest.mark.parametrize(
    ("develop", "baseline"), [(saturated, "psnr_nearest_view"), (lens_capped_once, "psnr_mean_image")]
)
def test_a_field_comes_of_it_all_the_same(develop: Callable, baseline: str, tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", develop=develop), tmp_path / "w.nerf", "--until", "evaluate")
    assert done.code == 0
    metrics = done.read("metrics.json")
    assert 0 < metrics["psnr"] < 40 and metrics["psnr"] > metrics[baseline]


def test_photos_one_pixel_wide_are_refused_by_name(tmp_path: Path) -> None:
    for index in range(3):
        Image.fromarray(np.zeros((400, 1, 3), np.uint8)).save(tmp_path / f"{index}.png")
    done = run(tmp_path, tmp_path / "w.nerf")
    assert done.code == 10
    assert done.error[1].startswith("0.png: 1×400 ") and "16 pixels" in done.error[1]


# --- headers that announce more than there is


def saved(kind: str) -> bytearray:
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save(buffer, kind)
    return bytearray(buffer.getvalue())


def with_size(kind: str, marker: bytes, skip: int, form: str, size: tuple[int, int]) -> bytes:
    content = saved(kind)
    struct.pack_into(form, content, content.index(marker) + skip, *size)
    return bytes(content)


HUGE = {
    "png.png": png(60_000, 60_000, zlib.compress(b"")),
    "largest.png": png(2**31 - 1, 2**31 - 1, b""),
    "jpeg.jpg": with_size("JPEG", b"\xff\xc0", 5, ">HH", (65_500, 65_500)),
    "bmp.bmp": with_size("BMP", b"BM", 18, "<ii", (100_000, 100_000)),
    "gif.gif": with_size("GIF", b"GIF87a", 6, "<HH", (65_535, 65_535)),
    "ppm.ppm": b"P6\n99999 99999\n255\n",
}


@pytest.mark.parametrize("name", HUGE)
def test_a_gigapixel_header_is_refused_before_anything_is_decoded(name: str, tmp_path: Path) -> None:
    import resource

    (tmp_path / name).write_bytes(HUGE[name])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DecodeError) as refusal:
        decode(tmp_path / name)
    assert refusal.value.code in ("ingest.too-large", "ingest.damaged-file")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def test_a_decompression_bomb_is_refused_by_its_pixels(tmp_path: Path) -> None:
    """A few megabytes that would be 0.9 GB; the limit is on pixels, so what passes it fits into memory."""
    rows = zlib.compressobj(1)
    side = 17_000
    data = b"".join(rows.compress(bytes(1 + 3 * side)) for _ in range(side)) + rows.flush()
    (tmp_path / "bomb.png").write_bytes(png(side, side, data))
    assert (tmp_path / "bomb.png").stat().st_size < 1e7 and side**2 > MAX_PIXELS
    with pytest.raises(DecodeError, match="17000×17000") as refusal:
        decode(tmp_path / "bomb.png")
    assert refusal.value.code == "ingest.too-large"


@pytest.mark.parametrize("text", ["tEXt", "zTXt", "iCCP"])
def test_a_picture_with_a_bomb_beside_its_pixels_is_harmless(text: str, tmp_path: Path) -> None:
    """Text or a colour profile that unpacks to 200 MB."""
    bomb = zlib.compress(bytes(200 << 20), 9)
    content = b"name\0" + (b"\0" if text != "tEXt" else b"") + bomb
    chunk = struct.pack(">I", len(content)) + text.encode() + content
    chunk += struct.pack(">I", zlib.crc32(text.encode() + content))
    plain = bytes(saved("PNG"))
    (tmp_path / "a.png").write_bytes(plain[:33] + chunk + plain[33:])
    try:
        assert decode(tmp_path / "a.png").pixels.shape == (32, 32, 3)
    except DecodeError as refusal:
        assert refusal.code == "ingest.damaged-file"


@pytest.mark.parametrize("size", [(65_534, 65_534), (1, 1), (0, 0)])
def test_a_video_with_a_false_size_is_refused_or_read(size: tuple[int, int], tmp_path: Path) -> None:
    content = bytearray(clip())
    for marker, skip in ((b"avc1", 28), (b"tkhd", 80)):
        form = ">HH" if marker == b"avc1" else ">II"
        values = size if marker == b"avc1" else (size[0] << 16 & 2**32 - 1, size[1] << 16 & 2**32 - 1)
        struct.pack_into(form, content, content.index(marker) + skip, *values)
    (tmp_path / "a.mp4").write_bytes(content)
    (tmp_path / "out").mkdir()
    try:
        frames = take_frames(tmp_path / "a.mp4", 5, tmp_path / "out", RecordedProgress())
    except StageError as refusal:
        assert refusal.what.startswith(("cannot decode the video a.mp4", "cannot take photos from a.mp4"))
    else:
        assert all((frame.width, frame.height) == (96, 96) for frame in frames)


def test_a_good_photo_among_bad_files_is_not_lost(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", RING[:4], develop=over_white).parent
    (folder / "transforms.json").unlink()
    for name, content in HUGE.items():
        (folder / name).write_bytes(content)
    done = run(folder, tmp_path / "w.nerf", "--until", "ingest")
    assert done.code == 0
    assert len(done.read("photos.json")["photos"]) == 4
    assert {rejection["name"] for rejection in done.read("photos.json")["rejected"]} == set(HUGE)
