"""What PHOTOS may be: a folder of photos, a video, or photos with poses to import.

Cheap: lists folders and reads at most the JSON of a transforms file, never an image.
"""

import difflib
import os
import re
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from stages.contract import StageError, listed, shown
from stages.ingest.auxiliary_files import (
    ALL_PHOTOS,
    IGNORED,
    ONE_FOR_ALL,
    auxiliary_files,
    instant_ngp_masks,
    is_mask,
    pair_masks,
)
from stages.ingest.listing import (
    FOLDER_HINT,
    IMAGES,
    MASKS,
    RAW_EXTENSIONS,
    files_below,
    is_photo_folder,
    is_video,
    list_photos,
    may_be_photo,
    read_photo_list,
    walk_photos,
)
from stages.ingest.sources.camera_files import (
    FEW_NAMES,
    LLFF,
    LLFF_FILE,
    cameras_in,
    colmap_model,
    llff_in,
    model_files,
    unknown_cameras,
)
from stages.ingest.sources.frame_files import FrameFiles
from stages.io.transforms_files import TRAIN, photo_names, read_splits

SourceKind = Literal["photos", "video", "transforms", "blender", "colmap", "llff"]

MAX_NAMES = 5
_REDUCED = re.compile(r"images_(\d+)")
_OF_MASKS = re.compile(
    r"(.+[._-])?masks?([._-].*)?|seg(mentation|mentations|s)?|silhouettes?|mattes?|alphas?", re.IGNORECASE
)
_HAS_BESIDE = re.compile(r"images(_\d+)?|input|photos")  # folders of photos beside which their masks may lie


@dataclass(frozen=True)
class Source:
    """Where photos, and perhaps cameras, come from.

    ``kind`` "photos" goes through structure-from-motion and has no ``cameras``, and so does "video", whose one file is
    the video; otherwise ``cameras`` is the transforms file, the folder of transforms_train.json, the folder of one
    COLMAP model or LLFF's file. ``files`` are the files to decode, in order of their names relative to ``root``; some
    may turn out to be no images, and files named by a transforms file may be missing. ``frames`` maps each file_path of
    a transforms file, as it is written there, or each row of LLFF's, from 0, to the name of its photo. ``masks`` are
    the files that a transforms file names as masks, each after its photo's name and .png, and then all files in folders
    named masks, each after the name, relative to ``root``, that it would have without such a folder in it. ``excluded``
    are files in a folder of photos that belong to one of them by their names, as a depth map does, and that photo, by
    name. ``other_endings`` are those of ``frames`` whose photo has another ending than its file_path.
    Where a ``photo_list`` was given, all but ``frames`` are of the photos that it names alone; ``unlisted`` is how many
    others there are.
    """

    kind: SourceKind
    root: Path
    cameras: Path | None
    files: tuple[Path, ...]
    frames: Mapping[str, str] = field(default_factory=dict)
    masks: tuple[tuple[str, Path], ...] = ()
    excluded: Mapping[str, str] = field(default_factory=dict)
    other_endings: Mapping[str, str] = field(default_factory=dict)
    photo_list: Path | None = None
    unlisted: int = 0

    def name(self, file: Path) -> str:
        """The name of one of ``files``: relative to ``root``, with forward slashes, always encodable as UTF-8."""
        return _name(self.root, file)


def _name(root: Path, file: Path, below: Path = Path()) -> str:
    return os.fsencode((below / file.relative_to(root)).as_posix()).decode("utf-8", "backslashreplace")


def find_source(photos: Path, cameras: Path | None = None, photo_list: Path | None = None) -> Source:
    """Decide what PHOTOS is, and which of them ``photo_list`` names, None for all. Raises StageError where there is
    nothing to work on or the choice is not clear."""
    photos, cameras = photos.absolute(), cameras and cameras.absolute()
    try:
        _check_given(photos, cameras)
        source = _source(photos, cameras)
        if source.kind != "video":
            source = replace(source, masks=source.masks + _list_masks(source.root, source.files) + _beside(source))
            return source if photo_list is None else _only_listed(source, photo_list)
        if cameras is not None:
            raise _cameras_of_video(source.files[0])
        if photo_list is not None:
            raise _list_of_video(source.files[0])
        return source
    except OSError as error:
        raise cannot_read(error.filename or photos, error) from error


