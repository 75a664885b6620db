"""The photos of a source decoded, compared with each other and stored as photos.json describes them.

A file that already is plain (8-bit RGB or RGBA, sRGB, upright JPEG or PNG) is copied byte for byte; everything else is
written anew: as JPEG of high quality where the file was compressed with losses and has no alpha, otherwise as PNG. Each
photo is decoded by one worker and dropped again, so memory holds one per worker, and of each photo a thumbnail, and one
of its mask. The frames that are taken from a video are written as JPEG.
"""

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from stages.contract import Note, Progress, StageError, shown
from stages.hardware.device import processors
from stages.hardware.memory import at_once, check_memory
from stages.ingest import messages
from stages.ingest.auxiliary_files import Stored, depth_maps, masks_by_values, pair_masks
from stages.ingest.decoding import CameraKey, DecodeError, decode, pixel_count
from stages.ingest.exif import GpsPosition
from stages.ingest.masks import are_of_stored_pixels, read_mask
from stages.ingest.near_duplicates import Exposure, exposure, near_duplicates, small, thumbnail, well_exposed
from stages.ingest.panoramas import Panorama, cutting_advice
from stages.ingest.sharpness import one_colour, relative_sharpness, sharpness
from stages.ingest.sources import Source
from stages.ingest.video.frames import take_frames
from stages.io.ascii_names import ascii_files
from stages.io.files import write_jpeg, write_png
from stages.io.photos import Box, Photo, Rejection
from stages.io.pixels import OPAQUE_FROM, opaque_box

_MAX_WORKERS = 8  # each holds a few copies of one photo, up to 250 megapixels
_BYTES_PER_PIXEL = 24  # of a photo while it is decoded, turned, packed and looked at; 22 measured for 16 bits
# 46 to 51 dB from the pixels, in a third of a PNG's bytes (fox, fern, sceaux_castle, banana, fountain_p11): far closer
# than the file, at 90 or so, is to what the camera saw.
_JPEG_QUALITY = 97
_UNMEASURED = Exposure(0.0, 1.0)
_NO_POSITION = GpsPosition()
# Of the pixels, that have to be more transparent than opaque in a photo with alpha. Fewer are scratches: where they are
# wrong by half of all that a value can be, they cost what is 0.3 dB at 30 dB (nerf/effects/statistics/statistic.py).
_MIN_TRANSPARENT = 3e-4


@dataclass(frozen=True)
class _TakenMask:
    """A mask that waits in ``waiting``, the share of pixels that it ignores, itself made as small as the photo's
    thumbnail, and what became of it to make it fit (stages/ingest/masks.py: Mask)."""

    waiting: Path
    ignored: float
    thumbnail: np.ndarray
    turned: bool
    resized: bool
    ambiguous: bool
    grey: bool


@dataclass(frozen=True)
class _Taken:
    """One decoded photo, its pixels waiting in ``waiting`` for their final name."""

    name: str
    waiting: Path
    suffix: str  # of the stored file
    camera_key: CameraKey
    sharpness: float
    stored: Stored = "colour"
    focal_source: str | None = None
    opaque_share: float | None = None  # that a mask beside ``waiting`` leaves; None without alpha
    one_colour: str | None = None
    brightest: int = 255  # of all channels
    exposure: Exposure = _UNMEASURED
    gps: GpsPosition = _NO_POSITION
    exposure_ev: float | None = None
    clock_s: float | None = None
    time_s: float | None = None
    mask: _TakenMask | None = None
    digest: bytes = b""  # of size and pixels
    thumbnail: np.ndarray | None = None
    opaque: Box | None = None
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> tuple[CameraKey, str]:
        """Photos of equal ``camera`` share intrinsics, turned with them. Where EXIF does not say which camera it was,
        the folder is all that tells."""
        known = self.camera_key.make or self.camera_key.model or self.camera_key.lens
        return self.camera_key.sensor(), "" if known else str(Path(self.name).parent)


class Converted(NamedTuple):
    """The decoded photos in order, the files rejected, which photos are near duplicates of which, and notes."""

    taken: list[_Taken]
    rejected: list[Rejection]
    duplicate_of: dict[str, str]
    notes: list[Note]


