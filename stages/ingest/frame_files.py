"""The photos and masks that a transforms file names: where they lie, and how their names may be spelt there."""

import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product, takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from stages.contract import StageError
from stages.ingest.listing import IMAGES, walk_photos
from stages.io.transforms_files import MAX_LETTERS, photo_names

_EXTENSIONS_TRIED = ("", ".png", ".jpg", ".jpeg")

# A name but for its ending, and the ending in small letters, None of an image, which may be called without.
_Spelling = tuple[str, str | None]


@dataclass(frozen=True)
class FrameFiles:
    """Finds files in the first of ``folders`` that has them. Each photo is looked for once; what lies in a folder is
    listed once at most.

    ``of_other_folders``: the names are of another machine or folder, and only their ends tell which files are meant.
    """

    folders: tuple[Path, ...]
    of_other_folders: bool = False
    _photos: dict[tuple[str, ...], Path] = field(default_factory=dict, init=False)
    _listed: dict[Path, dict[_Spelling, list[str]]] = field(default_factory=dict, init=False)
    _by_last: dict[str, list[Path]] = field(default_factory=dict, init=False)

    def photo(self, frame: dict[str, Any]) -> Path:
        """The photo of a frame: in a file of ours by its own name first, then by ``file_path``.

        Where the first folder is a reduction of the one that it names, as ``images_4`` of ``images/0.png``, its smaller
        copy. One that is nowhere is returned as if it were in the first folder, and rejected when it is to be decoded.
        """
        names = photo_names(frame)
        if names not in self._photos:
            self._photos[names] = self._photo(*names)
        return self._photos[names]

    def _photo(self, name: str, *copies: str) -> Path:
        if (reduced := self._reduced(name)) is not None and reduced.is_file():
            return reduced
        file = self._file(name, self.folders, "photo")
        # Not beside the cameras: there lie ingest's copies, none of PHOTOS, which stand in for no photo removed.
        found = (self._file(copy, self.folders[:2], "photo") for copy in copies)
        return file if file.is_file() else next(filter(Path.is_file, found), file)

    def _reduced(self, name: str) -> Path | None:
        """Where the smaller copy of a photo would be in the first folder; None where that is no folder of such."""
        folder, _, inside = os.path.normpath(name.replace("\\", "/")).partition("/")
        is_reduction = re.fullmatch(rf"{re.escape(folder)}_\d+", self.folders[0].name)
        return self._file(inside, self.folders[:1], "photo") if is_reduction else None

    def mask(self, name: str) -> Path:
        """The mask of this name, found as photos are."""
        return self._file(name, self.folders, "mask")

    def _file(self, name: str, folders: tuple[Path, ...], what: str) -> Path:
        """The file that ``name`` stands for. A missing extension is completed; where there is no such file a name is
        tried as Windows means it, with backslashes between folders, then in other spellings. One that leads out of the
        folders is of another machine: its end tells which file is meant."""
        relative = _relative(name, folders)
        spellings = () if relative is None else dict.fromkeys((relative, relative.replace("\\", "/")))
        try:
            for spelling, folder, extension in product(spellings, folders, _EXTENSIONS_TRIED):
                file = _inside(folder, self.folders[0], spelling + extension, what)
                if file.is_file():
                    return file
            for spelling, folder in product(spellings, folders):
                alike = self._alike(folder, spelling)
                if alike is not None and (file := _inside(folder, self.folders[0], alike, what)).is_file():
                    return file
            if relative is not None and not self.of_other_folders:
                return _inside(folders[0], self.folders[0], relative, what)
        except StageError:
            if (found := self._by_end(name)) is None:
                raise
            return found
        return self._by_end(name) or _inside(folders[0], self.folders[0], relative or name, what)

    def _by_end(self, name: str) -> Path | None:
        """The file in the first folder whose path has the longest end in common with ``name``, whatever its letters'
        case; None where there is no such file, or more than one."""
        if not self._by_last:
            for file in walk_photos(self.folders[0]):
                for spelling in (file.name, file.stem) if file.suffix.lower() in IMAGES else (file.name,):
                    self._by_last.setdefault(_folded(spelling), []).append(file)
        *above, last = [_folded(part) for part in PurePosixPath(name.replace("\\", "/")).parts]
        found = self._by_last.get(last, [])
        alike = [_in_common(above, [_folded(part) for part in file.parent.parts]) for file in found]
        best = [file for file, count in zip(found, alike, strict=True) if count == max(alike)]
        return best[0] if len(best) == 1 and best[0].resolve().is_relative_to(self.folders[0].resolve()) else None

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


def _relative(name: str, folders: tuple[Path, ...]) -> str | None:
    """``name`` relative to the folder that it lies in if it is absolute; None where it lies in none of them."""
    if not (PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()):
        return name
    inside = (folder for folder in folders if PurePosixPath(name).is_relative_to(folder))
    return next((str(PurePosixPath(name).relative_to(folder)) for folder in inside), None)


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _in_common(first: Sequence[str], second: Sequence[str]) -> int:
    """How many parts at their ends are the same."""
    pairs = zip(reversed(first), reversed(second), strict=False)
    return len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _spellings_of(entry: str) -> Iterator[_Spelling]:
    stem, ending = os.path.splitext(unicodedata.normalize("NFC", entry))
    yield stem, ending.lower()
    if ending.lower() in IMAGES:
        yield stem, None


def _inside(folder: Path, root: Path, file_path: str, what: str) -> Path:
    """The file of this name in ``folder``. Raises StageError where it leads out of there, but for a link to ``root``,
    which the user gave."""
    file = folder / os.path.normpath(file_path)
    absolute, is_name = Path(file_path).is_absolute(), "\0" not in file_path
    if absolute or not is_name or not any(file.resolve().is_relative_to(place.resolve()) for place in (folder, root)):
        linked = is_name and what == "photo" and not absolute and ".." not in file.relative_to(folder).parts
        raise StageError("ingest.outside-folder", 
            f"rejected the {what} {file_path[:MAX_LETTERS]!r}",
            "its path is absolute" if absolute else f"it leads out of the folder {folder}",
            "Give the photo folder apart, if it is a link: pipeline run PHOTOS --cameras FILE." if linked else
            f"A transforms file may name {what}s inside its own folder only.",
        )  # fmt: skip
    return file
