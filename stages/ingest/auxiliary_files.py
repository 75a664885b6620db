"""Files that are no photos but belong to one: masks, depth maps, normals, masked copies. Told by their names, and
depth maps by their values, too."""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

from stages.ingest.listing import IMAGES

# a_mask.png and a.depth_2.tif belong to a.jpg; mask/a.png and depth_maps/a.png to image/a.jpg, or to a.jpg beside them.
_ENDING = re.compile(r"(.+)[ ._-](masks?|masked|depth|depthmap|normals?|alpha|matte)([ ._-]?\d+)?", re.IGNORECASE)
_FOLDER = re.compile(r"(masks?|masked|depths?)(maps?)?($|[._-]|\d)|normals([._-]?maps?)?$", re.IGNORECASE)
# Folders of such names may be of photos, too: normal/ beside wide/ and tele/, label/ beside front/. But no map survives
# compression with losses, and few photos are stored without.
_PERHAPS = re.compile(
    r"normal([._-]?maps?)?$|(conf(idence)?|semantics?|segmentations?|instances?|labels?)([._-]?maps?)?($|[._-])",
    re.IGNORECASE,
)
# depth_5m/ beside depth_10m/ and surface/ are a diver's.
_UNDER_WATER = re.compile(r"depths?[._-]?\d+([.,]\d+)?[ ._-]?(m|met(er|re)s?|ft|feet)", re.IGNORECASE)
_COLOUR = re.compile(r"(.+)[ ._-](colou?r|rgb|image)", re.IGNORECASE)  # a.color.jpg beside a.depth.png
IGNORED = "dynamic_mask_"  # instant-ngp's masks, beside their photos, whose white is ignored
# One mask of what all photos show alike: a drone's leg, the rim of a fisheye.
ONE_FOR_ALL, ALL_PHOTOS = ("mask", "masks", "camera_mask", "global_mask"), "all photos"
_MARK = re.compile(r"[ ._-]masks?$|^masks?[ ._-]", re.IGNORECASE)
_MASK = re.compile(r"(.+[ ._-])?masks?([ ._-]?\d+)?", re.IGNORECASE)

# Of a depth map there is a photo, but for a few that were lost; of photos in grey there need not be any in colour.
_MIN_COLOURED = 0.9

Stored = Literal["colour", "grey", "deep grey", "black and white"]
"""How a file stores its values: "deep grey" in 16 bits or floats, "black and white" in nothing between."""
_Key = tuple[PurePosixPath, str]  # a folder, and what a photo in it is called


def auxiliary_files(names: Sequence[str]) -> dict[str, str]:
    """{file: the photo that it belongs to}, all named relative to the photo folder; or ALL_PHOTOS."""
    files = [PurePosixPath(name) for name in names]
    photos: dict[_Key, PurePosixPath] = {}
    for file in files:
        photos.setdefault((file.parent, _plain(file.stem)), file)
    beside: dict[PurePosixPath, list[PurePosixPath]] = {}
    for folder in sorted({folder for file in files for folder in file.parents if not _is_of_maps(folder, file)}):
        beside.setdefault(folder.parent, []).append(folder)
    found = {}
    for file in files:
        keys = _keys(file, beside)
        if photo := next((photos[key] for key in keys if photos.get(key, file) != file), None):
            found[str(file)] = str(photo)
        elif marks_ignored(file.name):  # of a photo that is not there
            found[str(file)] = file.stem.removeprefix(IGNORED)
    for_all = {str(file) for file in files if file.stem.lower() in ONE_FOR_ALL} - found.keys() - set(found.values())
    return found | dict.fromkeys(for_all if for_all < set(names) - found.keys() else (), ALL_PHOTOS)


def depth_maps(stored: Mapping[str, Stored]) -> set[str]:
    """Which files are depth maps by their values, whatever they are called: those in deep grey, where there are about
    as many in colour. ``stored`` is how each file stores its values, by its name."""
    deep = {name for name, kind in stored.items() if kind == "deep grey"}
    colour = sum(kind == "colour" for kind in stored.values())
    return deep if colour >= _MIN_COLOURED * len(deep) else set()


def masks_by_values(stored: Mapping[str, Stored]) -> set[str]:
    """Which files are masks by their values, whatever they are called: those in black and white among others."""
    found = {name for name, kind in stored.items() if kind == "black and white"}
    return found if len(found) < len(stored) else set()


def marks_ignored(name: str) -> bool:
    """Whether such a file is a mask of instant-ngp's, in which white, not black, is ignored."""
    return name.startswith(IGNORED)


def instant_ngp_masks(excluded: Mapping[str, str]) -> dict[str, str]:
    """Of files that belong to a photo those that are its mask of instant-ngp's, {photo: mask}."""
    return {photo: name for name, photo in excluded.items() if marks_ignored(PurePosixPath(name).name)}