def convert(source: Source, max_frames: int, folder: Path, progress: Progress) -> Converted:
    """Decode every file of ``source``, the pixels left below ``folder``. Raises StageError where they give no scene."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    waiting = folder / "waiting"
    waiting.mkdir(exist_ok=True)
    taken, rejected, notes = _take_all(source, max_frames, waiting, progress)
    if source.kind == "photos":
        kinds: dict[str, Stored] = {photo.name: photo.stored for photo in taken}
        deep, masks = depth_maps(kinds), masks_by_values(kinds)
        taken = [photo for photo in taken if photo.name not in deep | masks]
        notes += messages.excluded_by_values(sorted(deep)) + messages.excluded_masks(sorted(masks))
        taken, duplicates = _without_duplicates(taken)
        rejected = sorted(rejected + duplicates, key=lambda rejection: rejection.name)
    notes += [Note("ingest.assumed", f"{shown(t.name)}: {assumed}") for t in taken for assumed in t.notes]
    notes += messages.nearly_black([photo.brightest for photo in taken])
    try:
        duplicate_of = _checked(source, taken, rejected, progress)
    except StageError:
        messages.note_everything(rejected, notes, progress)
        raise
    return Converted(taken, rejected, duplicate_of, notes)


def note_findings(photos: Sequence[Photo], converted: Converted, progress: Progress) -> None:
    """Note near duplicates, blur and masks."""
    messages.note_findings(photos, progress)
    masks = [photo.mask for photo in converted.taken if photo.mask]
    turned, resized = sum(mask.turned for mask in masks), sum(mask.resized for mask in masks)
    messages.note_masks([mask.ignored for mask in masks], turned, resized, len(photos), progress)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StageError(
            "ingest.cannot-write",
            f"cannot write the photos to {folder}",
            error.strerror or str(error),
            "Make room there, or choose another workspace with -o.",
        ) from error


def _take_all(
    source: Source, max_frames: int, waiting: Path, progress: Progress
) -> tuple[list[_Taken], list[Rejection], list[Note]]:
    """What is taken, what is rejected, and notes on masks that belong to no photo."""
    if source.kind == "video":
        return _take_video(source.files[0], max_frames, waiting, progress), [], []
    masks, strays = pair_masks([source.name(file) for file in source.files], source.masks)
    notes = messages.excluded(source.excluded)
    notes += messages.stray_masks([f"{file.parent.name}/{file.name}" for file in strays])
    stored = are_of_stored_pixels((file, masks[name]) for file in source.files if (name := source.name(file)) in masks)
    outcomes = _decode_all(source, masks, bool(stored), waiting, progress)
    taken = [outcome for outcome in outcomes if isinstance(outcome, _Taken)]
    if not any(photo.mask and photo.mask.ignored for photo in taken):  # masks that are all white say nothing
        taken = [replace(photo, mask=None) for photo in taken]
    if stored is None:
        notes += messages.taken_as_upright([photo.name for photo in taken if photo.mask and photo.mask.ambiguous])
    notes += messages.grey_masks([photo.name for photo in taken if photo.mask and photo.mask.grey])
    return taken, [outcome for outcome in outcomes if isinstance(outcome, Rejection)], notes


def _take_video(video: Path, max_frames: int, waiting: Path, progress: Progress) -> list[_Taken]:
    return [
        _Taken(
            name=f"frame_{frame.number:06d}.jpg",
            waiting=frame.file,
            suffix=".jpg",
            camera_key=CameraKey("", "", "", frame.width, frame.height, 1, None, None),
            sharpness=frame.sharpness,
            time_s=frame.time_s,
        )
        for frame in take_frames(video, max_frames, waiting, progress)
    ]


def _decode_all(
    source: Source, masks: Mapping[str, Path], stored: bool, waiting: Path, progress: Progress
) -> list[_Taken | Rejection]:
    """The outcome of every file, in the order of ``source.files`` whatever order they finish in. ``stored`` is as
    :func:`read_mask` has it."""
    pool = ThreadPoolExecutor(_workers(source.files))
    names = [source.name(file) for file in source.files]
    try:
        futures: list[Future[_Taken | Rejection]] = [
            pool.submit(_take, file, name, masks.get(name), stored, waiting / f"{index:06d}")
            for index, (file, name) in enumerate(zip(source.files, names, strict=True))
        ]
        pending = set(futures)
        while pending:
            finished, pending = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
            count = len(futures) - len(pending)
            progress.update(f"decoded {count} of {len(futures)} photos", count / len(futures))
            for future in finished:
                future.result()
    finally:
        pool.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


def _workers(files: Sequence[Path]) -> int:
    """How many photos to decode at a time: one per core, fewer where memory is short of that many of the largest."""
    largest, name = max(((pixel_count(file), file.name) for file in files), default=(0, ""))
    needed = _BYTES_PER_PIXEL * max(1, largest)
    why = f"decoding {shown(name)}, which has {largest / 1e6:.0f} megapixels, takes"
    check_memory(needed, "the photos", why, "Close other programs, make that photo smaller, or leave it out.")
    return at_once(min(processors(), _MAX_WORKERS), needed)


def _take(file: Path, name: str, mask: Path | None, stored: bool, waiting: Path) -> _Taken | Rejection:
    """Decode one file and leave its pixels in ``waiting``. Raises OSError only where writing fails."""
    try:
        decoded = decode(file)
        if decoded.panorama:
            raise _no_photo(decoded.panorama)
        taken_mask = mask and _take_mask(mask, decoded.camera_key, stored, waiting.with_suffix(".mask"))
    except DecodeError as error:
        return Rejection(name, error.code, error.reason)
    pixels = decoded.pixels
    lossy = decoded.lossy and pixels.shape[2] == 3
    if decoded.suffix:
        shutil.copyfile(file, waiting)
    elif lossy:
        write_jpeg(waiting, pixels, _JPEG_QUALITY)
    else:
        write_png(waiting, pixels)
    return _Taken(
        name=name,
        waiting=waiting,
        suffix=decoded.suffix or (".jpg" if lossy else ".png"),
        camera_key=decoded.camera_key,
        sharpness=sharpness(pixels),
        stored=decoded.stored,
        focal_source=decoded.focal_source,
        opaque_share=_take_opaque(pixels, taken_mask, waiting),
        one_colour=one_colour(pixels),
        brightest=int(pixels[..., :3].max()),
        exposure=exposure(pixels),
        gps=decoded.gps,
        exposure_ev=decoded.exposure_ev,
        clock_s=decoded.clock_s,
        mask=taken_mask,
        digest=hashlib.blake2b(str(pixels.shape).encode() + pixels.data, digest_size=16).digest(),
        thumbnail=thumbnail(pixels, taken_mask.thumbnail if taken_mask else None),
        opaque=opaque_box(pixels),
        notes=decoded.notes,
    )


def _no_photo(kind: Panorama) -> DecodeError:
    if kind == "swept":  # in no projection that a file tells, and from one place only
        why = "a panorama of one sweep: take single photos from several places instead"
        return DecodeError("ingest.swept-panorama", why)
    advice = cutting_advice("PHOTO", "0.jpg", kind)
    if kind == "dual fisheye":
        return DecodeError("ingest.dual-fisheye", f"two fisheye pictures side by side: {advice}")
    return DecodeError("ingest.panorama", f"a panorama: {advice}")


def _take_mask(file: Path, photo: CameraKey, stored: bool, waiting: Path) -> _TakenMask:
    """The mask, left in ``waiting``. Raises DecodeError where it cannot be used."""
    mask = read_mask(file, photo.width, photo.height, photo.orientation, stored)
    ignored = float((mask.pixels == 0).mean())
    write_png(waiting, mask.pixels)
    return _TakenMask(waiting, ignored, small(mask.pixels), mask.turned, mask.resized, mask.ambiguous, mask.grey)


def _take_opaque(pixels: np.ndarray, mask: _TakenMask | None, waiting: Path) -> float | None:
    """The share of the pixels of a photo with alpha that are more opaque than transparent and that its mask leaves; a
    mask of these is left beside it. None without alpha."""
    opaque = pixels[..., 3] >= OPAQUE_FROM if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], bool)
    if 1 - opaque.mean() < _MIN_TRANSPARENT:
        return None
    if mask:
        with Image.open(mask.waiting) as picture:
            opaque &= np.asarray(picture) > 0
    write_png(waiting.with_suffix(".opaque"), np.where(opaque, np.uint8(255), np.uint8(0)))
    return float(opaque.mean())


def _without_duplicates(taken: Sequence[_Taken]) -> tuple[list[_Taken], list[Rejection]]:
    """The photos with different pixels, the first of each kept, and rejections for the rest."""
    first: dict[bytes, _Taken] = {}
    for photo in taken:
        first.setdefault(photo.digest, photo)
    kept = [photo for photo in taken if first[photo.digest] is photo]
    repeated = [photo for photo in taken if first[photo.digest] is not photo]
    return kept, [Rejection(photo.name, *messages.identical(first[photo.digest].name)) for photo in repeated]


def _checked(
    source: Source, taken: Sequence[_Taken], rejected: Sequence[Rejection], progress: Progress
) -> dict[str, str]:
    """Which photos are nearly the same (:func:`_near_duplicates`). Raises StageError where there is no scene in
    them."""
    if len(taken) < 2:
        raise messages.too_few(source, [photo.name for photo in taken], rejected)
    if all(photo.one_colour for photo in taken):
        raise messages.all_plain([(photo.name, photo.one_colour) for photo in taken if photo.one_colour])
    if source.kind != "photos":
        return {}
    progress.update("looking for near-duplicates")
    return _near_duplicates(taken, progress)


def _near_duplicates(taken: Sequence[_Taken], progress: Progress) -> dict[str, str]:
    """{photo that is left out of matching: the one it is nearly the same picture as}, by name. Raises StageError where
    one picture is all there is."""
    thumbnails = [photo.thumbnail for photo in taken if photo.thumbnail is not None]
    pixels = [photo.camera_key.width * photo.camera_key.height for photo in taken]
    same = near_duplicates(thumbnails, [photo.sharpness for photo in taken], pixels)
    if len(same) == len(taken) - 1:
        raise messages.all_the_same(len(taken))
    same, brackets = well_exposed(same, [photo.exposure for photo in taken], pixels)
    if brackets:
        progress.note("ingest.brackets", messages.bracketed(brackets))
    return {taken[index].name: taken[kept].name for index, kept in sorted(same.items())}


def store(converted: Converted, folder: Path) -> list[Photo]:
    """Move the decoded photos and masks to their final names and describe them."""
    taken = converted.taken
    files = ascii_files([(photo.name, photo.suffix) for photo in taken])
    index_of = {camera: index for index, camera in enumerate(dict.fromkeys(photo.camera for photo in taken))}
    groups = [index_of[photo.camera] for photo in taken]
    alike = [(group, photo.camera_key.width) for group, photo in zip(groups, taken, strict=True)]
    relative = relative_sharpness([photo.sharpness for photo in taken], alike)
    photos: list[Photo] = []
    for index, (photo, file) in enumerate(zip(taken, files, strict=True)):
        _move(photo.waiting, folder / "images" / file)
        if photo.mask:
            _move(photo.mask.waiting, folder / "masks" / f"{file}.png")
        has_alpha = photo.opaque_share is not None
        if has_alpha:
            _move(photo.waiting.with_suffix(".opaque"), folder / "opaque" / f"{file}.png")
        photos.append(
            Photo(
                name=photo.name,
                file=f"images/{file}",
                width=photo.camera_key.width,
                height=photo.camera_key.height,
                camera_group=groups[index],
                focal_px=photo.camera_key.focal_px,
                focal_source=photo.focal_source,
                has_alpha=has_alpha,
                opaque=photo.opaque,
                opaque_mask=f"opaque/{file}.png" if has_alpha else None,
                opaque_share=1.0 if photo.opaque_share is None else photo.opaque_share,
                used_share=1 - photo.mask.ignored if photo.mask else 1.0,
                sharpness=photo.sharpness,
                relative_sharpness=relative[index],
                mask=f"masks/{file}.png" if photo.mask else None,
                near_duplicate_of=converted.duplicate_of.get(photo.name),
                time_s=photo.time_s,
                **photo.gps._asdict(),
                exposure_ev=photo.exposure_ev,
                clock_s=photo.clock_s,
                orientation=photo.camera_key.orientation,
            )
        )
    shutil.rmtree(folder / "waiting")
    return photos


def _move(waiting: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    waiting.replace(target)
