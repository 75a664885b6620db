"""Every kind of file a camera, a phone or an accident may leave in a photo folder."""

import io
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms

from stages.ingest.decoding import (
    MAX_PIXELS,
    DecodeError,
    decode,
)
from tests.png_files import png_16_bit_rgb
from tests.stages.ingest.photo_files import HEIGHT, WIDTH, exif_with, saved, smooth


def refusal(path: Path) -> DecodeError:
    with pytest.raises(DecodeError) as caught:
        decode(path)
    return caught.value


def test_plain_files_keep_their_pixels_and_may_be_copied(tmp_path: Path) -> None:
    pixels = smooth()
    png = decode(saved(tmp_path / "a.png", Image.fromarray(pixels)))
    assert np.array_equal(png.pixels, pixels)
    assert (png.suffix, png.notes, png.camera_key.focal_px) == (".png", (), None)
    jpeg = decode(saved(tmp_path / "a.jpg", Image.fromarray(pixels), quality=95))
    assert jpeg.suffix == ".jpg"
    assert 0 < np.abs(jpeg.pixels.astype(int) - pixels).mean() < 3


def test_grey_of_any_depth_becomes_rgb(tmp_path: Path) -> None:
    grey = smooth()[..., 0]
    expected = np.repeat(grey[..., None], 3, axis=2)
    images = {
        "l.png": Image.fromarray(grey),
        "l.jpg": Image.fromarray(grey),
        "i16.png": Image.fromarray(grey.astype(np.uint16) * 257),
        "i16.tif": Image.fromarray(grey.astype(np.uint16) * 257),
        "f.tif": Image.fromarray(grey.astype(np.float32) / 255),
        "opaque_la.png": Image.fromarray(np.stack([grey, np.full_like(grey, 255)], axis=-1)),
    }
    for name, image in images.items():
        decoded = decode(saved(tmp_path / name, image))
        assert np.abs(decoded.pixels.astype(int) - expected).max() <= (3 if name == "l.jpg" else 0), name
        assert decoded.suffix is None, name
        assert decoded.stored == ("deep grey" if name in ("i16.png", "i16.tif", "f.tif") else "grey")


def test_float_pixels_outside_their_range_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "hdr.tif", Image.fromarray(np.full((20, 20), 812.0, np.float32)))
    assert refusal(path).code == "ingest.pixel-range" and refusal(path).reason.count("812.0") == 2


def test_sixteen_bit_colour_becomes_eight_and_is_not_copied(tmp_path: Path) -> None:
    path = tmp_path / "deep.png"
    path.write_bytes(png_16_bit_rgb(smooth().astype(np.uint16) * 257))
    decoded = decode(path)
    assert np.array_equal(decoded.pixels, smooth())
    assert (decoded.suffix, decoded.stored) == (None, "colour")


def test_sixteen_bit_colour_tiffs_and_alpha(tmp_path: Path) -> None:
    """Written by OpenCV: Pillow cannot write them."""
    deep = smooth().astype(np.uint16) * 257
    cv2.imwrite(str(tmp_path / "a.tif"), np.ascontiguousarray(deep[..., ::-1]))
    assert np.array_equal(decode(tmp_path / "a.tif").pixels, smooth())
    with_alpha = np.dstack([deep[..., ::-1], deep[..., 0]])
    cv2.imwrite(str(tmp_path / "b.png"), with_alpha)
    decoded = decode(tmp_path / "b.png")
    assert np.array_equal(decoded.pixels, np.dstack([smooth(), smooth()[..., 0]]))
    assert decoded.suffix is None


def test_grey_with_alpha_keeps_it(tmp_path: Path) -> None:
    grey = smooth()[..., 0]
    decoded = decode(saved(tmp_path / "la.png", Image.fromarray(np.dstack([grey, 255 - grey]))))
    assert np.array_equal(decoded.pixels, np.dstack([grey, grey, grey, 255 - grey]))


