"""Which files below a folder may be photos, or the one video there, told by their names; and lists of photos."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from stages.contract import StageError
from stages.io.amounts import counted

# Everything else is tried: what counts as a photo is decided by decoding, not by the name.
# fmt: off
_NOT_PHOTOS = (
    ".txt", ".json", ".jsonl", ".md", ".rst", ".csv", ".tsv", ".xml", ".html", ".pdf", ".log", ".ini", ".toml", ".yaml",
    ".yml", ".py", ".sh", ".ipynb", ".zip", ".gz", ".tar", ".7z", ".npy", ".npz", ".pt", ".pth", ".pkl", ".bin", ".db",
    ".ply", ".obj", ".mtl", ".glb", ".gltf", ".stl", ".las", ".laz", ".xmp", ".aae", ".thm", ".mp3", ".wav", ".m4a",
    ".srt", ".vtt", ".gpx", ".kml", ".mrk", ".nav", ".obs",
)
_PREVIEWS = (".lrv", ".lrf")  # small copies that cameras and drones write beside each video
_VIDEOS = (
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".mts", ".m2ts", ".wmv", ".insv",
    *_PREVIEWS,
)
IMAGES = (
    ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".insp", ".png", ".heic", ".heif", ".hif", ".tif", ".tiff", ".webp",
    ".bmp", ".avif", ".gif", ".jp2", ".j2k", ".ppm", ".pgm", ".pnm",
)
RAW_EXTENSIONS = (
    ".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".srf", ".raf", ".orf", ".rw2", ".pef", ".raw", ".iiq",
)
# fmt: on
MASKS = "masks"  # the folder of masks, whatever its letters' case
# Thumbnails, deleted and lost files and attributes of Synology, QNAP, Windows, macOS and Linux, in small letters.
_OF_SYSTEMS = (
    "@eadir", "#recycle", "@recycle", "@__thumb", "$recycle.bin", "system volume information", "__macosx", "lost+found",
)  # fmt: skip
MAX_OTHER_FILES = 2  # files beside a video, too few to be a set of photos
FOLDER_HINT = "Give the folder that holds the photos: pipeline run FOLDER"
_LIST_HINT = "Write one photo name per line, relative to PHOTOS, in UTF-8; lines that begin with # are ignored."
_LIST_GONE = (
    "Check the path. If the list moved, put it back or give its path: pipeline run PHOTOS --ingest.photo-list FILE; "
    "the same list keeps all results."
)
_LINKS_HINT = "Fetch them (git annex get, dvc pull), or connect the drive that holds them."


def list_photos(root: Path) -> tuple[Path, ...]:
    """All files below ``root`` that may be photos, sorted by relative name; the video where there is a single one and
    beside it no more than MAX_OTHER_FILES of these, none an image by its ending.

    Skipped: hidden files, ``masks`` folders, thumbnails and deleted files that systems keep, workspaces of ours
    (folders with a run.json), and files whose extension says that they are no images. Folders that are symbolic links
    are not followed.
    Raises StageError if nothing remains and PermissionError for a folder that cannot be read.
    """
    found = files_below(root, is_photo_folder)
    if not found:
        raise _empty(root)
    photos, videos = [file for file in found if may_be_photo(file)], without_previews(found)
    unknown = not any(file.suffix.lower() in IMAGES + RAW_EXTENSIONS for file in photos)
    if len(videos) == 1 and unknown and len(photos) <= MAX_OTHER_FILES:
        photos = []  # a README, say; more of them may be photos of whatever ending
    lost = sum(not file.is_file() for file in found)
    if lost and not any(map(Path.is_file, photos + videos)):
        raise StageError(
            "ingest.broken-links",
            f"no photos in {root}",
            f"{lost} of its files are broken links",
            _LINKS_HINT,
        )
    if not photos and len(videos) != 1:
        raise _no_photos(root, found, videos)
    return tuple(photos or videos)


def walk_photos(root: Path) -> Iterator[Path]:
    """The files below ``root``, photos or not, in any order, but for hidden ones, masks and workspaces of ours."""
    return _walk(root, is_photo_folder)


def files_below(root: Path, enters: Callable[[Path], bool]) -> list[Path]:
    """The files below ``root`` that are not hidden, in folders that one ``enters``, sorted by relative name."""
    return sorted(_walk(root, enters), key=lambda file: file.relative_to(root).as_posix())


def _walk(root: Path, enters: Callable[[Path], bool]) -> Iterator[Path]:
    def fail(error: OSError) -> None:
        raise error

    for folder, subfolders, names in os.walk(root, onerror=fail):
        here = Path(folder)
        subfolders[:] = [s for s in subfolders if enters(here / s)]
        files = (here / name for name in names if not name.startswith("."))
        yield from (file for file in files if file.is_file() or _is_lost(file))


def _is_lost(file: Path) -> bool:
    """A link to a photo or video that is not there is rejected by name. Other links may have led to folders."""
    return file.suffix.lower() in IMAGES + _VIDEOS and file.is_symlink() and not file.exists()


def is_photo_folder(folder: Path) -> bool:
    """Whether photos are looked for in a folder: it is not hidden, holds no masks, is none that systems keep, and no
    workspace of ours."""
    name = folder.name.lower()
    return not name.startswith(".") and name not in (MASKS, *_OF_SYSTEMS) and not (folder / "run.json").is_file()


def may_be_photo(file: Path) -> bool:
    """Whether a file may be a photo by its ending."""
    return file.suffix.lower() not in _NOT_PHOTOS and not is_video(file)


def is_video(file: Path) -> bool:
    """Whether a file is a video by its ending."""
    return file.suffix.lower() in _VIDEOS


def without_previews(found: list[Path]) -> list[Path]:
    """The videos; previews of videos only where there is nothing else."""
    videos = [file for file in found if is_video(file)]
    return [file for file in videos if file.suffix.lower() not in _PREVIEWS] or videos


def _empty(root: Path) -> StageError:
    """The error for a folder without any file that is looked at."""
    why, hint = "it holds no file", FOLDER_HINT
    if link := next((one for one in sorted(root.iterdir()) if one.is_symlink() and one.is_dir()), None):
        why = f"it holds no file, and {link.name} is a link to a folder, which is not followed"
        hint = f"Give that folder: pipeline run {link.resolve()}"
    return StageError("ingest.empty-folder", f"{root} is empty", why, hint)


def _no_photos(root: Path, found: list[Path], videos: list[Path]) -> StageError:
    if videos:
        names = ", ".join(video.relative_to(root).as_posix() for video in videos[:5])
        return StageError("ingest.several-videos", 
            f"{len(videos)} videos in {root}", f"{names}: it is not clear which one to use",
            f"Give one of them: pipeline run {videos[0]}",
        )  # fmt: skip
    suffixes = ", ".join(sorted({file.suffix.lower() or file.name for file in found})[:5])
    return StageError(
        "ingest.no-photos",
        f"no photos in {root}",
        f"it has {counted(len(found), 'file')} ({suffixes}), but no image",
        FOLDER_HINT,
    )


def read_photo_list(file: Path) -> list[str]:
    """The lines of a text file, as they stand there, that are not blank and no comments (``#``): names of photos.
    Raises StageError where it cannot be read, is not UTF-8 or has none."""
    what = f"cannot use the photo list {file}"
    try:
        text = file.read_bytes().decode("utf-8-sig")  # -sig: Windows writes a byte order mark
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise StageError("ingest.photo-list-unreadable", what, why, _LIST_GONE) from error
    except UnicodeDecodeError as error:
        why = f"it is not text in UTF-8 (byte {error.start} is 0x{error.object[error.start]:02x})"
        raise StageError("ingest.photo-list-encoding", what, why, _LIST_HINT) from error
    names = [line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")]
    if not names:
        raise StageError("ingest.photo-list-empty", what, "it names no photo", _LIST_HINT)
    return names


def write_photo_list(file: Path, names: Iterable[str]) -> None:
    """Write a list that :func:`read_photo_list` reads, folders included."""
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = (f"./{name}" if name.lstrip().startswith("#") else name for name in names)
    file.write_bytes("".join(f"{line}\n" for line in lines).encode())
