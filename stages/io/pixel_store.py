"""The pixels of a set of photos at one size, in a file that is mapped into memory: a cache, made again when in doubt.

It lies beside the folder of ingest as ``<folder>.pixels/``, outside of every manifest and digest. A store is found by
what it was made from (names, sizes and times of the files, the size asked for), is written once under a lock, and
appears whole under its name or not at all. A CRC-32 of each photo's pixels stands at its end: what has changed on the
disk since is found before it is used, and made again. Photos are decoded several at a time, each written to its place
and dropped.

What a mapped file costs: as much memory as there is to spare, given back when others need it. Random reads are as
fast as from plain memory once the file has been read; where it is larger than memory, each pixel that is not there
waits for the disk (``benchmarks/pixel_store.py``).
"""

import hashlib
import json
import mmap
import os
import shutil
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from nerf.runtime.parallel import in_order
from stages.contract import Progress, StageError
from stages.hardware.memory import available_bytes
from stages.io.amounts import bytes_in_words
from stages.io.stopwatch import live_line

VERSION = 3  # raised when the same photos would give other pixels
CHECKSUM_BYTES = 4
FITS = 0.8  # share of the free memory up to which a store is read ahead as a whole


class StoredPhoto(NamedTuple):
    """A photo of a store: its file below ingest's folder, its size in pixels there, and the file of its alpha where
    that is another one."""

    file: str
    width: int
    height: int
    alpha: str | None = None


Load = Callable[[int], "np.ndarray"]
"""The pixels (height, width, channels) uint8 of a store's photo, by its index; called from several threads."""


@dataclass(frozen=True)
class PixelStore:
    """Where the pixels of ``photos`` lie, whether or not they are there yet; make it with :func:`pixel_store`."""

    path: Path
    photos: tuple[StoredPhoto, ...]
    channels: int

    @cached_property
    def starts(self) -> list[int]:
        """At which byte each photo begins, and at last where the last one ends."""
        starts = [0]
        for photo in self.photos:
            starts.append(starts[-1] + photo.width * photo.height * self.channels)
        return starts

    @property
    def size(self) -> int:
        """Of the file in bytes: the pixels, and a checksum per photo."""
        return self.starts[-1] + CHECKSUM_BYTES * len(self.photos)

    def shape(self, index: int) -> tuple[int, int, int]:
        """Height, width and channels of one photo."""
        return self.photos[index].height, self.photos[index].width, self.channels

    @property
    def is_whole(self) -> bool:
        """Whether the pixels are there."""
        return self.path.is_file() and self.path.stat().st_size == self.size

    def damaged(self) -> list[str]:
        """The files of the photos whose pixels are no longer those that were written; reads all of a whole store."""
        sound = in_order(lambda index: self.photo(index) is not None, range(len(self.photos)), torch.device("cpu"))
        return [photo.file for photo, is_sound in zip(self.photos, sound, strict=True) if not is_sound]

    def photo(self, index: int) -> np.ndarray | None:
        """The pixels of one photo, read into memory; None where they are no longer those that were written."""
        starts = self.starts
        with self.path.open("rb") as stream:
            stream.seek(starts[index])
            pixels = stream.read(starts[index + 1] - starts[index])
            stream.seek(starts[-1] + CHECKSUM_BYTES * index)
            if checksum(pixels) != stream.read(CHECKSUM_BYTES):
                return None
        return np.frombuffer(pixels, np.uint8).reshape(self.shape(index))

    def table(self, progress: Progress) -> Tensor:
        """All pixels, (pixels, channels) uint8, mapped into memory; not to be written to."""
        with self.path.open("rb") as stream:
            mapped = mmap.mmap(stream.fileno(), self.starts[-1], access=mmap.ACCESS_READ)
        free = available_bytes()
        fits = len(mapped) <= FITS * free
        if not fits:
            sizes = f"{bytes_in_words(len(mapped))} at this size, and only {bytes_in_words(free)} of memory are free"
            progress.note(
                "io.photos-exceed-memory",
                f"the photos take {sizes}: the disk slows down training; a larger --train.downscale avoids that",
            )
        if hasattr(mapped, "madvise"):  # not on Windows
            mapped.madvise(mmap.MADV_WILLNEED if fits else mmap.MADV_RANDOM)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The given buffer is not writable")
            return torch.frombuffer(mapped, dtype=torch.uint8).view(-1, self.channels)