def cannot_read(path: Path | str, error: OSError) -> StageError:
    """The error for a file or folder of the user's that cannot be read, or has gone since it was listed."""
    hint = "Check that it exists and is readable (chmod -R u+rX), then run again."
    return StageError("ingest.cannot-read", f"cannot read {path}", (error.strerror or str(error)).lower(), hint)


def _source(photos: Path, cameras: Path | None) -> Source:
    if photos.is_file() and is_video(photos):
        return Source("video", photos.parent, None, (photos,))
    if photos.is_file():
        return _from_transforms("transforms", photos.parent, photos, alone=True)
    root = photo_root(photos)
    cameras = cameras and llff_in(cameras)
    if cameras is not None and cameras.is_file() and cameras.suffix.lower() != LLFF:
        return _from_transforms("transforms", root, cameras)
    if cameras is None and (photos / TRAIN).is_file():
        return _from_transforms("blender", photos, photos)
    files = list_photos(root)
    if is_video(files[0]):
        return Source("video", root, None, files)
    names = [_name(root, file) for file in files]
    of_llff = cameras is not None and cameras.is_file()
    if cameras is not None and not of_llff and not model_files(cameras := cameras_in(cameras, names)):
        return _from_transforms("transforms" if cameras.is_file() else "blender", root, cameras)
    excluded = auxiliary_files(names)
    files = tuple(file for file in files if _name(root, file) not in excluded)
    if cameras is not None and of_llff:
        return Source("llff", root, cameras, files, _rows(root, files), excluded=excluded)
    if cameras is not None:
        return Source("colmap", root, cameras, files, excluded=excluded)
    return Source("photos", root, None, files, excluded=excluded)


def _only_listed(source: Source, photo_list: Path) -> Source:
    """``source`` with those of its photos alone that a list names, and with what belongs to them. Raises StageError
    where it names others."""
    names = [source.name(file) for file in source.files]
    spelt = {unicodedata.normalize("NFC", name): name for name in names} | {name: name for name in names}
    meant = {line: _meant(line, spelt) for line in read_photo_list(photo_list)}
    if unknown := [line.strip() for line, name in meant.items() if name is None]:
        raise _not_among_photos(source, photo_list, len(meant), unknown)
    listed_names = {*meant.values()}
    mask_of, _ = pair_masks(names, source.masks)
    of_others = {*mask_of.values()} - {mask for name, mask in mask_of.items() if name in listed_names}
    return replace(
        source,
        files=tuple(file for file, name in zip(source.files, names, strict=True) if name in listed_names),
        masks=tuple((name, mask) for name, mask in source.masks if mask not in of_others),
        excluded={file: of for file, of in source.excluded.items() if of in listed_names or of == ALL_PHOTOS},
        other_endings={path: name for path, name in source.other_endings.items() if name in listed_names},
        photo_list=photo_list,
        unlisted=len({*names} - listed_names),
    )


def _meant(line: str, spelt: Mapping[str, str]) -> str | None:
    """The name that a line of a list stands for: as it is, without spaces around it and ``./``, with the backslashes of
    Windows, or with accents composed in another way; None for none. ``spelt``: all names by their spellings."""
    plain = PurePosixPath(line.strip()).as_posix()
    tried = (line, plain, plain.replace("\\", "/"))
    known = (one for name in tried for one in (name, unicodedata.normalize("NFC", name)) if one in spelt)
    return next(map(spelt.__getitem__, known), None)


def _not_among_photos(source: Source, photo_list: Path, lines: int, unknown: Sequence[str]) -> StageError:
    few = [
        shown(name) + (f" (perhaps {shown(similar)})" if (similar := _closest(name, source)) else "")
        for name in unknown[:MAX_NAMES]
    ]
    return StageError(
        "ingest.photo-list-names",
        f"cannot use the photo list {photo_list}",
        f"no photo matches {len(unknown)} of its {lines} names: {listed([*few, *unknown[MAX_NAMES:]], MAX_NAMES)}",
        f"Correct the list: names are relative to {source.root}, as in photos.json.",
    )


def _closest(name: str, source: Source) -> str | None:
    """The photo that may be meant: one that the file of this name belongs to, one that is called so in another folder
    or in other capitals, or one of a similar name."""
    names = [source.name(file) for file in source.files]
    last = PurePosixPath(name.replace("\\", "/")).name.lower()
    same = [one for one in names if PurePosixPath(one).name.lower() == last]
    return source.excluded.get(name) or next(iter(same or difflib.get_close_matches(name, names, 1)), None)


