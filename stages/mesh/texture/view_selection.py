"""Which photos colour which part of a surface, and which of them show something else there.

Per vertex the best photos are kept that see it, with what each shows of it at the scale of the surface's edges. What
most of them and the field agree on is its colour; photos that differ from it far more than the others do (somebody
walked by, a reflection) give none. The photo that sees a vertex most sharply then gives nearly all of the detail
(Waechter et al. 2014 choose one photo per face; weights that change smoothly over the surface leave no seams).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from scipy.sparse import csr_array

from nerf.runtime.parallel import in_order
from stages.mesh.grid_space import VoxelLengths
from stages.mesh.rasteriser import nearest_faces
from stages.mesh.surface import Surface, face_area_vectors, vertex_normals
from stages.mesh.texture.photos import Photo, Picture, Projection, colours_at, projected, read_picture, used_at

KEPT_PHOTOS = 12  # per vertex, the best ones: what is in memory does not grow with the number of photos
MAX_MAP_SIDE = 400  # pixels of a depth map
MAX_OUTSIDE = 8  # such sides: faces that reach farther beside a photo are left out of its depth map
# Where a surface hides another one, it is known to about a voxel: within MARGIN_VOXELS of a silhouette, a photo gives
# the surface behind nothing, unless no other sees it.
MARGIN_VOXELS, MAX_MARGIN_PX, IN_MARGIN = 2.0, 6, 1e-3
DEPTH_BIAS_VOXELS = 1.0
MIN_COSINE, MAX_TANGENT = 0.15, 5.0
BORDER = 0.03  # of a photo's smaller side: from there on to its edge a photo counts less and less
SATURATED, OF_SATURATED = 0.985, 0.05  # a photo's colour above which its light is not known, and what it counts then
NORMAL_STEPS, WEIGHT_STEPS = 3, 2  # over neighbours
SHARPNESS_POWER = 4.0  # of a photo's pixels per area, over those of others: 2 times as many weigh 16 times as much
MIN_WEIGHT = 0.08  # of what all photos weigh: less is left out
# A photo shows something else where it is OUTLIER_SPREADS times as far from the median as the median photo is, and
# MIN_OUTLIER at least, in sRGB, and so are OUTLIER_SHARE of the neighbours.
OUTLIER_SPREADS, MIN_OUTLIER, OUTLIER_SHARE, OUTLIER_STEPS = 3.0, 0.10, 0.25, 3


class Candidates(NamedTuple):
    """The best photos of each vertex, (n, KEPT_PHOTOS): their index, their sharp ``pixels`` per unit of area, their
    ``quality`` (these, less where a photo tells less; 0: none), and their ``colour`` (n, KEPT_PHOTOS, 3) at the scale
    of the surface's edges."""

    photo: np.ndarray
    pixels: np.ndarray
    quality: np.ndarray
    colour: np.ndarray

    def pixels_of_best(self) -> np.ndarray:
        """Those of the best photo of each vertex, (n,); 0 where no photo sees it."""
        best = self.quality.argmax(axis=1)[:, None]
        pixels, quality = (np.take_along_axis(each, best, axis=1)[:, 0] for each in (self.pixels, self.quality))
        return np.where(quality > 0, pixels, 0)


class Shown(NamedTuple):
    """What one photo shows of some vertices, as in :class:`Candidates`."""

    pixels: np.ndarray
    quality: np.ndarray
    colour: np.ndarray


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


def neighbour_means(surface: Surface) -> csr_array:
    """The matrix that takes the mean of each vertex and its neighbours, (n, n) float32."""
    count = len(surface.vertices)
    edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    row, column = np.concatenate([edges, edges[:, ::-1], np.arange(count)[:, None].repeat(2, axis=1)]).T
    means = csr_array((np.ones(len(row), np.float32), (row, column)), (count, count))
    means.sum_duplicates()
    length = np.diff(means.indptr)
    means.data[:] = np.repeat(1 / length, length)
    return means


def find_candidates(
    surface: Surface, photos: Sequence[Photo], means: csr_array, voxels: VoxelLengths, on_photo: Callable[[float], None]
) -> Candidates:
    """The best photos of every vertex. ``voxels``: how well it is known where."""
    count, slots = len(surface.vertices), min(KEPT_PHOTOS, len(photos))
    kept = Candidates(
        np.zeros((count, slots), np.int32),
        np.zeros((count, slots), np.float32),
        np.zeros((count, slots), np.float32),
        np.zeros((count, slots, 3), np.float32),
    )
    normals = vertex_normals(surface)
    for _ in range(NORMAL_STEPS):
        normals = means @ normals
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    edge = float(np.sqrt(np.median(np.linalg.norm(face_area_vectors(*surface), axis=1))))

    def seen_by(photo: Photo) -> tuple[np.ndarray, Shown]:
        place = projected(photo, surface.vertices)
        pixels, counts = _pixels(surface, normals, photo, place, voxels)
        seen = np.flatnonzero(pixels * counts)
        if len(seen) == 0:
            return seen, Shown(pixels[seen], counts[seen], np.zeros((0, 3), np.float32))
        edge_px = edge * photo.focal_px / float(np.median(place.depth[seen]))
        picture = read_picture(photo, max(1.0, edge_px))
        colour, told = _shown(photo, picture, place.pixels[seen], surface.vertices[seen])
        return seen, Shown(pixels[seen], pixels[seen] * counts[seen] * told, colour)

    for index, (seen, shown) in enumerate(in_order(seen_by, photos, torch.device("cpu"))):
        _keep_best(kept, seen, index, shown)
        on_photo((index + 1) / len(photos))
    return kept


