"""Files of known cameras: which they are, of all that lie in a folder, and what is said of others."""

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from stages.contract import StageError, listed
from stages.io.files import part_file
from stages.io.transforms_files import HELD_OUT, TRAIN

FEW_NAMES = 2
MAX_DEPTH = 4  # folders below one that is given, in which COLMAP models are looked for: colmap/sparse/0, dense/0/sparse
LLFF, LLFF_FILE = ".npy", "poses_bounds.npy"  # the ending of LLFF's file of cameras, and what it is called
_CONVERTER = "Export a COLMAP model, or make a transforms.json of it: ns-process-data {} --help (nerfstudio)"
# Files of cameras that are not read, by their endings: what they are, and what to do.
OTHER_CAMERAS = {
    ".xml": ("an XML file, as Metashape writes it", _CONVERTER.format("metashape")),
    ".csv": ("a table, as RealityScan writes it", _CONVERTER.format("realitycapture")),
    ".xmp": ("one photo's XMP file, as RealityScan writes it", _CONVERTER.format("realitycapture")),
    ".db": (
        "COLMAP's database, which holds features and matches but no poses",
        "Give the folder of its model (sparse/0), or leave out --cameras.",
    ),
    ".out": ("a Bundler file", ""),
    ".nvm": ("a VisualSFM file", ""),
    ".sfm": ("a Meshroom file", ""),
    ".abc": ("an Alembic file", ""),
    ".npz": ("a NumPy archive", ""),
}


def camera_files(folder: Path) -> tuple[Path, ...]:
    """The files in which known cameras may stand, of all that lie in a folder: those of a Blender-style scene, else
    those of a COLMAP model, binary ones before text, with the account of one of ours; none where it holds neither."""
    if (folder / TRAIN).is_file():
        return tuple(path for name in (TRAIN, *HELD_OUT) if (path := folder / name).is_file())
    account = own_registration(folder)
    return (*model_files(folder), *(() if account is None else (account,)))


def own_registration(model: Path) -> Path | None:
    """The registration.json beside a COLMAP model that stage sfm wrote, in its own folder or in ``output/``; None
    without."""
    account = model.parent / "registration.json"
    return account if model.name == "sparse" and account.is_file() else None


def cameras_in(folder: Path, photos: Sequence[str]) -> Path:
    """The one COLMAP model in ``folder``; where there is none the transforms.json, or the folder itself if it has a
    transforms_train.json."""
    found = [file for name in ("transforms.json", TRAIN) if (file := folder / name).is_file()]
    if not found or _colmap_models(folder):
        return colmap_model(folder, photos)
    if len(found) > 1:
        raise StageError("ingest.several-cameras", 
            f"two sources of cameras in {folder}", " and ".join(file.name for file in found),
            f"Give one of them: --cameras {found[0]}",
        )  # fmt: skip
    return folder if found[0].name == TRAIN else found[0]


def llff_in(cameras: Path) -> Path:
    """LLFF's file, where the cameras are a folder that holds no others; else the cameras as given."""
    file = cameras / LLFF_FILE
    others = (cameras / name for name in ("transforms.json", TRAIN))
    return file if file.is_file() and not any(map(Path.is_file, others)) and not _colmap_models(cameras) else cameras


def _colmap_models(folder: Path) -> list[Path]:
    """All COLMAP models in ``folder``: itself, and below it and its ``sparse`` folder; where there is none, deeper."""
    places = [folder, folder / "sparse"]
    places += [child for place in places if place.is_dir() for child in sorted(place.iterdir())]
    found = sorted({place for place in places if model_files(place)})
    return found or sorted(place for place in _below(folder, MAX_DEPTH) if model_files(place))


def _below(folder: Path, depth: int) -> Iterator[Path]:
    for child in folder.iterdir() if depth and folder.is_dir() else ():
        if child.is_dir() and not child.name.startswith(".") and not (child / "run.json").is_file():
            yield child
            yield from _below(child, depth - 1)


def colmap_model(folder: Path, photos: Sequence[str]) -> Path:
    """The one COLMAP model in ``folder``. Raises StageError where there is none, or several: then the one with the most
    of these ``photos`` is recommended, for the largest of COLMAP's models need not be its first."""
    models = _colmap_models(folder)
    if not models:
        raise StageError(
            "ingest.no-colmap-model",
            f"no COLMAP model in {folder}",
            _what_is_missing(folder),
            "Give the folder of a COLMAP model (sparse/0), a transforms.json or a poses_bounds.npy; or leave out "
            "--cameras to find the cameras from the photos.",
        )
    if len(models) > 1:
        counts = {model: _cameras_of(model, photos) for model in models}
        each = ", ".join(f"{counts[model]} ({model.relative_to(folder)})" for model in models)
        best = max(models, key=lambda model: counts[model])
        raise StageError(
            "ingest.several-colmap-models",
            f"{len(models)} COLMAP models in {folder}",
            f"of the {len(photos)} photos they have cameras for: {each}",
            f"Choose one, for example the one with most photos: --cameras {best}",
        )
    return models[0]


def _what_is_missing(folder: Path) -> str:
    names = [f"{part}{ending}" for part in ("cameras", "images") for ending in (".bin", ".txt")]
    paths = (place / name for place in (folder, *_below(folder, MAX_DEPTH)) for name in names)
    parts = [path.relative_to(folder).as_posix() for path in paths if path.is_file()]
    here = [path for path in folder.iterdir() if path.is_file()] if folder.is_dir() else []
    if parts:
        return f"a model needs cameras and images, both .bin or both .txt, and there is only {listed(parts, FEW_NAMES)}"
    if database := next((path.name for path in here if path.suffix.lower() == ".db"), None):
        return f"{database} is COLMAP's database: it holds features and matches but no poses"
    there = f"; it holds {listed(sorted(path.name for path in here), FEW_NAMES)}" if here else ""
    return f"it has no cameras and images files (.bin or .txt) and no transforms.json{there}"


def _cameras_of(model: Path, photos: Sequence[str]) -> int:
    """How many of the photos have a camera in a model, by the last parts of their names."""
    from stages.io.colmap_files import image_names

    own = {PurePosixPath(name).stem for name in photos}
    return len(own & {PurePosixPath(name.replace("\\", "/")).stem for name in image_names(model)})


def model_files(folder: Path) -> tuple[Path, ...]:
    """The files of the COLMAP model right in ``folder``, binary ones before text; none where there is no model."""
    for extension in (".bin", ".txt"):
        cameras, images, points = (
            part_file(folder, f"{part}{extension}") for part in ("cameras", "images", "points3D")
        )
        if cameras.is_file() and images.is_file():
            return (cameras, images, points) if points.is_file() else (cameras, images)
    return ()


def unknown_cameras(cameras: Path) -> StageError:
    """The error for a file that holds no cameras in a form that is read."""
    suffix = cameras.suffix.lower()
    what, hint = OTHER_CAMERAS.get(suffix, ("of an unknown kind", ""))
    if suffix in (".bin", ".txt"):
        what, hint = "one file of a COLMAP model", f"Give its folder: --cameras {cameras.parent}"
    return StageError(
        "ingest.unknown-cameras",
        f"cannot use the cameras {cameras.name}",
        f"it is {what}; supported are transforms files (.json), folders of COLMAP models and poses_bounds.npy",
        hint or "Export one of these, or leave out --cameras to find the cameras from the photos.",
    )
