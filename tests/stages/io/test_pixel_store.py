"""The pixel store holds what was loaded, is whole or absent, is made once, and never holds many photos in memory."""

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

import stages.io.pixel_store
from pipeline.engine.workspace import Workspace
from stages.contract import StageError
from stages.io.pixel_store import Load, PixelStore, StoredPhoto, checksum, pixel_store
from tests.conftest import RecordedProgress

SIZES = [(5, 3), (4, 2), (7, 6), (5, 3)]  # (width, height)


def store_of(folder: Path, channels: int = 3, name: str = "train") -> PixelStore:
    ingest = folder / "0123456789abcdef"
    ingest.mkdir(exist_ok=True)
    photos = [StoredPhoto(f"{index}.png", *size) for index, size in enumerate(SIZES)]
    for photo in photos:
        if not (ingest / photo.file).exists():
            (ingest / photo.file).write_text("only its size and time matter here")
    return pixel_store(ingest, name, photos, channels)


def fill(store: PixelStore, load: Load, progress: RecordedProgress) -> None:
    """With two workers."""
    stages.io.pixel_store.fill(store, load, lambda: 2, progress)


def painted(index: int, channels: int = 3) -> np.ndarray:
    width, height = SIZES[index]
    return np.random.default_rng(index).integers(0, 256, (height, width, channels), dtype=np.uint8)


def never(index: int) -> np.ndarray:
    raise AssertionError(f"photo {index} is decoded again")


def kept(store: PixelStore, index: int) -> np.ndarray:
    """A photo of the store, whose pixels are those that were written."""
    pixels = store.photo(index)
    assert pixels is not None
    return pixels


@pytest.mark.parametrize("channels", [3, 4])
def test_it_holds_what_was_loaded(tmp_path: Path, progress: RecordedProgress, channels: int) -> None:
    store = store_of(tmp_path, channels)
    assert not store.is_whole
    fill(store, lambda index: painted(index, channels), progress)
    assert store.is_whole
    expected = [painted(index, channels) for index in range(len(SIZES))]
    table = store.table(progress)
    assert table.dtype == torch.uint8
    assert np.array_equal(table.numpy(), np.concatenate([pixels.reshape(-1, channels) for pixels in expected]))
    for index, pixels in enumerate(expected):
        assert np.array_equal(kept(store, index), pixels)
    assert progress.updates[-1] == ("read 4 of 4 photos, writing 0 MB to the disk", 1.0)
    assert progress.notes == []


def test_it_is_made_once_and_lies_beside_ingest(tmp_path: Path, progress: RecordedProgress) -> None:
    fill(store_of(tmp_path), painted, progress)
    again = store_of(tmp_path)
    fill(again, never, progress)
    assert again.path.parent == tmp_path / "0123456789abcdef.pixels"
    assert sorted(path.name for path in again.path.parent.iterdir() if path.suffix != ".lock") == [again.path.name]


def test_another_content_is_another_store(tmp_path: Path) -> None:
    first = store_of(tmp_path)
    assert store_of(tmp_path).path == first.path
    others = [store_of(tmp_path, channels=4), store_of(tmp_path, name="test")]
    ingest, photos = tmp_path / "0123456789abcdef", list(first.photos)
    others.append(pixel_store(ingest, "train", photos[:3], 3))
    others.append(pixel_store(ingest, "train", [photos[0]._replace(width=4), *photos[1:]], 3))
    os.utime(ingest / photos[0].file, ns=(0, 0))
    others.append(store_of(tmp_path))
    (ingest / photos[0].file).write_text("longer than it was before, by far")
    os.utime(ingest / photos[0].file, ns=(0, 0))
    others.append(store_of(tmp_path))
    assert len({store.path for store in (first, *others)}) == 7


def test_clean_takes_it_away(tmp_path: Path, progress: RecordedProgress) -> None:
    (tmp_path / "ingest").mkdir()
    store = store_of(tmp_path / "ingest")
    fill(store, painted, progress)
    stale = Workspace(tmp_path).stale_folders({"ingest": "0123456789abcdef"}, ["ingest"])
    assert stale == [store.path.parent]


@pytest.mark.parametrize("size", [0, 1, 10_000])
def test_a_damaged_store_is_made_again_and_said(tmp_path: Path, progress: RecordedProgress, size: int) -> None:
    store = store_of(tmp_path)
    fill(store, painted, progress)
    os.truncate(store.path, size)
    assert not store.is_whole
    fill(store, painted, progress)
    assert np.array_equal(kept(store, 2), painted(2))
    assert progress.codes == ["io.pixel-store-rebuilt"]
    assert progress.names("io.pixel-store-rebuilt", store.path.name, f"{size:,} bytes", 256)


