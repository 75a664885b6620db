"""photos.json round trips, and pixels at any size are area means."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stages.io import pixels
from stages.io.photos import Photo, Rejection, read_frame_names, read_photos, write_photos
from stages.io.pixels import load_mask, load_pixels, loaders, opaque_box, pillow
from tests.png_files import png
from tests.refusals import refused


def stored(folder: Path, pixels: np.ndarray) -> Path:
    path = folder / "p.png"
    Image.fromarray(pixels).save(path)
    return path


def random_pixels(height: int, width: int, channels: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, channels), dtype=np.uint8)


def coverage(size: int, target: int) -> np.ndarray:
    """(target, size) matrix: how much of each source pixel each target pixel covers; rows sum to one."""
    edges = np.arange(target + 1) * size / target
    pixel = np.arange(size)
    overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return np.clip(overlap, 0, None) * target / size


def test_coverage_is_a_partition() -> None:
    assert np.allclose(coverage(7, 3).sum(axis=1), 1)
    assert np.allclose(coverage(7, 3).sum(axis=0), 3 / 7)


@pytest.mark.parametrize("channels", [3, 4])
def test_own_size_is_the_identity(tmp_path: Path, channels: int) -> None:
    pixels = random_pixels(9, 7, channels)
    assert np.array_equal(load_pixels(stored(tmp_path, pixels), 7, 9), pixels)


@given(width=st.integers(1, 13), height=st.integers(1, 11))
def test_smaller_sizes_are_area_means(tmp_path_factory: pytest.TempPathFactory, width: int, height: int) -> None:
    pixels = random_pixels(11, 13, 3)
    loaded = load_pixels(stored(tmp_path_factory.getbasetemp(), pixels), width, height)
    expected = np.einsum("ai,bj,ijc->abc", coverage(11, height), coverage(13, width), pixels.astype(float))
    assert loaded.shape == (height, width, 3) and loaded.dtype == np.uint8
    assert np.abs(loaded - expected).max() <= 0.51


def test_colours_are_weighted_by_alpha(tmp_path: Path) -> None:
    pixels = random_pixels(12, 12, 4)
    loaded = load_pixels(stored(tmp_path, pixels), 5, 4)
    weights = coverage(12, 4), coverage(12, 5)
    alpha = np.einsum("ai,bj,ij->ab", *weights, pixels[..., 3] / 1.0)
    colour = np.einsum("ai,bj,ijc->abc", *weights, pixels[..., :3] * (pixels[..., 3:] / 1.0)) / alpha[..., None]
    assert np.abs(loaded - np.concatenate([colour, alpha[..., None]], axis=2)).max() <= 0.51


def test_the_colour_of_transparent_pixels_does_not_leak(tmp_path: Path) -> None:
    pixels = np.zeros((4, 8, 4), np.uint8)
    pixels[:, :4] = (255, 0, 0, 255)
    pixels[:, 4:] = (0, 255, 0, 0)
    loaded = load_pixels(stored(tmp_path, pixels), 4, 2)
    assert np.array_equal(loaded[:, :2], np.broadcast_to([255, 0, 0, 255], (2, 2, 4)))
    assert np.array_equal(loaded[:, 2:], np.zeros((2, 2, 4)))
    half = load_pixels(stored(tmp_path, pixels), 1, 1)
    assert half.tolist() == [[[255, 0, 0, 128]]]


@pytest.mark.parametrize(
    ("size", "alpha", "cores", "expected"),
    [
        ((400, 400), True, 2, 2),
        ((4000, 3000), False, 2, 2),
        ((4000, 3000), False, 64, 5),
        ((4000, 3000), True, 64, 2),
        ((9000, 8000), True, 8, 1),
    ],
)
def test_large_photos_are_loaded_by_fewer_threads(
    tmp_path: Path, size: tuple[int, int], alpha: bool, cores: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pixels, "processors", lambda: cores)
    (tmp_path / "large.png").write_bytes(png(*size, b"", alpha=alpha))
    (tmp_path / "small.png").write_bytes(png(1, 1, b""))
    assert loaders([tmp_path / "large.png", tmp_path / "small.png"]) == expected


def test_accepted_photos_are_no_bomb_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow refuses more than 179 megapixels, ingest more than 250."""
    photo, mask = stored(tmp_path, random_pixels(9, 7, 3)), tmp_path / "mask.png"
    Image.fromarray(random_pixels(9, 7, 1)[..., 0]).save(mask)
    for read in (lambda: load_pixels(photo, 7, 9), lambda: loaders([photo]), lambda: load_mask(mask, 7, 9)):
        monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 10)
        pillow.cache_clear()  # as if nothing had been decoded
        read()
    pillow.cache_clear()  # the limit comes back


def photo(**changes: object) -> Photo:
    values = {"name": "é\n.jpg", "file": "images/e-1.jpg", "width": 4, "height": 3, "camera_group": 0}
    values |= {"focal_px": 1 / 3, "focal_source": "FocalLengthIn35mmFilm", "has_alpha": False, "sharpness": 12.5}
    return Photo(**values | changes)  # pyright: ignore[reportArgumentType]


def test_a_photo_keeps_its_folder_in_colmap_names() -> None:
    photo = Photo("Küche/1.jpg", "images/Kuche/images/1.jpg", 60, 40, 0, None, None, False, 1.0)
    assert photo.image_name == "Kuche/images/1.jpg"


def test_photos_json_round_trips(tmp_path: Path) -> None:
    photos = [photo(), photo(name="b", focal_px=None, focal_source=None)]
    write_photos(tmp_path, photos, [Rejection("c.jpg", "ingest.damaged-file", "truncated")], {"./b": "b"})
    assert read_photos(tmp_path) == photos
    assert read_frame_names(tmp_path) == {"./b": "b"}


@pytest.mark.parametrize("content", ["", "{}", '{"photos": [{"name": "a"}]}', "[]", '{"photos": 3}'])
def test_a_damaged_photos_json_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "photos.json").write_text(content)
    with refused("io.damaged-fields", "photos.json"):
        read_photos(tmp_path)


def test_what_is_opaque_lies_in_its_box() -> None:
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:20, 30:45, 3] = 200
    pixels[5, 5, 3] = 127  # less than half
    assert opaque_box(pixels) == (0.5, 0.25, 0.75, 0.5)
    assert opaque_box(np.full((4, 6, 4), 255, np.uint8)) is None
    assert opaque_box(np.zeros((4, 6, 4), np.uint8)) is None
    assert opaque_box(pixels[..., :3]) is None
