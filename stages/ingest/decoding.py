"""Decoding one image file of any kind into upright 8-bit sRGB.

Files come from anywhere: formats are a fixed list, sizes are checked before pixels are decoded, and whatever goes
wrong becomes a :class:`DecodeError` with a reason a user understands.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageCms

from stages.ingest.auxiliary_files import Stored
from stages.ingest.exif import (
    GpsPosition,
    clock_from_exif,
    digital_zoom,
    exposure_from_exif,
    focal_from_exif,
    gps_from_exif,
    positive,
    read_exif,
)
from stages.ingest.listing import RAW_EXTENSIONS
from stages.ingest.orientation import QUARTER_TURNS, turned_size, upright
from stages.ingest.panoramas import Panorama, panorama_kind
from stages.ingest.video.tone_mapping import PHOTO_TRANSFERS, TONE_MAPPED, tone_mapped
from stages.io.files import stand_in
from stages.io.pixels import colour_range, pillow

MAX_PIXELS = 250_000_000
_SRGB_TOLERANCE = 2  # of 255: profiles closer than this to sRGB are sRGB written by another hand
MIN_SIDE_PX = 16
NEARLY, MIN_BLACK_AND_WHITE = 16, 0.95  # what JPEG leaves of black and white, and of how much of a mask
# EPS and its like run interpreters; RAW_EXTENSIONS files would be read as their thumbnails.
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "HEIF", "AVIF", "JPEG2000")
_DEEP_GREY = ("I", "I;16", "I;16L", "I;16B", "F")
_LOSSY = ("JPEG", "MPO", "HEIF", "AVIF")


class DecodeError(Exception):
    """A file that cannot become a photo: ``code`` for programs, and the reason, to be shown after the file's name."""

    def __init__(self, code: str, reason: str) -> None:
        super().__init__(code, reason)
        self.code = code
        self.reason = reason

    def __str__(self) -> str:
        return self.reason


class CameraKey(NamedTuple):
    """What tells the camera of an upright photo of ``width`` × ``height``, whose EXIF ``orientation`` was undone.

    ``focal_px`` is for pixels of this size, None where EXIF tells none or one out of FOCAL_RANGE.
    """

    make: str
    model: str
    lens: str
    width: int
    height: int
    orientation: int
    focal_mm: float | None
    focal_px: float | None
    digital_zoom: float = 1.0  # FocalLength is the same at any

    def sensor(self) -> "CameraKey":
        """Photos for which this agrees share intrinsics: the same however the camera was held. Mirrored photos share
        none with others: no camera mirrors."""
        if self.orientation not in QUARTER_TURNS:
            return self
        width, height = turned_size((self.width, self.height), self.orientation)
        return self._replace(width=width, height=height, orientation=1)


@dataclass(frozen=True)
class Decoded:
    """One image, upright, sRGB.

    ``suffix`` is ".jpg" or ".png" if the file's own bytes already say exactly this to any program (8-bit RGB or
    RGBA, sRGB, upright, one frame), so that they can be copied; otherwise None. ``stored`` is what kind of values it
    has. ``lossy`` is a file that was compressed with losses. ``notes`` tell what was assumed, ``exposure_ev`` is what
    :func:`exposure_from_exif` tells, ``clock_s`` what :func:`clock_from_exif` does.
    """

    pixels: np.ndarray  # (h, w, 3 or 4) uint8
    focal_source: str | None
    camera_key: CameraKey
    gps: GpsPosition
    exposure_ev: float | None
    clock_s: float | None
    suffix: str | None
    stored: Stored
    lossy: bool
    panorama: Panorama | None
    notes: tuple[str, ...]


def decode(path: Path) -> Decoded:
    """Decode one image file. Raises DecodeError with the reason if that cannot be done."""
    with _open(path) as image:
        stored_plainly, lossy = _is_plain(image), _is_lossy(image, path)
        turned = _undone_orientation(image)
        _load(image)
        return _convert(image, stored_plainly, lossy, turned)