def test_photos_are_decoded_a_few_at_a_time_and_dropped(tmp_path: Path, progress: RecordedProgress) -> None:
    ingest = tmp_path / "ingest"
    ingest.mkdir()
    (ingest / "a").touch()
    store = pixel_store(ingest, "train", [StoredPhoto("a", 8, 8)] * 40, 3)
    counting, alive, most = threading.Lock(), weakref.WeakSet(), 0

    class Pixels(np.ndarray):
        __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]

    def load(index: int) -> np.ndarray:
        nonlocal most
        pixels = np.full((8, 8, 3), index, np.uint8).view(Pixels)
        with counting:
            alive.add(pixels)
            most = max(most, len(alive))
        return pixels

    fill(store, load, progress)
    assert 1 <= most <= 2
    assert kept(store, 39).min() == kept(store, 39).max() == 39


def test_a_failure_leaves_nothing_behind(tmp_path: Path, progress: RecordedProgress) -> None:
    def fails(index: int) -> np.ndarray:
        if index == 2:
            raise OSError("truncated")
        return painted(index)

    store = store_of(tmp_path)
    with pytest.raises(OSError, match="truncated"):
        fill(store, fails, progress)
    with pytest.raises(ValueError, match=r"0\.png has shape \(3, 5\) instead of \(3, 5, 3\)"):
        fill(store, lambda index: painted(index)[..., 0], progress)
    assert [path.suffix for path in store.path.parent.iterdir()] == [".lock"]
    fill(store, painted, progress)
    assert store.is_whole


def test_no_room_is_said_before_anything_is_decoded(tmp_path: Path, progress: RecordedProgress) -> None:
    (tmp_path / "ingest").mkdir()
    (tmp_path / "ingest/a").touch()
    store = pixel_store(tmp_path / "ingest", "train", [StoredPhoto("a", 10**7, 10**7)], 3)
    with pytest.raises(StageError) as caught:
        fill(store, never, progress)
    assert caught.value.code == "io.no-room-for-pixels"
    assert "279396.8 GB" in caught.value.why and str(store.path.parent) in caught.value.why
    assert not store.path.exists()


def test_more_than_memory_is_said(tmp_path: Path, progress: RecordedProgress, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_of(tmp_path)
    fill(store, painted, progress)
    monkeypatch.setattr("stages.io.pixel_store.FITS", 0.0)
    assert np.array_equal(store.table(progress)[:15].numpy(), painted(0).reshape(-1, 3))
    assert progress.codes == ["io.photos-exceed-memory"]
    assert progress.names("io.photos-exceed-memory", "0 MB", "--train.downscale")


def test_a_second_process_waits_and_finds_it_made(tmp_path: Path, progress: RecordedProgress) -> None:
    store = store_of(tmp_path)
    store.path.parent.mkdir()
    lock = FileLock(store.path.with_name(f"{store.path.name}.lock"))
    lock.acquire()
    waiting = threading.Thread(target=fill, args=(store, never, progress))
    waiting.start()
    while not progress.updates:
        time.sleep(0.01)
    pixels = [painted(index).tobytes() for index in range(len(SIZES))]
    store.path.write_bytes(b"".join([*pixels, *map(checksum, pixels)]))
    lock.release()
    waiting.join(10)
    assert not waiting.is_alive()
    assert {message for message, _ in progress.updates} == {"waiting for another process that reads the same photos"}


KILLED = """
import os, signal, sys, time
from pathlib import Path
from tests.conftest import RecordedProgress
from tests.stages.io.test_pixel_store import fill, painted, store_of

def load(index):
    if index == 3:
        time.sleep(0.2)  # the others are being written
        os.kill(os.getpid(), signal.SIGKILL)
    return painted(index)

fill(store_of(Path(sys.argv[1])), load, RecordedProgress())
"""


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_kill_leaves_no_store_and_no_lock(tmp_path: Path, progress: RecordedProgress) -> None:
    store = store_of(tmp_path)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], cwd=Path(__file__).parents[3])
    assert killed.returncode == -signal.SIGKILL
    assert store.path.with_name(f"{store.path.name}.partial").exists() and not store.is_whole
    fill(store, painted, progress)
    assert np.array_equal(kept(store, 3), painted(3))
    assert not store.path.with_name(f"{store.path.name}.partial").exists()


def test_a_flipped_bit_is_found_said_and_made_again(tmp_path: Path, progress: RecordedProgress) -> None:
    store = store_of(tmp_path)
    fill(store, painted, progress)
    sound = store.path.read_bytes()
    for bit in (0, 8 * store.starts[2] + 3, 8 * store.starts[-1] + 1):  # of the pixels, and of a checksum
        store.path.write_bytes(flipped(sound, bit))
        assert len(store.damaged()) == 1
        fill(store, painted, progress)
        assert store.path.read_bytes() == sound
    assert progress.codes == 3 * ["io.pixels-changed"]


def flipped(content: bytes, bit: int) -> bytes:
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
