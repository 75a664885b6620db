"""Stage ingest: every photo decoded once, upright, 8-bit sRGB, under an ASCII name; what is unusable named.

A file that already is plain (8-bit RGB or RGBA, sRGB, upright JPEG or PNG) is copied byte for byte; everything
else is written as PNG. Each photo is decoded by one worker and dropped again, so memory holds one per worker.
"""

import hashlib
import os
import re
import shutil
import unicodedata
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stages.contract import Inputs, OptionalSourcePath, Progress, SourcePath, StageConfig, StageError, StageResult
from stages.decoding import CameraKey, DecodeError, decode
from stages.files import write_png
from stages.photos import Photo, Refusal, write_photos
from stages.sources import Source, find_source

if TYPE_CHECKING:
    import numpy as np

NEEDS: tuple[str, ...] = ()
VERSION = 2
RESUMES = False
LINKS = ("photos.json", "images")

_MAX_WORKERS = 8  # each holds a few copies of one photo, up to 250 megapixels
_MAX_NOTES = 10
_SHARPNESS_WIDTH = 1000
# Folders without dots, so that no folder can have the name of a file; no leading dash or dot anywhere.
_SAFE_NAME = re.compile(r"(?:\w[\w-]*/)*\w[\w.-]*", re.ASCII)
_OWN_SUFFIXES = {".jpg": (".jpg", ".jpeg"), ".png": (".png",)}


class Config(StageConfig):
    """Where the photos are."""

    photos: SourcePath = Path()
    """A folder of photos, a transforms.json, or a folder with transforms_train.json."""
    cameras: OptionalSourcePath = None
    """Known cameras for a folder of photos: a transforms file or a COLMAP model."""


