"""Which scenes a folder holds: each folder and each video directly in it is one."""

from pathlib import Path
from typing import NamedTuple

from pipeline.engine.workspace import RUN_FILE
from stages.contract import StageError
from stages.ingest.listing import IMAGES, is_video
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
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        hint = "Give the folder that holds a folder of photos, or a video, for each scene."
        raise StageError("pipeline.scenes-unreadable", f"cannot read {folder}", why, hint) from error
    if sign := _sign_of_one_scene(folder, found):
        hint = f"Give the folder above it, or run it alone: pipeline run {folder}"
        raise StageError("pipeline.one-scene", f"{folder} is one scene, not a folder of scenes", sign, hint)
    scenes = [path for path in found if (path.is_dir() and not _is_ours(path)) or (path.is_file() and is_video(path))]
    if not scenes:
        why = "no folder and no video lies directly in it"
        hint = "Make a folder of photos for each scene there, or put its video there."
        raise StageError("pipeline.no-scenes", f"{folder} holds no scene", why, hint)
    stems = [path.stem if path.is_file() else path.name for path in scenes]
    return [
        Scene(path.name if stems.count(stem) > 1 and path.is_file() else stem, path)
        for path, stem in zip(scenes, stems, strict=True)
    ]


def _is_ours(folder: Path) -> bool:
    return (folder / RUN_FILE).is_file() or (folder / "batch.json").is_file()


def _sign_of_one_scene(folder: Path, found: list[Path]) -> str | None:
    """What tells that the folder is the photos of one scene; None where nothing does."""
    if (photos := photo_root(folder)) != folder:
        return f"its photos are in {photos.name}"
    for path in found:
        if path.name.startswith("transforms") and path.suffix == ".json":
            return f"{path.name} lies in it"
        if path.suffix.lower() in IMAGES and path.is_file():
            return f"photos lie directly in it ({path.name})"
    return None