def _rows(root: Path, files: Sequence[Path]) -> dict[str, str]:
    """The photo of each row of LLFF's file. Whoever wrote that had pictures by their endings, and not what lies beside
    them: one file more would shift all rows after it."""
    pictures = [file for file in files if file.suffix.lower() in IMAGES + RAW_EXTENSIONS]
    return {str(row): name for row, name in enumerate(sorted(_name(root, file) for file in pictures or files))}


def photo_root(folder: Path) -> Path:
    """The folder of the photos of a folder that was given: its ``images`` if that holds any, else the largest of
    ``images_2``, ``images_4``, … where these hold copies of the same photos and nothing else does, else itself."""
    images = folder / "images"
    if images.is_dir() and any(map(may_be_photo, walk_photos(images))):
        return images
    reduced = reduced_folders(folder)
    if not reduced or any(
        map(may_be_photo, files_below(folder, lambda one: is_photo_folder(one) and one not in reduced))
    ):
        return folder
    return reduced[0] if all(_is_reduction(smaller, reduced[0]) for smaller in reduced[1:]) else folder


def reduced_folders(folder: Path, but: Path | None = None) -> list[Path]:
    """The folders of photos that are called as reductions are, ``images_2``, ``images_4``, …, the largest first."""
    named = [(int(number[1]), one) for one in folder.glob("*/") if (number := _REDUCED.fullmatch(one.name))]
    return [one for _, one in sorted(named) if one != but and any(map(may_be_photo, walk_photos(one)))]


def _is_reduction(smaller: Path, larger: Path) -> bool:
    """Whether all photos of a folder are called like some of another one, and the first of them has fewer pixels."""
    from stages.ingest.decoding import pixel_count  # OpenCV

    ours, theirs = ({file.stem: file for file in files_below(at, is_photo_folder)} for at in (smaller, larger))
    first = min(ours)
    return ours.keys() <= theirs.keys() and 0 < pixel_count(ours[first]) < pixel_count(theirs[first])


def unused_cameras(source: Source) -> Path | None:
    """What lies with photos that were given without cameras and could be given as their cameras: the one COLMAP model
    in a ``sparse`` folder, a transforms.json that names some of them, or LLFF's file."""
    if source.kind != "photos":
        return None
    inside = source.root.name == "images" or _REDUCED.fullmatch(source.root.name)
    places = (source.root.parent, source.root) if inside else (source.root,)
    for place, name in product(places, ("sparse", "colmap", "dense")):
        with suppress(StageError, OSError):
            return colmap_model(place / name, [source.name(file) for file in source.files])
    for file in (place / "transforms.json" for place in places):
        with suppress(StageError, OSError):
            if set(_from_transforms("transforms", source.root, file).files) & set(source.files):
                return file
    return next((file for place in places if (file := place / LLFF_FILE).is_file()), None)


def unused_masks(source: Source) -> Path | None:
    """A folder beside photos that have no masks, or beside the file of their cameras, in which there would be some if
    it were their ``masks`` folder."""
    if source.masks:
        return None
    names = [source.name(file) for file in source.files]
    folders = [source.root.parent, *([source.cameras.parent] if source.cameras else [])]
    named = list[Path]()
    for folder in folders:
        with suppress(PermissionError):  # nobody gave it
            named += [child for child in sorted(folder.iterdir()) if _OF_MASKS.fullmatch(child.name)]
    for folder in filter(Path.is_dir, named):
        with suppress(PermissionError):
            inside = files_below(folder, lambda _: True)
            if pair_masks(names, [(_name(folder, file), file) for file in inside])[0]:
                return folder
    return None


def photos_without_frame(source: Source) -> list[str]:
    """Photos that a transforms file does not name, in the folders of those that it names."""
    if source.kind != "transforms":
        return []
    named = {*source.frames.values()}
    inside = {
        child for folder in {file.parent for file in source.files} if folder.is_dir() for child in folder.iterdir()
    }
    shown = (one for one in inside if one.suffix.lower() in IMAGES and not one.name.startswith(".") and one.is_file())
    there = sorted(named | {source.name(file) for file in shown if file.is_relative_to(source.root)})
    others = [name for name in there if name not in named and not is_mask(name)]
    auxiliary = auxiliary_files(there)
    masks = {source.name(file) for _, file in source.masks if file.is_relative_to(source.root)}
    return [name for name in others if name not in auxiliary and name not in masks]


