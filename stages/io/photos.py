"""The photos as ingest left them: what photos.json says of each."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from stages.io.files import damaged, read_dataclass, write_json

Box = tuple[float, float, float, float]
"""Left, top, right and bottom of a rectangle, as shares of a photo's width and height."""


@dataclass(frozen=True)
class Photo:
    """One decoded photo, upright, 8-bit sRGB.

    Photos of equal ``camera_group`` share intrinsics, turned with them where ``orientation`` differs. ``focal_px`` is
    the focal length that EXIF tells, at this size, and ``focal_source`` the tag it came from; both None where EXIF
    tells none. ``sharpness`` is the variance of the Laplacian; it compares photos of one set and means nothing by
    itself. ``relative_sharpness`` is it over the median of its neighbours' (stages/ingest/sharpness.py), None where
    there are too few.

    ``mask`` is a grey PNG of the photo's size, 255 where it is to be used and 0 where it is to be ignored; None: all of
    it is used, and it came without a mask, or no mask of the set ignores anything. ``near_duplicate_of`` is the name of
    the photo that is nearly the same picture, which is used in its place. ``time_s`` is when a frame of a video was
    taken, in seconds from its beginning, None for photos. The place is EXIF's, in degrees (north and east positive) and
    metres above the sea, None where it tells none; so are ``exposure_ev``, in stops, and ``clock_s``, when it was taken
    (stages/ingest/exif.py). ``opaque`` holds all that is more than half opaque, None without alpha. ``has_alpha``: not
    nearly all of it is; ``opaque_mask`` is a mask that ignores the rest beside what ``mask`` does. ``used_share`` and
    ``opaque_share`` are what the two masks leave of the pixels. ``orientation`` is EXIF's, which was undone in the
    pixels.
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
class Rejection:
    """A file that was not taken, and why: ``code`` for programs, ``reason`` for people."""

    name: str
    code: str
    reason: str


def write_photos(
    folder: Path, photos: Sequence[Photo], rejected: Sequence[Rejection], frames: Mapping[str, str]
) -> None:
    """Write photos.json. ``frames`` maps each file_path of the imported poses to the name of its photo."""
    content = {"photos": [asdict(p) for p in photos], "rejected": [asdict(r) for r in rejected], "frames": dict(frames)}
    write_json(folder / "photos.json", content)


def read_photos(ingest_folder: Path) -> list[Photo]:
    """The photos of a finished ingest, in order of their names. Raises StageError if photos.json is damaged."""
    photos = _read(ingest_folder).photos
    for file in (f for photo in photos for f in (photo.file, photo.mask, photo.opaque_mask) if f is not None):
        if not re.fullmatch(r"(images|masks|opaque)(/[\w-][\w.-]*)+", file, re.ASCII):
            raise damaged("io.photo-outside", "photos.json", f"{file[:40]!r} is not a file in this folder")
    return photos


def read_frame_names(ingest_folder: Path) -> dict[str, str]:
    """Photo name by file_path as the given transforms file spells it; empty if no cameras were given."""
    return _read(ingest_folder).frames


@dataclass(frozen=True)
class _PhotosFile:
    """photos.json."""

    photos: list[Photo]
    rejected: list[Rejection]
    frames: dict[str, str]


def _read(ingest_folder: Path) -> _PhotosFile:
    return read_dataclass(ingest_folder / "photos.json", _PhotosFile)


def ends_within(box: Box | None) -> bool:
    """Whether what a box holds, nothing at all too, ends within its photo on the left and right, or above and below."""
    left, top, right, bottom = box or (1.0, 1.0, 0.0, 0.0)
    return (left > 0 and right < 1) or (top > 0 and bottom < 1)


def spread(length: int, count: int) -> list[int]:
    """A few of many, evenly: ``count`` indices in the middle of equal parts of a list of ``length``."""
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]
