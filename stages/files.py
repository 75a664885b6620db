"""Small files the stages exchange: canonical JSON and safetensors, written so that equal content is equal bytes."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.contract import StageError

if TYPE_CHECKING:
    import numpy as np

    from nerf.scene import Scene


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` with sorted keys and round-trip floats. Raises ValueError on NaN or infinity."""
    path.write_text(json.dumps(value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n", "utf-8")


def read_json(path: Path) -> Any:
    """Read a JSON file that one of our stages wrote."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise StageError(f"cannot read {path.name}", str(error), "Delete its folder and run again.") from error


def write_tensors(path: Path, tensors: "dict[str, np.ndarray]") -> None:
    """Write arrays as safetensors without metadata."""
    from safetensors.numpy import save_file

    save_file(tensors, path)


def read_tensors(path: Path) -> "dict[str, np.ndarray]":
    """Read arrays written by :func:`write_tensors`."""
    from safetensors.numpy import load_file

    return load_file(path)


def read_scene(folder: Path) -> "Scene":
    """The scene that stage normalise left in ``folder``."""
    from nerf.scene import Scene

    return Scene.from_json(read_json(folder / "scene.json"))
