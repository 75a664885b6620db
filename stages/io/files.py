"""Files: JSON, safetensors, PNG and JPEG, written so that equal content is equal bytes; durably where it matters."""

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from stages.contract import StageError, bounded

if TYPE_CHECKING:
    import numpy as np
    from pydantic import ValidationError

    from nerf.geometry.scene import Scene

T = TypeVar("T")
SMALL_COPY = "small_mesh.safetensors"  # of stage mesh, for pages, which are to load without its libraries


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` with sorted keys and round-trip floats. Raises ValueError on NaN or infinity."""
    path.write_text(_as_json(value), "utf-8")


def write_json_durably(path: Path, value: Any) -> None:
    """:func:`write_json`, after a kill, a power cut or on a full disk whole or not at all."""
    write_durably(path, _as_json(value).encode())


def _as_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def read_json(path: Path) -> Any:
    """Read a JSON file that one of our stages wrote. Raises StageError where it is missing or damaged."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise damaged("io.damaged-json", path.name, str(error)) from error


def part_file(folder: Path, name: str) -> Path:
    """The file of this name in a folder, or where there is none the only one whose name differs in capitals alone, as
    programs on Windows need not care."""
    if (file := folder / name).is_file() or not folder.is_dir():
        return file
    alike = [one for one in folder.iterdir() if one.name.lower() == name.lower() and one.is_file()]
    return alike[0] if len(alike) == 1 else file


def stand_in(data: bytes) -> str | None:
    """Words for a file of which this is the beginning and that is not what its name says, but stands in for it; None
    for all others."""
    if not data:
        return "the file is empty"
    if data.startswith(b"version https://git-lfs"):
        return "it is a pointer of Git LFS and not the file itself; fetch it with git lfs pull"
    if data.lstrip()[:15].lower().startswith((b"<!doctype html", b"<html")):
        return "it is a web page and not the file itself; download it again"
    return None


def damaged(code: str, name: str, why: str) -> StageError:
    """The error for a file that one of our stages wrote and that is not any more as it was."""
    return StageError(code, f"cannot read {name}", why, "`pipeline resume WORKSPACE --verify` rebuilds it.")


def read_dataclass(path: Path, kind: type[T]) -> T:
    """Read a JSON file that one of our stages wrote as this dataclass, every field of its own type.

    Raises StageError where it is missing or damaged.
    """
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes(), strict=True)
    except OSError as error:
        raise damaged("io.missing-file", path.name, str(error)) from error
    except ValidationError as error:
        raise damaged("io.damaged-fields", path.name, first_fault(error)) from error


def first_fault(error: "ValidationError") -> str:
    """Where the first fault is and what, in one line."""
    fault = error.errors()[0]
    return bounded(f"{'.'.join(map(str, fault['loc'])) or 'it'}: {fault['msg']}")


def write_durably(path: Path, content: bytes) -> None:
    """Write a file so that after a kill or power cut it is either the old one or the new one, on the disk."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)
    sync_folder(path.parent)


def make_durable(folder: Path) -> None:
    """Have every file of a folder, and the folder, on the disk."""
    for path in folder.iterdir():
        sync_file(path)
    sync_folder(folder)


def sync_file(path: Path) -> None:
    """Have what a file holds on the disk."""
    with path.open("r+b") as stream:  # Windows syncs only what may be written to
        os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Make renames in ``folder`` durable, where the system can (not on Windows)."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_tensors(path: Path, tensors: "dict[str, np.ndarray]") -> None:
    """Write arrays as safetensors without metadata."""
    from safetensors.numpy import save

    path.write_bytes(save(tensors))  # save_file words a full disk as an error of its own kind


def read_tensors(path: Path) -> "dict[str, np.ndarray]":
    """Read arrays written by :func:`write_tensors`. Raises StageError where the file is missing or damaged."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return load(path.read_bytes())  # load_file takes paths in Unicode alone
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise damaged("io.damaged-tensors", path.name, str(error)) from error


def write_png(path: Path, pixels: "np.ndarray") -> None:
    """Write (height, width, 3 or 4) or grey (height, width) uint8, folders included; packed fast, for pictures hardly
    shrink any further. Raises StageError where :func:`check_png_encoder` does."""
    from PIL import Image

    check_png_encoder()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, format="PNG", compress_level=1)


def check_png_encoder() -> None:
    """Raise StageError where Pillow's PNG encoder would hang: on Linux, after pycolmap was loaded before Pillow, whose
    wheel brings another zlib. Our own modules load Pillow first (``stages.sfm.colmap``); a caller's may not."""
    loaded = list(sys.modules)
    if sys.platform != "linux" or not {"pycolmap", "PIL._imaging"} <= sys.modules.keys():
        return
    if loaded.index("pycolmap") < loaded.index("PIL._imaging"):
        raise StageError(
            "io.pycolmap-before-pillow",
            "No PNG file can be written in this process",
            "pycolmap was imported before Pillow, and their wheels bring different versions of zlib: Pillow's PNG "
            "encoder would hang",
            "Put `import PIL.Image` before the first `import pycolmap` of the program",
        )


def write_jpeg(path: Path, pixels: "np.ndarray", quality: int) -> None:
    """Write (height, width, 3) uint8, colours at full size: averaged over 2 × 2 pixels they would lose more than all
    the rest."""
    from PIL import Image

    Image.fromarray(pixels).save(path, format="JPEG", quality=quality, subsampling=0)


def read_scene(folder: Path) -> "Scene":
    """The scene that stage normalise left in ``folder``. Raises StageError where it is missing or damaged."""
    from nerf.geometry.scene import Scene

    value = read_json(folder / "scene.json")
    try:
        return Scene.from_json(value)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise damaged("io.damaged-scene", "scene.json", f"{type(error).__name__}: {error}") from error
