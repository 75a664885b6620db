"""Photos are decoded on as many threads as memory holds of their files' sizes."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stages.io.pixels import BYTES_PER_PIXEL, CONTRAST_SCALE, even_contrast, load_pixels
from stages.train.data import training_dataset
from tests.conftest import RecordedProgress
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed


@pytest.mark.parametrize("downscale", [1.0, 8.0])
@pytest.mark.parametrize("has_alpha", [True, False])  # of the scene: where it has none, that of photos is dropped
def test_parallel_decoding_follows_the_files_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, progress: RecordedProgress, has_alpha: bool, downscale: float
) -> None:
    def pool(workers: int) -> ThreadPoolExecutor:
        asked.append(workers)
        return ThreadPoolExecutor(workers)

    asked = list[int]()
    inputs, scene = photographed(tmp_path, channels=4)
    monkeypatch.setattr("stages.io.pixels.processors", lambda: 16)
    monkeypatch.setattr("stages.io.pixels.DECODING_BYTES", 2 * BYTES_PER_PIXEL[4] * WIDTH * HEIGHT)
    monkeypatch.setattr("stages.io.pixel_store.ThreadPoolExecutor", pool)
    training_dataset(inputs["ingest"], replace(scene, has_alpha=has_alpha), "train", downscale, progress)
    assert asked == [2]


def nearby(values: np.ndarray) -> np.ndarray:
    return cv2.blur(values, (31, 31))


@given(st.floats(0.2, 1.0), st.integers(0, 50), st.integers(0, 2**32))
def test_even_contrast_is_that_of_any_light(gain: float, offset: int, seed: int) -> None:
    grey = np.random.default_rng(seed).integers(0, 200, (90, 120), np.uint8)
    seen = np.rint(offset + gain * grey).astype(np.uint8)
    difference = even_contrast(seen, nearby, 3.0).astype(int) - even_contrast(grey, nearby, 3.0)
    assert np.abs(difference).max() <= 8  # a fifth of a deviation, of rounding and of noise
    assert abs(even_contrast(grey, nearby, 3.0).std() - CONTRAST_SCALE) < 3


def test_noise_stays_faint_where_contrast_is_even() -> None:
    noise = np.random.default_rng(0).integers(100, 102, (90, 120)).astype(np.uint8)
    assert even_contrast(noise, nearby, 3.0).std() < CONTRAST_SCALE / 4


@pytest.mark.parametrize(("size", "differs"), [((400, 304), True), ((404, 302), True), ((401, 304), False)])
def test_a_quick_reduction_is_nearly_the_mean(tmp_path: Path, size: tuple[int, int], differs: bool) -> None:
    coarse = np.random.default_rng(0).integers(0, 256, (9, 11, 3), np.uint8)
    Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC).save(tmp_path / "a.jpg", quality=95)
    whole, quick = (load_pixels(tmp_path / "a.jpg", 50, 38, quick=each).astype(float) for each in (False, True))
    error = np.sqrt(((quick - whole) ** 2).mean())
    assert (error > 0) == differs and error < 1
