"""As what photos are written that cannot be copied: with losses only where there were some, and hardly any more."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from stages import ingest
from stages.ingest import Config
from stages.ingest.decoding import decode
from stages.io.photos import Photo, read_photos
from tests.blots import blots
from tests.stages.ingest.photo_files import exif_with


def photo(seed: int) -> Image.Image:
    """A picture as cameras interpolate it, with their noise: its finest details are two pixels wide."""
    picture = cv2.resize(blots(seed, 320, 240), (640, 480), interpolation=cv2.INTER_CUBIC)
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 3, picture.shape), (0, 0), 0.7)
    return Image.fromarray(np.clip(picture + noise, 0, 255).astype(np.uint8))


def written(folder: Path, out: Path, progress: Any) -> dict[str, Photo]:
    ingest.run(Config(photos=folder), {}, out, progress)
    return {photo.name: photo for photo in read_photos(out)}


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def test_a_turned_jpeg_stays_within_45_decibels(tmp_path: Path, progress: Any) -> None:
    (tmp_path / "in").mkdir()
    for seed in range(3):
        photo(seed).save(tmp_path / f"in/{seed}.jpg", quality=92, exif=exif_with(6))
    photos = written(tmp_path / "in", tmp_path / "out", progress)
    written(tmp_path / "in", tmp_path / "again", progress)
    for name, taken in photos.items():
        assert (taken.file, taken.width, taken.height) == (f"images/{name}", 480, 640)
        content = (tmp_path / "out" / taken.file).read_bytes()
        assert content == (tmp_path / "again" / taken.file).read_bytes()
        with Image.open(io.BytesIO(content)) as image:
            assert image.format == "JPEG" and not image.getexif()
            assert {layer[1:3] for layer in image.layer} == {(1, 1)}  # pyright: ignore[reportAttributeAccessIssue]
            pixels = np.asarray(image)
        assert psnr(pixels, decode(tmp_path / "in" / name).pixels) > 45
        png = io.BytesIO()
        Image.fromarray(pixels).save(png, "PNG")
        assert len(content) < 0.6 * png.tell()


@pytest.mark.parametrize(
    ("name", "mode", "options", "suffix"),
    [
        ("cmyk.jpg", "CMYK", {}, ".jpg"),
        ("grey.jpg", "L", {}, ".jpg"),
        ("a.heic", "RGB", {}, ".jpg"),
        ("a.avif", "RGB", {}, ".jpg"),
        ("a.webp", "RGB", {"quality": 90}, ".jpg"),
        ("lossless.webp", "RGB", {"lossless": True}, ".png"),
        ("alpha.webp", "RGBA", {"quality": 90}, ".png"),
        ("alpha.avif", "RGBA", {}, ".png"),
        ("a.tif", "RGB", {}, ".png"),
        ("turned.png", "RGB", {"exif": exif_with(3)}, ".png"),
    ],
)
def test_what_had_losses_and_has_no_alpha_becomes_jpeg(
    name: str, mode: str, options: dict[str, Any], suffix: str, tmp_path: Path, progress: Any
) -> None:
    (tmp_path / "in").mkdir()
    for seed in range(2):
        photo(seed).save(tmp_path / f"in/z{seed}.png")
    picture = photo(3).convert(mode)
    if mode == "RGBA":
        picture.putalpha(200)
    decode(tmp_path / "in/z0.png")  # registers HEIC
    try:
        picture.save(tmp_path / "in" / name, **options)
    except (KeyError, RuntimeError, OSError) as error:
        pytest.skip(f"{name} cannot be written here: {error}")
    taken = written(tmp_path / "in", tmp_path / "out", progress)[name]
    assert Path(taken.file).suffix == suffix
    with Image.open(tmp_path / "out" / taken.file) as image:
        assert image.format == {".jpg": "JPEG", ".png": "PNG"}[suffix]
        stored, decoded = np.asarray(image), decode(tmp_path / "in" / name).pixels
    assert psnr(stored, decoded) > 45 if suffix == ".jpg" else np.array_equal(stored, decoded)