def test_alpha_is_kept_where_it_says_something(tmp_path: Path) -> None:
    rgba = np.concatenate([smooth(), smooth()[..., :1]], axis=2)
    decoded = decode(saved(tmp_path / "a.png", Image.fromarray(rgba)))
    assert np.array_equal(decoded.pixels, rgba) and decoded.suffix == ".png"
    rgba[..., 3] = 255
    decoded = decode(saved(tmp_path / "b.png", Image.fromarray(rgba)))
    assert np.array_equal(decoded.pixels, rgba[..., :3]) and decoded.suffix is None


def test_palette_with_transparency(tmp_path: Path) -> None:
    indices = (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 3).astype(np.uint8)
    image = Image.fromarray(indices, mode="P")
    image.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    opaque = decode(saved(tmp_path / "p.png", image))
    assert np.array_equal(opaque.pixels, np.eye(3, dtype=np.uint8)[indices] * 255)
    clear = decode(saved(tmp_path / "t.png", image, transparency=1))
    assert np.array_equal(clear.pixels[..., 3], np.where(indices == 1, 0, 255))
    assert clear.suffix is None


def test_cmyk(tmp_path: Path) -> None:
    cmyk = Image.fromarray(smooth()).convert("CMYK")
    for name, options in (("a.jpg", {"quality": 95}), ("a.tif", {})):
        decoded = decode(saved(tmp_path / name, cmyk, **options))
        assert decoded.suffix is None
        assert np.abs(decoded.pixels.astype(int) - smooth()).mean() < 4


def icc(profile: object) -> bytes:
    return ImageCms.ImageCmsProfile(profile).tobytes()