def _open(path: Path) -> Image.Image:
    """The image with its header read, of a size we accept."""
    if path.suffix.lower() in RAW_EXTENSIONS:
        raise DecodeError("ingest.raw-file", "camera raw files are not supported; export JPEG, PNG or TIFF")
    library = pillow()
    try:
        image = library.open(path, formats=_FORMATS)
    except library.UnidentifiedImageError as error:
        raise _unrecognised(path) from error
    except FileNotFoundError as error:
        gone = "a broken link" if path.is_symlink() else "there is no such file"
        raise DecodeError("ingest.missing-file", gone) from error
    except Exception as error:  # on damaged files Pillow's parsers raise whatever they run into
        if isinstance(error, OSError) and error.errno is not None:  # not Pillow's but the system's
            raise DecodeError("ingest.unreadable-file", f"cannot be read: {error.strerror}") from error
        raise _damaged(f"damaged: its header cannot be read ({error})") from error
    width, height = image.size
    if width * height > MAX_PIXELS:
        megapixels = width * height / 1e6
        large = f"{width}×{height} is {megapixels:.0f} megapixels; the limit is {MAX_PIXELS / 1e6:.0f}"
        raise DecodeError("ingest.too-large", large)
    if min(width, height) < MIN_SIDE_PX:
        small = f"{width}×{height} is too small; each side needs at least {MIN_SIDE_PX} pixels"
        raise DecodeError("ingest.too-small", small)
    return image


def pixel_count(path: Path) -> int:
    """How many pixels a file says that it has; 0 for one that is rejected by its name or header."""
    try:
        with _open(path) as image:
            return image.width * image.height
    except DecodeError:
        return 0


