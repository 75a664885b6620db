"""Depth maps on disk: a safetensors file per photo, packed by zlib."""

import zlib
from pathlib import Path

import numpy as np
from safetensors.numpy import load, save

from stages.depth.consistency import DepthMap
from stages.io.files import damaged, write_durably

FOLDER = "depth"
PACKING = 1  # zlib's level: higher ones take several times longer for a few percent


def depth_map_file(folder: Path, file: str) -> Path:
    """Where the depth map of a view lies in the stage's ``folder``; ``file`` is the view's."""
    return folder / FOLDER / f"{Path(file).name}.depth"


def write_depth_map(path: Path, depth: DepthMap) -> None:
    """Write a depth map, whole or not at all; equal ones give equal bytes. Raises OSError."""
    tensors = {"distance": depth.distance, "sigma": depth.sigma.astype(np.float16), "views": depth.views}
    write_durably(path, zlib.compress(save({name: np.ascontiguousarray(t) for name, t in tensors.items()}), PACKING))


def read_depth_map(path: Path) -> DepthMap:
    """Read a depth map. Raises StageError where it is missing or damaged."""
    try:
        tensors = load(zlib.decompress(path.read_bytes()))
        depth = DepthMap(tensors["distance"], tensors["sigma"].astype(np.float32), tensors["views"])
    except Exception as error:  # zlib, safetensors and numpy each have their own
        raise damaged("depth.damaged-map", path.name, f"{type(error).__name__}: {error}") from error
    return depth
