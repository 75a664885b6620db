"""A small picture, and files of it with what cameras write into EXIF."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

WIDTH, HEIGHT = 48, 32


def smooth(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A picture without symmetry that survives JPEG."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return np.rint(255 * np.stack([0.1 + 0.8 * x, 0.9 - 0.7 * y, 0.2 + 0.5 * x * y], axis=-1)).astype(np.uint8)


def saved(path: Path, image: Image.Image, **options: Any) -> Path:
    image.save(path, **options)
    return path


def exif_with(orientation: int | None = None, **tags: Any) -> Image.Exif:
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    for tag in ("Make", "Model"):
        if tag in tags:
            exif[ExifTags.Base[tag]] = tags.pop(tag)
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base[tag]: value for tag, value in tags.items()})
    return exif
