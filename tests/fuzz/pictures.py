"""Photos, masks and videos: valid ones, damaged ones, and how each is read."""

import io
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from PIL import Image

from pipeline.engine.display import SilentDisplay
from stages.ingest.decoding import decode
from stages.ingest.masks import read_mask
from stages.ingest.near_duplicates import thumbnail
from stages.ingest.sharpness import one_colour, sharpness
from stages.ingest.video.frames import take_frames
from stages.io.video import video_writer
from tests.fuzz.inputs import H, W, damaged


@cache
def pictures() -> dict[str, bytes]:
    """One valid picture of every format and of most modes."""
    x, y = np.meshgrid(np.linspace(0, 1, W), np.linspace(0, 1, H))
    rgb = np.rint(255 * np.stack([x, y, x * y], -1)).astype(np.uint8)
    image = Image.fromarray(rgb)
    alpha = Image.fromarray(np.dstack([rgb, rgb[..., :1]]))
    exif = Image.Exif()
    exif.update({271: "maker", 272: "model", 274: 6})
    exif.get_ifd(34665).update({37386: 4.2, 41989: 28, 40962: W, 40963: H})
    exif.get_ifd(34853).update({1: "N", 2: (47.0, 22.0, 1.5), 3: "E", 4: (8.0, 32.0, 3.0)})
    variants: dict[str, tuple[Image.Image, str, dict[str, Any]]] = {
        "jpeg": (image, "JPEG", {"exif": exif}),
        "grey": (image.convert("L"), "JPEG", {"progressive": True}),
        "cmyk": (image.convert("CMYK"), "JPEG", {}),
        "png": (alpha, "PNG", {"exif": exif}),
        "palette": (image.convert("P"), "PNG", {"transparency": 3}),
        "deep": (Image.fromarray(rgb[..., 0].astype(np.uint16) * 257), "PNG", {}),
        "tiff": (image, "TIFF", {"compression": "tiff_lzw"}),
        "float": (Image.fromarray(rgb[..., 0].astype(np.float32) / 255), "TIFF", {}),
        "webp": (alpha, "WEBP", {"exif": exif}),
        "bmp": (image, "BMP", {}),
        "gif": (image.convert("P"), "GIF", {"save_all": True, "append_images": [image.convert("P")]}),
        "ppm": (image, "PPM", {}),
        "jpeg2000": (image, "JPEG2000", {}),
    }
    written = {}
    for name, (picture, kind, options) in variants.items():
        buffer = io.BytesIO()
        picture.save(buffer, kind, **options)
        written[name] = buffer.getvalue()
    return written


MAGIC = (
    b"\xff\xd8\xff\xe0",
    b"\x89PNG\r\n\x1a\n",
    b"II*\0",
    b"MM\0*",
    b"RIFF\x40\0\0\0WEBPVP8 ",
    b"BM",
    b"GIF89a",
    b"P6 ",
)


def any_picture() -> st.SearchStrategy[bytes]:
    """A damaged picture, or noise behind the mark of a format."""
    noise = st.tuples(st.sampled_from(MAGIC), st.binary(max_size=400)).map(b"".join)
    return st.one_of(*(damaged(picture) for picture in pictures().values()), noise)


def try_photo(folder: Path) -> None:
    decoded = decode(folder / "a.png")
    assert decoded.pixels.dtype == np.uint8 and decoded.pixels.shape[2] in (3, 4)
    for measure in (sharpness, one_colour, thumbnail):
        measure(decoded.pixels)


def try_mask(folder: Path) -> None:
    mask = read_mask(folder / "a.png", H, W, 6).pixels
    assert mask.shape == (W, H) and set(np.unique(mask)) <= {0, 255}


@cache
def clip() -> bytes:
    """A short video whose picture moves."""
    noise = np.random.default_rng(0).integers(0, 256, (48, 160, 3), np.uint8).repeat(2, 0).repeat(2, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        with video_writer(path, 96, 96, 8) as append:
            for k in range(8):
                append(np.ascontiguousarray(noise[:, 8 * k : 8 * k + 96]))
        return path.read_bytes()


def try_video(folder: Path) -> None:
    (folder / "out").mkdir()
    assert len(take_frames(folder / "a.mp4", 5, folder / "out", SilentDisplay())) >= 3