def photos_beside(source: Source, photos: Path) -> int:
    """How many photos lie in the folder PHOTOS itself where those of its ``images`` folder are taken."""
    if source.kind not in ("photos", "colmap") or source.root != photos.absolute() / "images":
        return 0
    named = (file for file in photos.glob("*") if file.suffix.lower() in IMAGES and not file.name.startswith("."))
    return sum(file.is_file() and not is_mask(file.name) for file in named)


def mask_beside(source: Source, photos: Path) -> Path | None:
    """A single mask in the folder PHOTOS itself where the photos of its ``images`` folder are taken."""
    if source.root != photos.absolute() / "images":
        return None
    named = (file for file in sorted(photos.iterdir()) if file.suffix.lower() in IMAGES)
    return next((file for file in named if file.stem.lower() in ONE_FOR_ALL), None)


def is_gone(photos: Path) -> bool:
    """Whether nothing is left of PHOTOS: a drive that is not there leaves an empty folder, or links to what it held."""
    try:
        empty = photos.is_dir() and not any(map(Path.is_file, walk_photos(photo_root(photos))))
        return empty or not photos.exists()
    except OSError:  # said by find_source
        return False


def _list_masks(root: Path, files: tuple[Path, ...]) -> tuple[tuple[str, Path], ...]:
    """What lies in a ``masks`` folder in ``root`` or in any folder of photos below it, or beside one of these that is
    called as folders of nothing but photos are. See :class:`Source`."""
    holders = sorted({holder for file in files for holder in file.parents if holder.is_relative_to(root)} | {root})
    places = [(masks, holder.relative_to(root)) for holder in holders for masks in _named_masks(holder)]
    for holder in holders:
        if named := _HAS_BESIDE.fullmatch(holder.name):
            of_reduced = _named_masks(holder.parent, named[1] or "")
            places += [(masks, holder.relative_to(root)) for masks in of_reduced or _named_masks(holder.parent)]
    found = []
    for masks, stands_in in places:
        inside = files_below(masks, lambda folder: not folder.name.startswith("."))
        found += [(_name(masks, file, stands_in), file) for file in inside]
    return tuple(found)


def _named_masks(holder: Path, reduced: str = "") -> list[Path]:
    """The folders of masks in a folder: Masks is one, too; of ``images_4`` those are in ``masks_4``. None in one that
    cannot be read, as that around the photos may be."""
    with suppress(PermissionError, FileNotFoundError, NotADirectoryError), os.scandir(holder) as entries:
        return sorted(Path(one) for one in entries if one.name.lower() == MASKS + reduced and one.is_dir())
    return []


def _beside(source: Source) -> tuple[tuple[str, Path], ...]:
    """Masks of instant-ngp's that lie beside their photos, after the names that they would have in a masks folder."""
    if source.kind in ("transforms", "blender"):
        own = {source.name(file): file.with_name(f"{IGNORED}{file.stem}.png") for file in source.files}
        return tuple((f"{photo}.png", mask) for photo, mask in own.items() if mask.is_file())
    found = instant_ngp_masks(source.excluded)
    return tuple((f"{photo}.png", source.root / mask) for photo, mask in found.items())


def _check_given(photos: Path, cameras: Path | None) -> None:
    if not photos.exists():
        raise StageError(
            "ingest.no-such-photos",
            f"{photos} does not exist",
            "no file or folder has this name",
            "Check the spelling.",
        )
    if cameras is not None and not cameras.exists():
        raise StageError(
            "ingest.no-such-cameras", f"{cameras} does not exist", "no file or folder has this name", "Check --cameras."
        )
    if photos.is_dir():
        if (photos / "run.json").is_file():
            raise StageError(
                "ingest.workspace-given",
                f"{photos} is a workspace",
                "it holds results, not photos",
                f"Continue it: pipeline resume {photos}",
            )
    elif (suffix := photos.suffix.lower()) in IMAGES:
        raise StageError(
            "ingest.single-image",
            f"{photos.name} is a single image",
            "a scene needs many photos from different places",
            FOLDER_HINT,
        )
    elif suffix != ".json" and not is_video(photos):
        raise StageError(
            "ingest.unknown-input",
            f"cannot use {photos.name}",
            "it is not a folder of photos, a video or a transforms.json",
            FOLDER_HINT,
        )
    elif cameras is not None and suffix == ".json":
        raise StageError(
            "ingest.transforms-and-cameras",
            "two sources of cameras",
            f"{photos.name} and --cameras {cameras}",
            "Give the photo folder with --cameras.",
        )
    if cameras is not None and cameras.is_file() and cameras.suffix.lower() not in (".json", LLFF):
        raise unknown_cameras(cameras)


