"""The photos and masks that a transforms file names: where they lie, and how their names may be spelt there."""

import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product, takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from stages.contract import StageError, listed
from stages.ingest.listing import IMAGES, files_below, walk_photos
from stages.io.transforms_files import MAX_LETTERS, photo_names

MAX_NAMES = 2  # in an error
_EXTENSIONS_TRIED = ("", ".png", ".jpg", ".jpeg")

# A name but for its ending, and the ending in small letters, None of an image, which may be called without.
_Spelling = tuple[str, str | None]


@dataclass(frozen=True)
class FrameFiles:
    """Finds files in the first of ``folders`` that has them. Each photo is looked for once; what lies in a folder is
    listed once at most.

    ``of_other_folders``: the names are of another machine or folder, and only their ends tell which files are meant.
    ``follows_links``: the first folder was given by the user, who may have put links to photos into it.
    ``other_endings`` collects the names whose files are found by another ending, and these files.
    """

    folders: tuple[Path, ...]
    of_other_folders: bool = False
    follows_links: bool = False
    other_endings: dict[str, Path] = field(default_factory=dict, init=False)
    _photos: dict[tuple[str, ...], Path] = field(default_factory=dict, init=False)
    _listed: dict[Path, dict[_Spelling, list[str]]] = field(default_factory=dict, init=False)
    _by_last: dict[str, dict[str, list[Path]]] = field(default_factory=dict, init=False)

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
        """The mask of this name, found as photos are, whose ending is its own and which is none of them."""
        return self._file(name, self.folders, "mask")

    def _file(self, name: str, folders: tuple[Path, ...], what: str) -> Path:
        """The file that ``name`` stands for. A missing extension is completed; where there is no such file a name is
        tried as Windows or a URL means it, then in other spellings. One that leads out of the folders is of another
        machine: its end tells which file is meant."""
        relative = [_relative(spelling, folders) for spelling in _as_paths(name)]
        spellings = list(dict.fromkeys(spelling for spelling in relative if spelling is not None))
        try:
            for spelling, folder, extension in product(spellings, folders, _EXTENSIONS_TRIED):
                file = self._inside(folder, spelling + extension, what)
                if file.is_file():
                    return file
            for spelling, folder in product(spellings, folders):
                alike = self._alike(folder, spelling)
                if alike is not None and (file := self._inside(folder, alike, what)).is_file():
                    return file
            if relative[0] is not None and not self.of_other_folders:
                return self._inside(folders[0], relative[0], what)
        except StageError:
            if (found := self._by_end(name, what)) is None:
                raise
            return found
        return self._by_end(name, what) or self._inside(folders[0], relative[0] or name, what)

    def _by_end(self, name: str, what: str) -> Path | None:
        """The file in the first folder whose path has the longest end in common with ``name``, whatever its letters'
        case, and its ending where no other file is called so; None where there is no such file. Raises StageError where
        there are several."""
        root, by_last = self.folders[0], self._lasts(what)
        *above, last = [_folded(part) for part in PurePosixPath(_as_paths(name)[-1]).parts] or [""]
        stem, ending = os.path.splitext(last)
        found = by_last.get(last) or (by_last.get(stem, []) if ending in IMAGES else [])
        if what == "mask":
            photos = set(self._photos.values())
            found = [file for file in found if file not in photos]
        found = [file for file in found if self.follows_links or file.resolve().is_relative_to(root.resolve())]
        alike = [_in_common(above, [_folded(part) for part in file.parent.parts]) for file in found]
        best = [file for file, count in zip(found, alike, strict=True) if count == max(alike)]
        if len(best) > 1:
            raise _ambiguous(name, what, root, best)
        if what == "photo" and best and ending in IMAGES and ending != best[0].suffix.lower():
            self.other_endings[name] = best[0]
        return best[0] if best else None

    def _lasts(self, what: str) -> dict[str, list[Path]]:
        """The files of the first folder by the last part of their paths, an image's without its ending, too. Masks
        lie in folders in which no photo is looked for."""
        if what not in self._by_last:
            by_last = self._by_last.setdefault(what, {})
            for file in walk_photos(self.folders[0]) if what == "photo" else self._walk_masks():
                for spelling in (file.name, file.stem) if file.suffix.lower() in IMAGES else (file.name,):
                    by_last.setdefault(_folded(spelling), []).append(file)
        return self._by_last[what]

    def _walk_masks(self) -> Iterator[Path]:
        """What may be a mask: all in the first folder, and in folders of masks in the others."""
        others = set(self.folders[1:]) - {self.folders[0]}
        beside = (child for folder in sorted(others) for child in sorted(folder.glob("*/")))
        for place in (self.folders[0], *(child for child in beside if child.name.lower().startswith("mask"))):
            yield from files_below(place, lambda folder: not folder.name.startswith("."))

    def _inside(self, folder: Path, file_path: str, what: str) -> Path:
        """The file of this name in ``folder``. Raises StageError where it leads out of there, but for a link to the
        first folder, which the user gave, and for links in that to files."""
        root = self.folders[0]
        file = folder / os.path.normpath(file_path)
        absolute, is_name = Path(file_path).is_absolute(), "\0" not in file_path
        if is_name and not absolute:
            inside = any(file.resolve().is_relative_to(place.resolve()) for place in (folder, root))
            is_link = self.follows_links and file.is_symlink() and file.parent.resolve().is_relative_to(root.resolve())
            if inside or is_link:
                return file
        of_photos = "Give the photos and the file separately: pipeline run PHOTOS --cameras FILE"
        raise StageError("ingest.outside-folder", 
            f"rejected the {what} {file_path[:MAX_LETTERS]!r}",
            "its path is absolute" if absolute else f"it leads out of the folder {folder}",
            of_photos if what == "photo" and not self.follows_links else
            f"A transforms file may only name {what}s inside {root}, and none in linked folders there.",
        )  # fmt: skip

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


def _ambiguous(name: str, what: str, root: Path, found: Sequence[Path]) -> StageError:
    names = sorted(Path(os.path.relpath(file, root)).as_posix() for file in found)
    return StageError(
        "ingest.ambiguous-path",
        f"cannot tell which {what} {name[:MAX_LETTERS]!r} is",
        f"{root} has no such path, and {len(names)} files there end like it: {listed(names, MAX_NAMES)}",
        f"Write the paths in the transforms file relative to {root}, for example {names[0]}",
    )


def _as_paths(name: str) -> tuple[str, ...]:
    """``name`` as it stands, with the slashes of Windows turned, and as the URL that it may be, without blanks or line
    ends around it."""
    if name.startswith("file://"):
        return (_decoded(name.removeprefix("file://")).strip(),)
    turned = name.replace("\\", "/")
    path = re.split("[?#]", turned)[0] if "://" in turned else turned
    return name, turned, _decoded(path).strip()


def _decoded(url: str) -> str:
    """A URL's path with what it writes as %20 and the like (RFC 3986)."""
    return re.sub(
        r"(%[\da-fA-F]{2})+", lambda part: bytes.fromhex(part[0].replace("%", "")).decode("utf-8", "replace"), url
    )


def _relative(name: str, folders: tuple[Path, ...]) -> str | None:
    """``name`` relative to the folder that it lies in if it is absolute; None where it lies in none of them, as URLs
    do."""
    if "://" in name:
        return None
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
