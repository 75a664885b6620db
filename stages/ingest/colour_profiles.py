"""Colours of any ICC profile into sRGB."""

import io
from typing import Any

import numpy as np
from PIL import Image, ImageCms

_SRGB_TOLERANCE = 2  # of 255: profiles closer than this to sRGB are sRGB written by another hand


def to_srgb(image: Image.Image, profile: bytes | None, notes: list[str]) -> tuple[Image.Image, bool]:
    """``image`` as RGB or RGBA in sRGB, and whether its values already were sRGB."""
    mode = "RGBA" if image.mode in ("LA", "RGBA") else "RGB"
    if not profile:
        return image.convert(mode), True
    source = image.convert("RGBA") if image.mode == "LA" else image
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB"), source.mode, mode
        )
        if source.mode == mode and _is_identity(transform, mode):
            return source, True
        converted = ImageCms.applyTransform(source, transform) or source  # None only for in-place work
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        notes.append(f"colour profile ignored ({error})")
        return image.convert(mode), False
    return converted, False


def _is_identity(transform: Any, mode: str) -> bool:
    levels = np.arange(0, 256, 15, dtype=np.uint8)
    cube = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(len(levels), -1, 3)
    before = Image.fromarray(cube).convert(mode)
    after = ImageCms.applyTransform(before, transform)
    return int(np.abs(np.asarray(before, int) - np.asarray(after, int)).max()) <= _SRGB_TOLERANCE
