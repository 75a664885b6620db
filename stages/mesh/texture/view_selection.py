"""Which photos colour which part of a surface, and which of them show something else there.

Of each vertex it is known what the best photos that see it show of it, at the scale of the surface's edges. What
most of them and the field agree on is its colour; photos that differ from it far more than the others do (somebody
walked by, a reflection) give none. The photo that sees a vertex most sharply then gives nearly all of the detail
(Waechter et al. 2014 choose one photo per face; weights that change smoothly over the surface leave no seams).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array

from nerf.runtime.parallel import in_order
from stages.mesh.photos.best_photos import BestPhotos
from stages.mesh.photos.photo import Photo, Picture, colours_at, projected, read_picture, used_at
from stages.mesh.surface import Surface, face_area_vectors

SATURATED, OF_SATURATED = 0.985, 0.05  # a photo's colour above which its light is not known, and what it counts then
WEIGHT_STEPS = 2  # over neighbours
SHARPNESS_POWER = 4.0  # of a photo's pixels per area, over those of others: 2 times as many weigh 16 times as much
MIN_WEIGHT = 0.08  # of what all photos weigh: less is left out
# A photo shows something else where it is OUTLIER_SPREADS times as far from the median as the median photo is, and
# MIN_OUTLIER at least, in sRGB, and so are OUTLIER_SHARE of the neighbours.
OUTLIER_SPREADS, MIN_OUTLIER, OUTLIER_SHARE, OUTLIER_STEPS = 3.0, 0.10, 0.25, 3


class Candidates(NamedTuple):
    """The best photos of each vertex as in :class:`BestPhotos`, their ``quality`` less where they are saturated, and
    their ``colour`` (n, KEPT_PHOTOS, 3) at the scale of the surface's edges."""

    photo: np.ndarray
    pixels: np.ndarray
    quality: np.ndarray
    colour: np.ndarray

    def pixels_of_best(self) -> np.ndarray:
        """Those of the best photo of each vertex, (n,); 0 where no photo sees it."""
        best = self.quality.argmax(axis=1)[:, None]
        pixels, quality = (np.take_along_axis(each, best, axis=1)[:, 0] for each in (self.pixels, self.quality))
        return np.where(quality > 0, pixels, 0)


class Choice(NamedTuple):
    """``weights``: per photo, the vertices that it colours and what it gives of each; together 1, and 0 where none sees
    one. ``colour`` (n, 3): what a vertex shows at the scale of the surface's edges; ``candidates`` without those that
    show something else; ``outliers``: how many of them there were, as a share."""

    weights: list[tuple[np.ndarray, np.ndarray]]
    colour: np.ndarray
    candidates: Candidates
    outliers: float

    def weight(self, photo: int) -> np.ndarray:
        """What a photo gives of every vertex, (n,) float32."""
        dense = np.zeros(len(self.colour), np.float32)
        vertex, weight = self.weights[photo]
        dense[vertex] = weight
        return dense


