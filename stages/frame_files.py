"""The photos and masks that a transforms file names: where they lie, and how their names may be spelt there."""

import os
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Any

from stages.contract import StageError
from stages.listing import IMAGES
from stages.transforms_files import MOST_LETTERS, photo_names

_EXTENSIONS_TRIED = ("", ".png", ".jpg", ".jpeg")

# A name but for its ending, and the ending in small letters, None of an image, which may be called without.
_Spelling = tuple[str, str | None]


@dataclass(frozen=True)
class FrameFiles:
    """Finds files in the first of ``folders`` that has them. What lies in a folder is listed once at most."""

    folders: tuple[Path, ...]
    _listed: dict[Path, dict[_Spelling, list[str]]] = field(default_factory=dict, init=False)

    def photo(self, frame: dict[str, Any]) -> Path:
        """The photo of a frame: in a file of ours by its own name first, then by ``file_path``.

        One that is nowhere is returned as if it were in the first folder, and refused when it is to be decoded.
        """
        name, *copies = photo_names(frame)
        file = self._file(name, self.folders, "photo")
        # Not beside the cameras: there lie ingest's copies, none of PHOTOS, which stand in for no photo removed.
        found = (self._file(copy, self.folders[:2], "photo") for copy in copies)
        return file if file.is_file() else next(filter(Path.is_file, found), file)

    def mask(self, name: str) -> Path:
        """The mask of this name, found as photos are."""
        return self._file(name, self.folders, "mask")

    def _file(self, name: str, folders: tuple[Path, ...], what: str) -> Path:
        """The file that ``name`` stands for. A missing extension is completed; where there is no such file a name is
        tried as Windows means it, with backslashes between folders, and then in other spellings."""
        spellings = dict.fromkeys((name, name.replace("\\", "/")))
        for spelling, folder, extension in product(spellings, folders, _EXTENSIONS_TRIED):
            file = _inside(folder, spelling + extension, what)
            if file.is_file():
                return file
        for spelling, folder in product(spellings, folders):
            alike = self._alike(folder, spelling)
            if alike is not None and (file := _inside(folder, alike, what)).is_file():
                return file
        return _inside(folders[0], name, what)

    def _alike(self, folder: Path, name: str) -> str | None:
        """What is in ``folder`` by another spelling of ``name``, relative to it: with the letters of its endings small
        or large, an image's ending missing, accents composed or not. None where nothing is, or more than one thing."""
        place = folder
        for part in PurePosixPath(os.path.normpath(name)).parts:
            found = [part] if (place / part).exists() else self._named(place, part)
            if len(found) != 1:
                return None
            place /= found[0]
        return str(place.relative_to(folder))

    def _named(self, folder: Path, name: str) -> list[str]:
        if folder not in self._listed:
            self._listed[folder] = {}
            for entry in os.listdir(folder) if folder.is_dir() else ():
                for spelling in _spellings_of(entry):
                    self._listed[folder].setdefault(spelling, []).append(entry)
        composed = unicodedata.normalize("NFC", name)
        stem, ending = os.path.splitext(composed)
        entries = self._listed[folder]
        return entries.get((stem, ending.lower()), []) + entries.get((composed, None), [])


def _spellings_of(entry: str) -> Iterator[_Spelling]:
    stem, ending = os.path.splitext(unicodedata.normalize("NFC", entry))
    yield stem, ending.lower()
    if ending.lower() in IMAGES:
        yield stem, None


def _inside(folder: Path, file_path: str, what: str) -> Path:
    normal = os.path.normpath(file_path)
    file, absolute = folder / normal, Path(file_path).is_absolute()
    if absolute or "\0" in file_path or not file.resolve().is_relative_to(folder.resolve()):
        hint = f"A transforms file may name {what}s inside its own folder only."
        if file.is_file() and not absolute and PurePosixPath(normal).parts[0] != "..":
            hint += " A link leads out: if it is yours, give a copy with the files themselves (cp -rL)."
        raise StageError(
            f"refused the {what} {file_path[:MOST_LETTERS]!r}",
            "its path is absolute" if absolute else f"it leads out of the folder {folder}",
            hint,
        )
    return file