def _pixels(
    surface: Surface, normals: np.ndarray, photo: Photo, place: Projection, voxels: VoxelLengths
) -> tuple[np.ndarray, np.ndarray]:
    """How finely a photo shows each vertex, its sharp pixels per unit of area, 0 where it does not see it; and what
    each of these counts: less towards the photo's borders and next to silhouettes. Both (n,) float32."""
    towards = photo.view.scene_from_camera[:, 3] - surface.vertices
    distance = np.linalg.norm(towards, axis=1)
    cosine = (normals * towards).sum(axis=1) / np.maximum(distance, np.finfo(float).tiny)
    ahead = place.inside & (cosine > MIN_COSINE) & (distance >= photo.view.near)
    clear, near_edge = _visible(surface, photo, place, cosine, voxels)
    size = np.array([photo.camera.width, photo.camera.height])
    border = np.minimum(place.pixels, size - place.pixels).min(axis=1) / (BORDER * size.min())
    pixels = cosine * (photo.focal_px / np.maximum(distance, np.finfo(float).tiny)) ** 2
    sharp = np.where(ahead & clear, pixels * np.clip(photo.sharpness, 0.1, 1.0), 0.0)
    return sharp.astype(np.float32), (np.where(near_edge, IN_MARGIN, 1.0) * np.clip(border, 0.01, 1)).astype(np.float32)


def _visible(
    surface: Surface, photo: Photo, place: Projection, cosine: np.ndarray, voxels: VoxelLengths
) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices nothing hides, and which of these are next to the silhouette of what lies before them."""
    shrink = max(photo.camera.width, photo.camera.height) / MAX_MAP_SIDE
    width, height = (max(1, round(side / shrink)) for side in (photo.camera.width, photo.camera.height))
    pixels = place.pixels * [width / photo.camera.width, height / photo.camera.height]
    ahead = place.ahead & (np.abs(pixels) < MAX_OUTSIDE * MAX_MAP_SIDE).all(axis=1)
    faces = surface.faces[ahead[surface.faces].all(axis=1)]
    nearness = nearest_faces(pixels, place.depth, faces, width, height)[1].reshape(height, width)
    with np.errstate(divide="ignore"):
        depth = 1 / nearness  # infinite where there is nothing
    focal = photo.focal_px * width / photo.camera.width
    seen = place.inside & ahead
    known = float(np.median(voxels.across[seen] / place.depth[seen])) if seen.any() else 0.0
    margin = int(np.clip(np.ceil(MARGIN_VOXELS * focal * known), 1, MAX_MARGIN_PX))
    column, row = np.clip(pixels.astype(np.int64), 0, [width - 1, height - 1]).T
    tangent = np.sqrt(1 / np.maximum(cosine, MIN_COSINE) ** 2 - 1).clip(max=MAX_TANGENT)
    hidden = []
    for reach in (1, margin + 1):
        before = minimum_filter(depth, size=2 * reach + 1, mode="nearest")[row, column]
        slack = DEPTH_BIAS_VOXELS * voxels.along + (reach + 0.5) * tangent * place.depth / focal
        hidden.append(place.depth > before + slack)
    return ~hidden[0], hidden[1]


def _shown(photo: Photo, picture: Picture, pixels: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a photo shows of points, and what that counts: nothing where masked, less where saturated."""
    colour = colours_at(photo, picture, pixels, points)
    plain = colours_at(photo._replace(effects=(), shown=()), picture, pixels, points)
    counts = np.where((plain > SATURATED).any(axis=1), OF_SATURATED, 1.0) * used_at(photo, picture, pixels)
    return colour, counts.astype(np.float32)


def _keep_best(kept: Candidates, vertex: np.ndarray, photo: int, shown: Shown) -> None:
    """Put a photo in the place of the worst one of each vertex that it is better at."""
    worst = kept.quality[vertex].argmin(axis=1)
    better = shown.quality > kept.quality[vertex, worst]
    vertex, slot = vertex[better], worst[better]
    kept.photo[vertex, slot] = photo
    for ours, its in zip(kept[1:], shown, strict=True):
        ours[vertex, slot] = its[better]


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