def find_candidates(surface: Surface, best_photos: BestPhotos, on_photo: Callable[[float], None]) -> Candidates:
    """What the best photos show of every vertex."""
    edge = float(np.sqrt(np.median(np.linalg.norm(face_area_vectors(*surface), axis=1))))
    quality = best_photos.quality.copy()
    colour = np.zeros((*quality.shape, 3), np.float32)

    def shown_by(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        photo = best_photos.photos[number]
        vertex, slot = np.nonzero((best_photos.number == number) & (best_photos.quality > 0))
        if len(vertex) == 0:
            return vertex, slot, np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        points = surface.vertices[vertex]
        place = projected(photo, points)
        edge_px = edge * photo.focal_px / float(np.median(place.depth))
        return vertex, slot, *_shown(photo, read_picture(photo, max(1.0, edge_px)), place.pixels, points)

    photos = range(len(best_photos.photos))
    for number, (vertex, slot, shown, told) in enumerate(in_order(shown_by, photos, torch.device("cpu"))):
        colour[vertex, slot] = shown
        quality[vertex, slot] *= told
        on_photo((number + 1) / len(photos))
    return Candidates(best_photos.number, best_photos.pixels, quality, colour)


def _shown(photo: Photo, picture: Picture, pixels: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a photo shows of points, and what that counts: nothing where masked, less where saturated."""
    colour = colours_at(photo, picture, pixels, points)
    plain = colours_at(photo._replace(effects=(), shown=()), picture, pixels, points)
    counts = np.where((plain > SATURATED).any(axis=1), OF_SATURATED, 1.0) * used_at(photo, picture, pixels)
    return colour, counts.astype(np.float32)


def choose(candidates: Candidates, field: np.ndarray, faces: np.ndarray, means: csr_array, photos: int) -> Choice:
    """What each of so many photos gives of each vertex; ``field`` (n, 3): the field's colours, sRGB in [0, 1], which
    count as one photo's, and alone where none sees a vertex."""
    quality, before = candidates.quality.copy(), np.count_nonzero(candidates.quality)
    quality[_outliers(candidates, field, means, photos)] = 0
    candidates = candidates._replace(quality=quality)
    share = quality / np.maximum(quality.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    mean = (share[:, :, None] * candidates.colour).sum(axis=1)
    colour = np.where(quality.max(axis=1, initial=0)[:, None] > 0, mean, field).astype(np.float32)
    outliers = 1 - np.count_nonzero(quality) / max(before, 1)
    return Choice(_weights(quality, candidates.photo, faces, means, photos), colour, candidates, outliers)


def _outliers(candidates: Candidates, field: np.ndarray, means: csr_array, photos: int) -> np.ndarray:
    """Which candidates show something else than the others do, (n, KEPT_PHOTOS) bool."""
    there = candidates.quality > 0
    colours = np.concatenate([candidates.colour, field[:, None]], axis=1)
    colours[:, :-1][~there] = np.nan
    middle = np.nanmedian(colours, axis=1)
    distance = np.abs(candidates.colour - middle[:, None]).max(axis=2)
    distance[~there] = np.nan
    with_field = np.concatenate([distance, np.abs(field - middle).max(axis=1)[:, None]], axis=1)
    far = distance > np.maximum(OUTLIER_SPREADS * np.nanmedian(with_field, axis=1), MIN_OUTLIER)[:, None]
    found = np.zeros_like(there)
    for index in range(photos):
        mine = there & (candidates.photo == index)
        vertex, slot = np.nonzero(mine)
        if not far[mine].any():
            continue
        known, odd = np.zeros(len(there), np.float32), np.zeros(len(there), np.float32)
        known[vertex], odd[vertex] = 1, far[vertex, slot]
        for _ in range(OUTLIER_STEPS):
            known, odd = means @ known, means @ odd
        found[vertex, slot] = odd[vertex] > OUTLIER_SHARE * known[vertex]
    return found


def _weights(
    quality: np.ndarray, photo: np.ndarray, faces: np.ndarray, means: csr_array, photos: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What each photo gives of each vertex: by the power of its quality, smooth over neighbours, and nothing beside
    vertices that it does not see."""
    best = np.maximum(quality.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    raw = (quality / best) ** SHARPNESS_POWER
    raw /= np.maximum(raw.sum(axis=1, keepdims=True), 1)
    raw[raw < MIN_WEIGHT] = 0
    given, total = [], np.zeros(len(quality), np.float32)
    for index in range(photos):
        mine = (photo == index) & (quality > 0)
        seen = mine.any(axis=1)
        partly = faces[~seen[faces].all(axis=1)]
        weight = np.where(mine, raw, 0).sum(axis=1)
        for _ in range(WEIGHT_STEPS):
            weight = means @ weight
        weight[~seen] = 0
        weight[partly] = 0
        vertex = np.flatnonzero(weight)
        given.append((vertex, weight[vertex]))
        total += weight
    return [(vertex, weight / total[vertex]) for vertex, weight in given]
