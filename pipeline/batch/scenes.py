"""Which scenes a folder holds: each folder and each video directly in it is one."""

import os
from pathlib import Path
from typing import NamedTuple

from pipeline.batch.batch_file import NAME as BATCH_FILE
from pipeline.engine.workspace import RUN_FILE
from stages.contract import StageError
from stages.ingest.listing import IMAGES, is_video, without_previews
from stages.ingest.sources import photo_root


class Scene(NamedTuple):
    """A name that no other scene of the batch has, and PHOTOS as `pipeline run` takes them."""

    name: str
    photos: Path


def find_scenes(folder: Path) -> list[Scene]:
    """The scenes of ``folder`` by name; hidden files and folders, workspaces and batches of ours are none.

    Raises StageError where there is no such folder, no scene in it, or where it is itself the photos of one scene."""
    try:
        found = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
        sign = _sign_of_one_scene(folder, found)
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        hint = "Give the folder that holds a folder of photos, or a video, for each scene."
        raise StageError("pipeline.scenes-unreadable", f"cannot read {folder}", why, hint) from error
    if sign:
        hint = f"Give the folder above it, or run it alone: pipeline run {folder}"
        raise StageError("pipeline.one-scene", f"{folder} is one scene, not a folder of scenes", sign, hint)
    folders = [path for path in found if path.is_dir() and not _is_ours(path)]
    videos = without_previews([path for path in found if path.is_file() and is_video(path)])
    if not folders and not videos:
        why = "no folder and no video lies directly in it"
        hint = "Make a folder of photos for each scene there, or put its video there."
        raise StageError("pipeline.no-scenes", f"{folder} holds no scene", why, hint)
    names = [path.name for path in folders]
    stems = [path.stem for path in videos]
    for path in videos:
        name = path.name if path.stem in names or stems.count(path.stem) > 1 else path.stem
        while name in names:
            name += "_"
        names.append(name)
    return sorted(Scene(printable(name), path) for name, path in zip(names, [*folders, *videos], strict=True))


def printable(name: str) -> str:
    """A name of the disk without what is no text there, which no page or JSON file can hold."""
    return name.encode("utf-8", "backslashreplace").decode()


def _is_ours(folder: Path) -> bool:
    return any(os.path.isfile(folder / name) for name in (RUN_FILE, BATCH_FILE))  # also where none may be read


def _sign_of_one_scene(folder: Path, found: list[Path]) -> str | None:
    """What tells that the folder is the photos of one scene; None where nothing does."""
    for path in found:
        if path.name.startswith("transforms") and path.suffix == ".json":
            return f"{path.name} lies in it"
        if path.suffix.lower() in IMAGES and path.is_file():
            return f"photos lie directly in it ({path.name})"
    if (photos := photo_root(folder)) != folder:
        return f"its photos are in {photos.name}"
    return None