def upright_size(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height by an image's header once it is upright, and the EXIF orientation undone for that. Raises
    DecodeError."""
    with _open(path) as image:
        if undone := _undone_orientation(image):
            return image.size, undone
        # In a PNG without EXIF before its pixels Pillow would decode these to look behind them.
        orientation = 1 if image.format == "PNG" and "exif" not in image.info else read_exif(image, [])[1]
        return turned_size(image.size, orientation), orientation


def _undone_orientation(image: Image.Image) -> int | None:
    """The EXIF orientation of an image that is turned upright as it is loaded, which forgets it. Of HEIC only that of
    one held sideways: every program shows HEIC upright, and of masks and cameras by others only the shape tells that.
    """
    if image.format == "TIFF":
        return read_exif(image, [])[1]
    original = image.info.get("original_orientation") if image.format == "HEIF" else None
    return original if original in (6, 8) else None


def _load(image: Image.Image) -> None:
    """Decode the pixels."""
    try:
        image.load()
    except MemoryError as error:
        raise DecodeError("ingest.file-exceeds-memory", "does not fit into memory") from error
    except OSError as error:
        raise _damaged(_what_is_missing(image, error)) from error
    except Exception as error:  # as in _open
        raise _damaged(f"damaged: {error}") from error


def _unrecognised(path: Path) -> DecodeError:
    with path.open("rb") as file:
        head = file.read(256)
    if not head:
        return DecodeError("ingest.empty-file", "the file is empty")
    if why := stand_in(head):
        return DecodeError("ingest.stand-in", why)
    if head.startswith((b"\xff\xd8", b"\x89PNG")):
        return _damaged("damaged: its header cannot be read")
    if head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
        return DecodeError(
            "ingest.kind-of-tiff", "a kind of TIFF that cannot be read; export 8- or 16-bit TIFF, PNG or JPEG"
        )
    is_text = all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head)
    why = "not an image: it is text" if is_text else "not an image of a known format"
    return DecodeError("ingest.not-an-image", why)


def _damaged(how: str) -> DecodeError:
    return DecodeError("ingest.damaged-file", how)


def _convert(image: Image.Image, stored_plainly: bool, lossy: bool, turned: int | None) -> Decoded:
    """The loaded image as upright sRGB; ``turned`` is the EXIF orientation where it has been undone already."""
    notes: list[str] = []
    tags, orientation = read_exif(image, notes)
    converted, is_srgb = _to_srgb(_to_eight_bit(image), image.info, notes)
    pixels = np.asarray(converted if turned else upright(converted, orientation))
    opaque = pixels.shape[2] == 4 and bool((pixels[..., 3] == 255).all())
    pixels = np.ascontiguousarray(pixels[..., :3] if opaque else pixels)
    focal_px, focal_source = focal_from_exif(tags, *image.size)
    if (frames := _frame_count(image)) > 1:
        notes.append(f"first of {frames} frames")
    copy = stored_plainly and is_srgb and orientation == 1 and not opaque
    return Decoded(
        pixels=pixels,
        focal_source=focal_source,
        camera_key=_camera_key(tags, pixels.shape[1], pixels.shape[0], turned or orientation, focal_px),
        gps=gps_from_exif(tags),
        exposure_ev=exposure_from_exif(tags),
        clock_s=clock_from_exif(tags),
        suffix=(".png" if image.format == "PNG" else ".jpg") if copy else None,
        stored="black and white" if is_black_and_white(pixels) else _stored(image.mode),
        lossy=lossy,
        panorama=panorama_kind(pixels, image.info.get("xmp"), tags.get("CustomRendered")),
        notes=tuple(notes),
    )


def _is_plain(image: Image.Image) -> bool:
    """Whether the file stores 8-bit RGB (or PNG RGBA) and nothing else. To be asked before its pixels are loaded."""
    if image.format in ("JPEG", "MPO"):  # the further frames of phones' MPO files are previews and gain maps
        return image.mode == "RGB"
    if image.format != "PNG" or getattr(image, "n_frames", 1) > 1 or "transparency" in image.info:
        return False
    return image.tile[0].args in ("RGB", "RGBA")  # pyright: ignore[reportAttributeAccessIssue]


def _stored(mode: str) -> Stored:
    if mode in _DEEP_GREY:
        return "deep grey"
    return "grey" if mode in ("1", "L", "LA") else "colour"


def is_black_and_white(pixels: np.ndarray) -> bool:
    """Whether (h, w, 3 or 4) uint8 has both black and white and next to nothing else, as masks do."""
    dark = bright = np.zeros(0, bool)
    for step in (16, 1):  # of most photos a few pixels tell
        darkest, brightest = colour_range(pixels[::step, ::step])
        dark, bright = brightest <= NEARLY, darkest >= 255 - NEARLY
        if (dark | bright).mean() < MIN_BLACK_AND_WHITE or (brightest - darkest > NEARLY).any():
            return False
    return bool(dark.any() and bright.any())


def _is_lossy(image: Image.Image, path: Path) -> bool:
    if image.format == "WEBP":
        with path.open("rb") as file:
            return file.read(16).endswith(b"VP8 ")
    return image.format in _LOSSY


def _frame_count(image: Image.Image) -> int:
    """How many pictures the file shows. Asked last: counting the pages of a damaged TIFF spoils the image object."""
    if image.format in ("MPO", "HEIF"):  # previews, depth and gain maps
        return 1
    try:
        return getattr(image, "n_frames", 1)
    except Exception:  # as in _open; the first page was read
        return 1


def _what_is_missing(image: Any, error: OSError) -> str:
    """Words for an image whose pixels end early; rows that were not decoded have stayed zero."""
    word = "truncated" if "truncated" in str(error) else "damaged"
    if image.format not in ("JPEG", "MPO", "PNG"):
        return f"{word}: {error}"
    image.tile = []  # what is there is all there is: do not try again
    try:
        rows = np.asarray(image).reshape(image.height, -1).any(axis=1)
    except OSError:  # the decoder refused before there were any pixels
        return f"{word}: {error}"
    missing = 1 - (np.flatnonzero(rows)[-1] + 1) / image.height if rows.any() else 1.0
    return f"{word}: {100 * missing:.0f}% of the image is missing" if missing >= 0.005 else f"{word}: {error}"


def _to_eight_bit(image: Image.Image) -> Image.Image:
    """``image`` in mode L, LA, RGB, RGBA or CMYK."""
    if image.mode in _DEEP_GREY:
        return _quantised(image)
    if image.has_transparency_data:
        return image if image.mode in ("LA", "RGBA") else image.convert("RGBA")
    if image.mode in ("L", "RGB", "CMYK"):
        return image
    try:
        return image.convert("L" if image.mode == "1" else "RGB")
    except ValueError as error:
        why = f"its pixel format {image.mode} is not supported; export JPEG, PNG or TIFF"
        raise DecodeError("ingest.pixel-format", why) from error


def _quantised(image: Image.Image) -> Image.Image:
    """Grey of 16 bits, or of floats in [0, 1], as 8 bits."""
    values = np.asarray(image)
    if wrong := int(values.size - np.isfinite(values).sum()):
        why = f"{wrong:,} of its {values.size:,} pixels are NaN or infinite"
        raise DecodeError("ingest.not-finite", why)
    limit = 1.0 if image.mode == "F" else 65535.0
    if not (values.min() >= 0 and values.max() <= limit):
        span = f"its pixel values run from {values.min()} to {values.max()}; export it with 8 or 16 bits"
        raise DecodeError("ingest.pixel-range", span)
    return pillow().fromarray(np.rint(values * (255 / limit)).astype(np.uint8))


def _to_srgb(image: Image.Image, info: Mapping[Any, Any], notes: list[str]) -> tuple[Image.Image, bool]:
    """``image`` as RGB or RGBA in sRGB, and whether its values already were sRGB, by what its file tells of colours: an
    ICC profile before HEIF's numbers. Of AVIF Pillow does not tell these."""
    mode, profile = "RGBA" if image.mode in ("LA", "RGBA") else "RGB", info.get("icc_profile")
    numbers: Mapping[str, int] = info.get("nclx_profile") or {}
    if not profile and (transfer := PHOTO_TRANSFERS.get(numbers.get("transfer_characteristics", 0))):
        notes.append(f"HDR ({transfer}): {TONE_MAPPED}")
        pixels = np.array(image.convert(mode))
        pixels[..., :3] = tone_mapped(pixels[..., :3], transfer, numbers["color_primaries"])
        return pillow().fromarray(pixels), False
    if not profile:
        return image.convert(mode), True
    source = image.convert("RGBA") if image.mode == "LA" else image
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB"), source.mode, mode
        )
        if source.mode == mode and _is_identity(transform, mode):
            return source, True
        converted = ImageCms.applyTransform(source, transform) or source  # None only for in-place work
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        notes.append(f"its colour profile is ignored ({error})")
        return image.convert(mode), False
    return converted, False


def _is_identity(transform: Any, mode: str) -> bool:
    levels = np.arange(0, 256, 15, dtype=np.uint8)
    cube = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(len(levels), -1, 3)
    before = Image.fromarray(cube).convert(mode)
    after = ImageCms.applyTransform(before, transform)
    return int(np.abs(np.asarray(before, int) - np.asarray(after, int)).max()) <= _SRGB_TOLERANCE


def _camera_key(tags: dict[str, Any], width: int, height: int, orientation: int, focal_px: float | None) -> CameraKey:
    make, model, lens = (str(tags.get(tag, "")).strip("\0 ") for tag in ("Make", "Model", "LensModel"))
    focal_mm, zoom = positive(tags.get("FocalLength")), digital_zoom(tags)
    return CameraKey(make, model, lens, width, height, orientation, focal_mm, focal_px, zoom)