def pair_masks(names: Sequence[str], masks: Sequence[tuple[str, Path]]) -> tuple[dict[str, Path], list[Path]]:
    """The mask file of each photo that has one, by the photo's name, and the files that are no photo's mask, each
    once though it may stand for several names.

    A photo's mask is called after it, with its ending or without, and ends as images do, in .png rather than in another
    way. Where no other mask is called so, its accents may be composed in another way, it may say that it is a mask, as
    a_mask.png, mask_a.png and dynamic_mask_a.png do, and its letters may be small or capital.
    """
    by_name: dict[str, Path] = {}
    composed: dict[str, set[Path]] = {}
    marked: dict[str, set[Path]] = {}
    folded: dict[str, set[Path]] = {}
    for name, file in sorted(masks, key=lambda mask: not mask[0].lower().endswith(".png")):
        of, ending = os.path.splitext(name)
        if ending.lower() in IMAGES:
            by_name.setdefault(of, file)
            composed.setdefault(unicodedata.normalize("NFC", of), set()).add(file)
            marked.setdefault(unicodedata.normalize("NFC", _unmarked(of)), set()).add(file)
            folded.setdefault(_folded(_unmarked(of)), set()).add(file)
    photos = Counter(spelling for name in names for spelling in {_folded(name), _folded(os.path.splitext(name)[0])})

    def mask_of(name: str) -> Path | None:
        key = unicodedata.normalize("NFC", name)
        alike = composed.get(key) or marked.get(key)
        if alike is None:
            alike = folded.get(_folded(name), set()) if photos[_folded(name)] == 1 else set()
        return by_name.get(name, next(iter(alike)) if len(alike) == 1 else None)

    found: dict[str, Path] = {}
    for name in names:
        inside = name.removeprefix("images/")  # beside an images/ folder that a transforms file names
        wanted = (name, os.path.splitext(name)[0], inside, os.path.splitext(inside)[0])
        if file := next(filter(None, map(mask_of, wanted)), None):
            found[name] = file
    used = set(found.values())
    return found, list(dict.fromkeys(file for _, file in masks if file not in used))


def _unmarked(name: str) -> str:
    """A mask's name without what says that it is one."""
    folder, _, last = name.rpartition("/")
    return f"{folder}/{_MARK.sub('', last.removeprefix(IGNORED))}".removeprefix("/")


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def is_mask(name: str) -> bool:
    """Whether such a file is by its name a mask, rather than a depth map, say, or a masked copy."""
    file = PurePosixPath(name)
    return any(_MASK.fullmatch(part) for part in (*file.parts[:-1], file.stem))


def _is_of_maps(folder: PurePosixPath, file: PurePosixPath) -> bool:
    """Whether a folder is by its name one of maps, as far as a file in it can tell."""
    if _is_jpeg(file) and (_PERHAPS.match(folder.name) or _UNDER_WATER.fullmatch(folder.name)):
        return False
    return bool(_FOLDER.match(folder.name) or _PERHAPS.match(folder.name))


def _is_jpeg(file: PurePosixPath) -> bool:
    return file.suffix.lower() in (".jpg", ".jpeg", ".heic", ".heif")


def _keys(file: PurePosixPath, beside: Mapping[PurePosixPath, Sequence[PurePosixPath]]) -> Iterator[_Key]:
    """Where the photo may lie that a file belongs to. ``beside``: the folders of photos in each folder."""
    if marks_ignored(file.name):
        yield file.parent, _plain(file.stem.removeprefix(IGNORED))
    ending = _ENDING.fullmatch(file.stem)
    if ending and ending[2].lower() == "normal" and _is_jpeg(file):
        ending = None
    stems = [_plain(_without_image_ending(ending[1]))] if ending else []  # a.jpg.mask.png is one of a.jpg, too
    yield from ((file.parent, stem) for stem in stems)
    stems.append(_plain(file.stem))
    for holder in file.parents:
        if _is_of_maps(holder, file):
            inside = file.parent.relative_to(holder)
            folders = (*beside.get(holder.parent, ()), holder.parent)
            yield from ((folder / inside, stem) for folder in folders for stem in stems)


def _without_image_ending(name: str) -> str:
    stem, ending = os.path.splitext(name)
    return stem if ending.lower() in IMAGES else name


def _plain(stem: str) -> str:
    """A name without what says that it is the photo; a number without leading zeros, which a mask's has fewer of in
    some sets."""
    colour = _COLOUR.fullmatch(stem)
    stem = colour[1] if colour else stem
    return stem.lstrip("0") or "0" if stem.isdecimal() else stem
