"""Which photo is meant by the name that a COLMAP model has for an image."""

import os
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import takewhile
from pathlib import PurePosixPath
from urllib.parse import unquote

from stages.ingest.listing import IMAGES, RAW_EXTENSIONS
from stages.io.photos import Photo


def photos_by_name(names: Sequence[str], photos: Sequence[Photo]) -> dict[int, Photo]:
    """Photo by index of its image: of the same name, else of the name that ingest gave it, else of a name whose
    accents are composed in another way, else of the name that it is as a URL, else of the same name below a folder that
    all have, else of the same end, else of the same name but for its ending, else but for small and capital letters,
    else but for these and a folder that all have."""
    found: dict[int, Photo] = {}
    taken: set[str] = set()
    by_own, by_given = {photo.name: photo for photo in photos}, {photo.image_name: photo for photo in photos}
    candidates = (
        by_own,
        by_given,
        _by_key(names, photos, _composed),
        _by_url(names, photos),
        _by_folder(names, photos, _composed),
        _by_end(names, photos),
    )
    keys = (_without_image_ending, _without_ending, _without_case)
    spelt_otherwise = (find(names, photos, key) for find in (_by_key, _by_folder) for key in keys)
    for photo_of in (*candidates, *spelt_otherwise):
        for index, name in enumerate(names):
            photo = photo_of.get(name)
            if photo is not None and index not in found and photo.name not in taken:
                found[index] = photo
                taken.add(photo.name)
    return found


def _by_folder(names: Sequence[str], photos: Sequence[Photo], key: Callable[[str], str]) -> dict[str, Photo]:
    """Photo by name of its image where all images, or else all photos, lie in a folder more: ``images/left/0.jpg`` is
    ``left/0.jpg``. Of several such folders as few as have a match are left out. Names are compared by their keys."""
    own = [photo.name for photo in photos]
    of_images = ((_without_folders(names, count), own) for count in range(1, _shared_folders(names) + 1))
    of_photos = ((names, _without_folders(own, count)) for count in range(1, _shared_folders(own) + 1))
    found = (_by_keys(names, map(key, images), photos, map(key, called)) for images, called in (*of_images, *of_photos))
    return next(filter(None, found), {})


def _shared_folders(names: Sequence[str]) -> int:
    """How many folders all the names begin with."""
    folders = (PurePosixPath(_composed(name)).parent.parts for name in names)
    return len(list(takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False))))


def _without_folders(names: Sequence[str], count: int) -> list[str]:
    return [str(PurePosixPath(*PurePosixPath(name).parts[count:])) for name in names]


def _by_end(names: Sequence[str], photos: Sequence[Photo]) -> dict[str, Photo]:
    """Photo by name of its image where one is called ``0.jpg``, say, and the other ``left/0.jpg``, and no other image
    or photo is called ``0.jpg`` in any folder."""
    by_last: dict[str, list[Photo]] = {}
    for photo in photos:
        by_last.setdefault(_last(photo.name), []).append(photo)
    images = Counter(map(_last, names))
    found: dict[str, Photo] = {}
    for name in names:
        last = _last(name)
        same = by_last.get(last, [])
        if images[last] == len(same) == 1:
            image, photo = f"/{_composed(name)}", f"/{_composed(same[0].name)}"
            if image.endswith(photo) or photo.endswith(image):
                found[name] = same[0]
    return found


def _by_key(names: Sequence[str], photos: Sequence[Photo], key: Callable[[str], str]) -> dict[str, Photo]:
    """Photo by name of its image where both names have the same key, and no other image or photo has it."""
    return _by_keys(names, map(key, names), photos, (key(photo.name) for photo in photos))


def _by_keys(
    names: Sequence[str], of_images: Iterable[str], photos: Sequence[Photo], of_photos: Iterable[str]
) -> dict[str, Photo]:
    """The same for the key of each image and photo."""
    image_keys, photo_keys = dict(zip(names, of_images, strict=True)), list(of_photos)
    images, own = Counter(image_keys.values()), Counter(photo_keys)
    by_key = {key: photo for key, photo in zip(photo_keys, photos, strict=True) if own[key] == 1}
    return {name: by_key[key] for name, key in image_keys.items() if images[key] == 1 and key in by_key}


def _by_url(names: Sequence[str], photos: Sequence[Photo]) -> dict[str, Photo]:
    """Photo by name of its image where that writes %20 for a space, say, and the last of its folders may be others."""
    decoded = [unquote(name) for name in names]
    found = _by_end(decoded, photos)
    return {name: found[path] for name, path in zip(names, decoded, strict=True) if path != name and path in found}


def other_spelling(name: str, photo: Photo) -> str | None:
    """A photo and its image in words, where their names differ by more than folders and accents."""
    same = name == photo.image_name or _last(name) == _last(photo.name)
    return None if same else f"{photo.name} ({name})"


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _last(name: str) -> str:
    return PurePosixPath(_composed(name)).name


def _without_image_ending(name: str) -> str:
    """The name itself where it ends as no image does: IMG.2020.v1 of IMG.2020.v1.jpg."""
    stem, ending = os.path.splitext(_composed(name))
    return stem if ending.lower() in IMAGES + RAW_EXTENSIONS else stem + ending


def _without_ending(name: str) -> str:
    return os.path.splitext(_composed(name))[0]


def _without_case(name: str) -> str:
    return _composed(name).casefold()
