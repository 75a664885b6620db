"""The photos as ingest left them: what photos.json says of each, and their pixels at any size."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stages.hardware.device import processors
from stages.io.files import damaged, read_dataclass, write_json

if TYPE_CHECKING:
    import numpy as np


Box = tuple[float, float, float, float]
"""Left, top, right and bottom of a rectangle, as shares of a photo's width and height."""
OPAQUE_FROM = 128  # of 255: from here on a pixel is more opaque than transparent
DECODING_BYTES = 1 << 30  # how much memory may go into photos that are being loaded at a time
BYTES_PER_PIXEL = {3: 16, 4: 80}  # of the file, that loading and shrinking takes, by channels; 10 and 78 measured


@dataclass(frozen=True)
class Photo:
    """One decoded photo, upright, 8-bit sRGB.

    Photos of equal ``camera_group`` share intrinsics. ``focal_px`` is the focal length that EXIF tells, at this
    size, and ``focal_source`` the tag it came from; both None where EXIF tells none. ``sharpness`` is the variance
    of the Laplacian; it compares photos of one set and means nothing by itself. ``relative_sharpness`` is it over the
    median of its neighbours' (stages/ingest/sharpness.py), None where there are too few.

    ``mask`` is a grey PNG of the photo's size, 255 where it is to be used and 0 where it is to be ignored; None: all of
    it is used. ``near_duplicate_of`` is the name of the photo that is nearly the same picture, which is used in its
    place. ``time_s`` is when a frame of a video was taken, in seconds from its beginning, None for photos. The place
    is EXIF's, in degrees (north and east positive) and metres above the sea, None where it tells none; so are
    ``exposure_ev``, in stops, and ``clock_s``, when it was taken (stages/ingest/exif.py). ``opaque`` holds all that is
    more than half opaque, None without alpha. ``has_alpha``: not nearly all of it is; ``opaque_mask`` is a mask that
    ignores the rest beside what ``mask`` does. ``used_share`` and ``opaque_share`` are what the two masks leave of the
    pixels. ``orientation`` is EXIF's, which was undone in the pixels.
    """

    name: str  # the user's own file name, relative to the photo folder
    file: str  # "images/…", ASCII, relative to ingest's folder
    width: int
    height: int
    camera_group: int
    focal_px: float | None
    focal_source: str | None
    has_alpha: bool
    sharpness: float
    relative_sharpness: float | None = None
    mask: str | None = None  # "masks/….png", relative to ingest's folder
    near_duplicate_of: str | None = None
    time_s: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude_m: float | None = None
    exposure_ev: float | None = None
    clock_s: float | None = None
    opaque: Box | None = None
    opaque_mask: str | None = None  # "opaque/….png", relative to ingest's folder
    opaque_share: float = 1.0
    used_share: float = 1.0
    orientation: int = 1

    @property
    def image_name(self) -> str:
        """Its name in COLMAP's databases and models and in registration.json: ``file`` without ``images/``."""
        return self.file.removeprefix("images/")


@dataclass(frozen=True)
class Refusal:
    """A file that was not taken, and why."""

    name: str
    reason: str


def write_photos(folder: Path, photos: Sequence[Photo], refused: Sequence[Refusal], frames: Mapping[str, str]) -> None:
    """Write photos.json. ``frames`` maps each file_path of the given cameras to the name of its photo."""
    content = {"photos": [asdict(p) for p in photos], "refused": [asdict(r) for r in refused], "frames": dict(frames)}
    write_json(folder / "photos.json", content)


def read_photos(ingest_folder: Path) -> list[Photo]:
    """The photos of a finished ingest, in order of their names. Raises StageError if photos.json is damaged."""
    photos = _read(ingest_folder).photos
    for file in (f for photo in photos for f in (photo.file, photo.mask, photo.opaque_mask) if f is not None):
        if not re.fullmatch(r"(images|masks|opaque)(/[\w-][\w.-]*)+", file, re.ASCII):
            raise damaged("io.photo-outside", "photos.json", f"{file[:40]!r} is no file of this folder")
    return photos


def read_frame_names(ingest_folder: Path) -> dict[str, str]:
    """Photo name by file_path as the given transforms file spells it; empty if no cameras were given."""
    return _read(ingest_folder).frames


@dataclass(frozen=True)
class _PhotosFile:
    """photos.json."""

    photos: list[Photo]
    refused: list[Refusal]
    frames: dict[str, str]


def _read(ingest_folder: Path) -> _PhotosFile:
    return read_dataclass(ingest_folder / "photos.json", _PhotosFile)


def opaque_box(pixels: "np.ndarray") -> Box | None:
    """What holds all that is more than half opaque of (h, w, 3 or 4) uint8; None where all or nothing of it is."""
    import numpy as np

    if pixels.shape[2] != 4:
        return None
    opaque = pixels[..., 3] >= OPAQUE_FROM
    if not opaque.any() or opaque.all():
        return None
    height, width = opaque.shape
    columns, rows = np.flatnonzero(opaque.any(axis=0)), np.flatnonzero(opaque.any(axis=1))
    left, right = float(columns[0]) / width, float(columns[-1] + 1) / width
    return left, float(rows[0]) / height, right, float(rows[-1] + 1) / height


def load_pixels(path: Path, width: int, height: int) -> "np.ndarray":
    """The image as (height, width, 3 or 4) uint8, each pixel the mean of the area it covers.

    The means are taken of sRGB values weighted by alpha (premultiplied); a pixel that nothing covers is black.
    At the image's own size the values are those stored. Enlarging interpolates linearly.
    """
    import cv2
    import numpy as np

    from stages.ingest.decoding import pillow

    with pillow().open(path) as image:
        pixels = np.asarray(image)
    if (pixels.shape[1], pixels.shape[0]) == (width, height):
        return pixels
    if pixels.shape[2] == 3:
        return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    alpha = pixels[..., 3:].astype(np.float32)
    premultiplied = np.concatenate([pixels[..., :3] * alpha, alpha], axis=2)
    resized = cv2.resize(premultiplied, (width, height), interpolation=cv2.INTER_AREA)
    covered = resized[..., 3:] > 0
    colour = np.divide(resized[..., :3], resized[..., 3:], out=np.zeros_like(resized[..., :3]), where=covered)
    return np.rint(np.concatenate([colour, resized[..., 3:]], axis=2)).astype(np.uint8)


def loaders(files: Iterable[Path]) -> int:
    """How many of these photos, or of their masks, to load at a time, each in a thread: one per core, fewer where they
    are too large for that. What counts is the size in the file, however small they are made afterwards."""
    return max(1, min(processors(), DECODING_BYTES // max(map(_loading_bytes, files))))


def _loading_bytes(file: Path) -> int:
    """Memory that :func:`load_pixels` takes, by the file's header."""
    from stages.ingest.decoding import pillow

    with pillow().open(file) as image:
        return BYTES_PER_PIXEL[len(image.getbands())] * image.width * image.height


def evenly_spread(length: int, count: int) -> list[int]:
    """``count`` indices in the middle of equal parts of a list of ``length``."""
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]