def checksum(pixels: bytes | memoryview) -> bytes:
    """CRC-32 of a photo's pixels, as it stands in the file."""
    return zlib.crc32(pixels).to_bytes(CHECKSUM_BYTES, "little")


def pixel_store(ingest: Path, name: str, photos: Sequence[StoredPhoto], channels: int) -> PixelStore:
    """The store of these photos of ``ingest``, whole or still to be made; ``name`` is for people only."""
    made_from = []
    for photo in photos:
        file = (ingest / photo.file).stat()
        made_from.append([*photo, file.st_size, file.st_mtime_ns])
    key = hashlib.sha256(json.dumps([VERSION, channels, made_from]).encode()).hexdigest()[:16]
    return PixelStore(ingest.with_name(f"{ingest.name}.pixels") / f"{name}-{key}", tuple(photos), channels)


def fill(store: PixelStore, load: Load, workers: Callable[[], int], progress: Progress) -> None:
    """Write the pixels of all photos, as many at a time as ``workers`` answers, unless they are there and sound;
    waits where another process is at it.

    Raises:
        StageError: if the disk has no room for them.
        OSError: if a photo cannot be read or the store not be written.
    """
    if _is_sound(store, progress):
        return
    store.path.parent.mkdir(exist_ok=True)
    with _only_one(store, progress):
        if not store.is_whole:  # nobody else was faster
            _write(store, load, workers(), progress)


def _is_sound(store: PixelStore, progress: Progress) -> bool:
    """Whether the pixels are there as they were written; a store that has changed since is removed."""
    if not store.is_whole:
        return False
    if not (damaged := store.damaged()):
        return True
    progress.note(
        "io.pixels-changed",
        f"rebuilding the pixel store {store.path.name}: the pixels of {damaged[0]} have changed on the disk",
    )
    store.path.unlink()
    return False


@contextmanager
def _only_one(store: PixelStore, progress: Progress) -> Iterator[None]:
    """One process at a time; the system lifts the lock of one that dies."""
    lock = FileLock(store.path.with_name(f"{store.path.name}.lock"))
    while not lock.is_locked:
        try:
            lock.acquire(timeout=0.5)
        except Timeout:
            progress.update("waiting for another process that reads the same photos")
    try:
        yield
    finally:
        lock.release()


def _write(store: PixelStore, load: Load, workers: int, progress: Progress) -> None:
    if store.path.exists():
        found = f"it has {store.path.stat().st_size:,} bytes instead of {store.size:,}"
        progress.note("io.pixel-store-rebuilt", f"rebuilding the pixel store {store.path.name}: {found}")
    partial, photos, written = store.path.with_name(f"{store.path.name}.partial"), len(store.photos), 0

    def describe() -> tuple[str, float]:
        waiting = f", writing {bytes_in_words(store.starts[-1])} to the disk" if written == photos else ""
        return f"read {written} of {photos} photos{waiting}", written / photos

    try:
        with partial.open("wb") as stream, live_line(progress, describe):
            _check_room(store)
            for _ in _write_photos(store, load, workers, stream):
                written += 1
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(store.path)
    finally:
        partial.unlink(missing_ok=True)


def _write_photos(store: PixelStore, load: Load, workers: int, stream: BinaryIO) -> Iterator[None]:
    """Every photo at its place. At a time there are as many in memory as there are workers."""
    writing, starts = threading.Lock(), store.starts

    def write(index: int) -> None:
        pixels = load(index)
        if pixels.shape != store.shape(index):
            raise ValueError(f"{store.photos[index].file} has shape {pixels.shape} instead of {store.shape(index)}")
        # Written and not mapped: on a full disk a write raises OSError, where a mapping would kill the process.
        with writing:
            stream.seek(starts[index])
            stream.write(pixels.data)
            stream.seek(starts[-1] + CHECKSUM_BYTES * index)
            stream.write(checksum(pixels.data))

    pool = ThreadPoolExecutor(workers)
    try:
        for future in [pool.submit(write, index) for index in range(len(store.photos))]:
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _check_room(store: PixelStore) -> None:
    free, needed = shutil.disk_usage(store.path.parent).free, store.size
    if needed > free:
        why = f"they take {bytes_in_words(needed)} at this size; {store.path.parent} has {bytes_in_words(free)} free"
        raise StageError(
            "io.no-room-for-pixels",
            "no room for the pixels of the photos",
            why,
            "Free disk space, or give a larger --train.downscale.",
        )