@dataclass(frozen=True)
class _Taken:
    """One decoded photo, its pixels waiting in ``waiting`` for their final name."""

    name: str
    waiting: Path
    suffix: str  # of the stored file
    camera_key: CameraKey
    focal_source: str | None
    has_alpha: bool
    sharpness: float
    digest: bytes  # of size and pixels
    notes: tuple[str, ...]


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Decode the photos of ``config`` into ``folder``. Raises StageError if fewer than two can be used."""
    source = find_source(config.photos, config.cameras)
    with _writing(folder):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        waiting = folder / "waiting"
        waiting.mkdir(exist_ok=True)
        outcomes = _decode_all(source, waiting, progress)
        taken = [outcome for outcome in outcomes if isinstance(outcome, _Taken)]
        refused = [outcome for outcome in outcomes if isinstance(outcome, Refusal)]
        if source.kind == "photos":
            taken, duplicates = _without_duplicates(taken)
            refused = sorted(refused + duplicates, key=lambda refusal: refusal.name)
        _say([f"refused {_shown(r.name)}: {r.reason}" for r in refused], progress)
        _say([f"{_shown(t.name)}: {note}" for t in taken for note in t.notes], progress)
        if len(taken) < 2:
            raise _too_few(source, taken, refused)
        photos = _store(taken, folder)
        shutil.rmtree(waiting)
        write_photos(folder, photos, refused, source.frames)
    return StageResult(
        outputs=("images", "photos.json"), line=_line(source, photos, refused), facts=_facts(source, photos, refused)
    )


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StageError(
            f"cannot write the photos to {folder}",
            error.strerror or str(error),
            "Make room there, or choose another workspace with -o.",
        ) from error


def _decode_all(source: Source, waiting: Path, progress: Progress) -> list[_Taken | Refusal]:
    """The outcome of every file, in the order of ``source.files`` whatever order they finish in."""
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_WORKERS))
    try:
        futures: list[Future[_Taken | Refusal]] = [
            pool.submit(_take, file, source.name(file), waiting / f"{index:06d}")
            for index, file in enumerate(source.files)
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


def _take(file: Path, name: str, waiting: Path) -> _Taken | Refusal:
    """Decode one file and leave its pixels in ``waiting``. Raises OSError only where writing fails."""
    try:
        decoded = decode(file)
    except DecodeError as error:
        return Refusal(name, str(error))
    pixels = decoded.pixels
    if decoded.suffix:
        shutil.copyfile(file, waiting)
    else:
        write_png(waiting, pixels)
    return _Taken(
        name=name,
        waiting=waiting,
        suffix=decoded.suffix or ".png",
        camera_key=decoded.camera_key,
        focal_source=decoded.focal_source,
        has_alpha=pixels.shape[2] == 4 and bool((pixels[..., 3] < 255).any()),
        sharpness=_sharpness(pixels),
        digest=hashlib.blake2b(str(pixels.shape).encode() + pixels.data, digest_size=16).digest(),
        notes=decoded.notes,
    )


def _sharpness(pixels: "np.ndarray") -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000) of the grey image, at most 1000 pixels wide."""
    import cv2
    import numpy as np

    grey = cv2.cvtColor(pixels[..., :3], cv2.COLOR_RGB2GRAY)
    if pixels.shape[2] == 4:  # what is transparent has no sharpness
        grey = np.rint(grey * (pixels[..., 3] / 255.0)).astype(np.uint8)
    height, width = grey.shape
    if width > _SHARPNESS_WIDTH:
        size = (_SHARPNESS_WIDTH, max(1, round(height * _SHARPNESS_WIDTH / width)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(f"{cv2.Laplacian(grey, cv2.CV_64F).var():.4g}")


def _without_duplicates(taken: Sequence[_Taken]) -> tuple[list[_Taken], list[Refusal]]:
    """The photos with different pixels, the first of each kept, and refusals for the rest."""
    first: dict[bytes, _Taken] = {}
    for photo in taken:
        first.setdefault(photo.digest, photo)
    kept = [photo for photo in taken if first[photo.digest] is photo]
    repeated = [photo for photo in taken if first[photo.digest] is not photo]
    return kept, [Refusal(photo.name, f"identical to {_shown(first[photo.digest].name)}") for photo in repeated]


def _store(taken: Sequence[_Taken], folder: Path) -> list[Photo]:
    """Move the decoded photos to their final names and describe them."""
    files = ascii_files([(photo.name, photo.suffix) for photo in taken])
    groups = {key: index for index, key in enumerate(dict.fromkeys(photo.camera_key for photo in taken))}
    photos: list[Photo] = []
    for photo, file in zip(taken, files, strict=True):
        target = folder / "images" / file
        target.parent.mkdir(parents=True, exist_ok=True)
        photo.waiting.replace(target)
        photos.append(
            Photo(
                name=photo.name,
                file=f"images/{file}",
                width=photo.camera_key.width,
                height=photo.camera_key.height,
                camera_group=groups[photo.camera_key],
                focal_px=photo.camera_key.focal_px,
                focal_source=photo.focal_source,
                has_alpha=photo.has_alpha,
                sharpness=photo.sharpness,
            )
        )
    return photos


def ascii_files(names: Sequence[tuple[str, str]]) -> list[str]:
    """A file name of letters, digits and ``-_./`` for each (photo name, suffix of the stored file).

    A name that is safe already is kept. Others are transliterated and end in a hash of the name. No two differ
    only in case or in their suffix, so that anything made of one photo can be called after its stem.
    """
    wanted = [_safe_file(name, suffix) for name, suffix in names]
    order = sorted(range(len(names)), key=lambda index: (wanted[index] != names[index][0], index))
    files, stems = [""] * len(names), set[str]()
    for index in order:
        stem, suffix = os.path.splitext(wanted[index])
        salt = 0
        while (candidate := stem if salt == 0 else f"{stem}-{_hash(names[index][0], salt)}").lower() in stems:
            salt += 1
        stems.add(candidate.lower())
        files[index] = candidate + suffix
    return files


def _safe_file(name: str, suffix: str) -> str:
    stem, own_suffix = os.path.splitext(name)
    suffix = own_suffix if own_suffix.lower() in _OWN_SUFFIXES[suffix] else suffix
    if _SAFE_NAME.fullmatch(name) and len(name) <= 150:
        return stem + suffix
    plain = unicodedata.normalize("NFKD", stem).encode("ascii", "ignore").decode()
    parts = [re.sub(r"[^\w-]+", "_", part).lstrip("-")[:40] or "_" for part in plain.split("/")[-3:]]
    return f"{'/'.join(parts)}-{_hash(name, 0)}{suffix}"


def _hash(name: str, salt: int) -> str:
    return hashlib.sha256(f"{salt}/{name}".encode()).hexdigest()[:8]


def _shown(name: str) -> str:
    """A name as it may be printed: nothing in it can steer a terminal."""
    return name if name.isprintable() else repr(name)


def _say(notes: Sequence[str], progress: Progress) -> None:
    for note in notes[:_MAX_NOTES]:
        progress.note(note)
    if len(notes) > _MAX_NOTES:
        progress.note(f"… and {len(notes) - _MAX_NOTES} more, all in photos.json")


def _too_few(source: Source, taken: Sequence[_Taken], refused: Sequence[Refusal]) -> StageError:
    hint = "Take 20 to 100 overlapping photos of one scene from different places and put them into one folder."
    if not taken:
        first = f"{_shown(refused[0].name)}: {refused[0].reason}"
        return StageError(f"none of the {len(refused)} files in {source.root} is a usable photo", first, hint)
    only = _shown(taken[0].name)
    if refused and all(refusal.reason.startswith("identical to ") for refusal in refused):
        return StageError(f"all {len(refused) + 1} photos are identical", f"they have the pixels of {only}", hint)
    if refused:
        return StageError(f"only one photo can be used, {only}", f"{len(refused)} other files were refused", hint)
    return StageError("there is only one photo", f"{only}; a scene needs at least two", hint)


def _line(source: Source, photos: Sequence[Photo], refused: Sequence[Refusal]) -> str:
    sizes = sorted({(photo.width, photo.height) for photo in photos})
    size = "{}×{}".format(*sizes[0]) if len(sizes) == 1 else f"in {len(sizes)} sizes"
    alpha = " with alpha" if any(photo.has_alpha for photo in photos) else ""
    line = f"{len(photos)} photos {size}{alpha}, {_camera_words(source, photos)}"
    return f"{line}, {len(refused)} refused" if refused else line


def _camera_words(source: Source, photos: Sequence[Photo]) -> str:
    if source.kind != "photos":
        return "cameras given"
    groups = len({photo.camera_group for photo in photos})
    cameras = "one camera" if groups == 1 else f"{groups} cameras"
    known = [photo.focal_px for photo in photos if photo.focal_px is not None]
    if not known:
        return f"{cameras}, no EXIF focal"
    if len(known) < len(photos):
        return f"{cameras}, EXIF focal for {len(known)}"
    return f"{cameras}, EXIF focal" + (f" {known[0]:.0f} px" if len(set(known)) == 1 else "")


def _facts(source: Source, photos: Sequence[Photo], refused: Sequence[Refusal]) -> dict[str, object]:
    return {
        "source": source.kind,
        "photos": len(photos),
        "refused": [{"name": refusal.name, "reason": refusal.reason} for refusal in refused],
        "sizes": sorted([photo.width, photo.height] for photo in {(p.width, p.height): p for p in photos}.values()),
        "cameras": len({photo.camera_group for photo in photos}),
        "focal_known": sum(photo.focal_px is not None for photo in photos),
    }
