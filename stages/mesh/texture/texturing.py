"""The texture of a surface from the training photos: photos chosen, atlas laid out, picture baked."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stages.hardware.memory import check_memory
from stages.mesh.photos.best_photos import BestPhotos
from stages.mesh.surface import Surface
from stages.mesh.texture.atlas import Texture, make_atlas
from stages.mesh.texture.baking import bake
from stages.mesh.texture.view_selection import choose, find_candidates

# Colours as they add up and as bytes, and what one photo adds: 17 measured at 7120 × 7048.
BYTES_PER_TEXEL = 18
UNSEEN_DENSITY = 0.25  # texels per unit of length where no photo sees the surface, over the median where one does


class Textured(NamedTuple):
    """A texture, the share of the surface's vertices that no photo colours, and the share of (vertex, photo) that was
    left out because the photo shows something else there."""

    texture: Texture
    unseen: float
    outliers: float


def texture_of(
    surface: Surface,
    field_colours: np.ndarray,
    best_photos: BestPhotos,
    max_size: int,
    report: Callable[[str, float], None],
) -> Textured | None:
    """The texture of a surface in the scene frame, at most ``max_size`` texels a side. ``field_colours`` (n, 3) sRGB
    uint8 of the vertices hold where no photo sees them. None where no photo sees any of the surface. Raises StageError
    where that is too small, too large for the memory, or a photo is gone."""
    photos, means = best_photos.photos, best_photos.means
    candidates = find_candidates(
        surface, best_photos, lambda done: report("choosing photos for the texture", 0.3 * done)
    )
    own = field_colours.astype(np.float32) / 255
    choice = choose(candidates, own, surface.faces, means, len(photos))
    best = np.sqrt(choice.candidates.pixels_of_best())
    seen = best > 0
    if not seen.any():
        return None
    least = UNSEEN_DENSITY * float(np.median(best[seen]))
    report("laying out the texture", 0.3)
    atlas = make_atlas(surface, np.maximum(best, least)[surface.faces].max(axis=1), max_size)
    needed, size = BYTES_PER_TEXEL * atlas.width * atlas.height, f"{atlas.width} × {atlas.height}"
    check_memory(
        needed, "the texture", f"{size} texels need", f"Try --mesh.texture-size {max(atlas.width, atlas.height) // 2}."
    )
    picture = bake(surface, atlas, photos, choice, means, lambda done: report("baking the texture", 0.35 + 0.65 * done))
    return Textured(Texture(atlas, picture), float(1 - seen.mean()), choice.outliers)