def _from_transforms(kind: SourceKind, root: Path, cameras: Path, alone: bool = False) -> Source:
    """``alone``: the file was given as PHOTOS, and so its folder is a stranger's."""
    place = cameras.parent if cameras.is_file() else cameras
    find = FrameFiles((root,) if place == root else (root, root.parent, place), follows_links=not alone)
    frames, files = _frames(cameras, find)
    if not any(map(Path.is_file, files.values())):
        find = replace(find, of_other_folders=True)
        frames, files = _frames(cameras, find)
        if not any(map(Path.is_file, files.values())):
            raise _none_of_its_photos(cameras, root, list(files))
    in_order = _sorted_inside(root, set(files.values()))
    photos = {path: _name(root, file) for path, file in files.items()}
    # In a file of ours they are of ingest's copies: those that lie with the photos count.
    foreign = [frame for frame in frames if len(photo_names(frame)) == 1]
    named = {photos[frame["file_path"]]: mask for frame in foreign if (mask := frame.get("mask_path"))}
    masks = tuple((f"{photo}.png", find.mask(mask)) for photo, mask in named.items())
    other_endings = {path: _name(root, file) for path, file in find.other_endings.items()}
    return Source(kind, root, cameras, in_order, photos, masks, other_endings=other_endings)


def _frames(cameras: Path, find: FrameFiles) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """The frames of transforms files, and the photo of each by its ``file_path``."""
    splits, _ = read_splits(cameras, lambda frame: find.photo(frame).is_file())
    frames = [frame for _, content in splits for frame in content["frames"]]
    return frames, {frame["file_path"]: find.photo(frame) for frame in frames}


def _none_of_its_photos(cameras: Path, root: Path, names: list[str]) -> StageError:
    """The error for a transforms file of which nothing is among the photos at hand."""
    here = sorted(file.relative_to(root).as_posix() for file in walk_photos(root) if file.suffix.lower() in IMAGES)
    there = f"{root} has {listed(here, FEW_NAMES)}" if here else f"there are no photos in {root}"
    return StageError(
        "ingest.cameras-of-other-photos",
        f"none of the {len(names)} photos in {cameras.name} exists",
        f"it names {listed(names, FEW_NAMES)}, and {there}",
        f"Give the folder with its photos: pipeline run PHOTOS --cameras {cameras}",
    )


def _sorted_inside(root: Path, files: set[Path]) -> tuple[Path, ...]:
    outside = [file for file in files if not file.is_relative_to(root)]
    if outside:
        raise StageError(
            "ingest.photo-outside",
            f"{min(outside)} is outside the photo folder",
            f"the transforms file names it, and photos must lie in {root}",
            "Give the folder that holds all photos of the transforms file.",
        )
    return tuple(sorted(files, key=lambda file: file.relative_to(root).as_posix()))


def _cameras_of_video(video: Path) -> StageError:
    return StageError(
        "ingest.cameras-of-video",
        f"cannot use --cameras with {video.name}",
        "stage ingest chooses the frames of a video, so no poses can be imported for them",
        "Leave out --cameras, or give the folder of the photos that the cameras belong to.",
    )


def _list_of_video(video: Path) -> StageError:
    return StageError(
        "ingest.photo-list-of-video",
        f"cannot use --ingest.photo-list with {video.name}",
        "stage ingest chooses the frames of a video, so no list can name them beforehand",
        "Leave it out; or take the frames first (pipeline run VIDEO --until ingest), then choose from these: "
        "pipeline run WORKSPACE/output/images --ingest.photo-list FILE -o OTHER.nerf",
    )