def test_a_profile_that_is_srgb_changes_nothing(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", Image.fromarray(smooth()), icc_profile=icc(ImageCms.createProfile("sRGB")))
    decoded = decode(path)
    assert np.array_equal(decoded.pixels, smooth()) and decoded.suffix == ".png"


def swapped_primaries() -> bytes:
    """sRGB with the primaries of red and green exchanged, so that the conversion has to exchange channels."""
    profile = bytearray(icc(ImageCms.createProfile("sRGB")))
    count = struct.unpack_from(">I", profile, 128)[0]
    entries = {bytes(profile[132 + 12 * i : 136 + 12 * i]): 132 + 12 * i for i in range(count)}
    red, green = entries[b"rXYZ"], entries[b"gXYZ"]
    profile[red : red + 4], profile[green : green + 4] = b"gXYZ", b"rXYZ"
    return bytes(profile)


def test_another_profile_is_converted_to_srgb_and_alpha_is_kept(tmp_path: Path) -> None:
    rgba = np.concatenate([smooth(), smooth()[..., :1]], axis=2)
    path = saved(tmp_path / "a.png", Image.fromarray(rgba), icc_profile=swapped_primaries())
    decoded = decode(path)
    assert decoded.suffix is None
    assert np.abs(decoded.pixels.astype(int) - rgba[..., [1, 0, 2, 3]]).max() <= 1


def test_a_broken_profile_is_said_and_ignored(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", Image.fromarray(smooth()), icc_profile=b"no profile at all")
    decoded = decode(path)
    assert np.array_equal(decoded.pixels, smooth())
    assert decoded.suffix is None
    assert "colour profile" in decoded.notes[0]


def test_heic(tmp_path: Path) -> None:
    path = tmp_path / "a.heic"
    big = smooth(96, 64)
    try:
        pillow_heif.from_pillow(Image.fromarray(big)).save(path, quality=95, exif=exif_with(6).tobytes())
    except RuntimeError as error:
        pytest.skip(f"this pillow-heif cannot write HEIC: {error}")
    decoded = decode(path)
    upright = np.rot90(big, -1)
    assert decoded.suffix is None
    assert decoded.pixels.shape == upright.shape
    assert 0 < np.abs(decoded.pixels.astype(int) - upright).mean() < 4


def test_only_the_first_frame_counts(tmp_path: Path) -> None:
    first, second = Image.fromarray(smooth()), Image.fromarray(255 - smooth())
    path = saved(tmp_path / "a.png", first, save_all=True, append_images=[second])
    decoded = decode(path)
    assert np.array_equal(decoded.pixels, smooth())
    assert (decoded.suffix, decoded.notes) == (None, ("first of 2 frames",))


def test_a_jpeg_of_a_header_alone_is_refused(tmp_path: Path) -> None:
    """Without a place for pixels, there is no share of the picture that could be missing."""
    content = saved(tmp_path / "a.jpg", Image.fromarray(smooth())).read_bytes()
    frame = content.index(b"\xff\xc0")
    end = frame + 2 + int.from_bytes(content[frame + 2 : frame + 4], "big")
    (tmp_path / "a.jpg").write_bytes(content[:end])
    refused = refusal(tmp_path / "a.jpg")
    assert refused.code == "ingest.damaged-file" and "%" not in refused.reason


def test_a_truncated_jpeg_says_how_much_is_missing(tmp_path: Path) -> None:
    data = io.BytesIO()
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (400, 300, 3), dtype=np.uint8)).save(data, "JPEG", quality=90)
    path = tmp_path / "cut.jpg"
    path.write_bytes(data.getvalue()[: int(0.6 * data.tell())])
    refused = refusal(path)
    assert refused.code == "ingest.damaged-file"
    (missing,) = re.findall(r"(\d+)%", refused.reason)
    assert 36 < int(missing) < 46


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")  # pytest resets the filter that decode sets
@pytest.mark.parametrize("keep", [0, 1, 3, 20, 60, 200, 600, 1200])
@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "gif", "bmp", "heic", "avif", "jp2"])
def test_any_truncation_is_refused_with_a_reason(tmp_path: Path, suffix: str, keep: int) -> None:
    rng = np.random.default_rng(1)
    whole = tmp_path / f"whole.{suffix}"
    image = Image.fromarray(rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    decode(saved(tmp_path / "warm.png", image))  # registers HEIC
    saved(whole, image)
    data = whole.read_bytes()
    assert decode(whole).pixels.shape == (64, 64, 3)
    assert len(data) > keep
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(data[:keep])
    assert refusal(path).reason


def test_what_is_no_image_is_named(tmp_path: Path) -> None:
    cases = {
        "notes.jpg": (b"Dear diary,\nno photo today.\n", "not-an-image"),
        "empty.jpg": (b"", "empty-file"),
        "noise.jpg": (bytes(range(256)), "not-an-image"),
        "lfs.jpg": (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "stand-in"),
        "page.jpg": (b"<!DOCTYPE html>\n<html>404</html>", "stand-in"),
        "half.jpg": (b"\xff\xd8\xff\xe0", "damaged-file"),
        "page.png": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 50 50\n", "not-an-image"),
    }
    for name, (data, expected) in cases.items():
        (tmp_path / name).write_bytes(data)
        assert refusal(tmp_path / name).code == f"ingest.{expected}"
    assert refusal(tmp_path / "nowhere.jpg").code == "ingest.missing-file"
    (tmp_path / "link.jpg").symlink_to("nowhere.jpg")
    assert "link" in refusal(tmp_path / "link.jpg").reason
    assert refusal(tmp_path / "a.NEF").code == "ingest.raw-file"


def test_size_limits_hold_before_pixels_are_decoded(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.png"
    data = bytearray(png_16_bit_rgb(smooth().astype(np.uint16)))
    data[16:24] = struct.pack(">II", 50_000, 50_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    bomb.write_bytes(data)
    assert MAX_PIXELS == 250_000_000
    assert refusal(bomb).code == "ingest.too-large"
    assert all(value in refusal(bomb).reason for value in ("50000×50000", "2500", "250"))
    dot = refusal(saved(tmp_path / "dot.png", Image.new("RGB", (100, 3))))
    assert dot.code == "ingest.too-small" and "100×3" in dot.reason and "16" in dot.reason
