"""Photos are decoded on as many threads as memory holds of their files' sizes."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

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
    monkeypatch.setattr("stages.io.pixels.DECODING_BYTES", 2 * 80 * WIDTH * HEIGHT)
    monkeypatch.setattr("stages.io.pixel_store.ThreadPoolExecutor", pool)
    training_dataset(inputs["ingest"], replace(scene, has_alpha=has_alpha), "train", downscale, progress)
    assert asked == [2]
