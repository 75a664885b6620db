"""Which photos see each vertex of a surface, and how well: the best of them, whatever their number.

A z-buffer of the surface from each camera tells what hides what. Where a surface hides another one, it is known to
about a voxel, so photos tell little next to silhouettes.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import csr_array

from nerf.geometry.scene import Scene
from nerf.runtime.parallel import in_order
from stages.mesh.grid_space import VoxelLengths
from stages.mesh.photos.photo import Photo, Projection, photos_of, projected, unmasked
from stages.mesh.rasteriser import nearest_faces
from stages.mesh.surface import Surface, neighbour_means, vertex_normals

KEPT_PHOTOS = 12  # per vertex, the best ones: what is in memory does not grow with the number of photos
MAX_MAP_SIDE = 400  # pixels of a depth map
MAX_OUTSIDE = 8  # such sides: faces that reach farther beside a photo are left out of its depth map
# Within MARGIN_VOXELS of a silhouette, a photo gives the surface behind nothing, unless no other sees it.
MARGIN_VOXELS, MAX_MARGIN_PX, IN_MARGIN = 2.0, 6, 1e-3
DEPTH_BIAS_VOXELS = 1.0
MIN_COSINE, MAX_TANGENT = 0.15, 5.0
BORDER = 0.03  # of a photo's smaller side: from there on to its edge a photo counts less and less
NORMAL_STEPS = 3  # over neighbours


class BestPhotos(NamedTuple):
    """The best ``photos`` of each vertex, (n, KEPT_PHOTOS): their ``number``, their sharp ``pixels`` per unit of area,
    their ``quality`` (these, less where a photo tells less; 0: none) and whether they show the surface ``whole``:
    nothing nearer or farther within a voxel of the vertex. ``means``: :func:`stages.mesh.surface.neighbour_means`."""

    photos: list[Photo]
    means: csr_array
    number: np.ndarray
    pixels: np.ndarray
    quality: np.ndarray
    whole: np.ndarray

    def seen(self) -> np.ndarray:
        """Which vertices a photo sees, (n,) bool."""
        return self.quality.max(axis=1, initial=0) > 0

    def of_part(self, part: Surface, vertex: np.ndarray) -> "BestPhotos":
        """Those of a part of the surface; ``vertex``: the old index of each of its vertices."""
        kept = (each[vertex] for each in (self.number, self.pixels, self.quality, self.whole))
        return BestPhotos(self.photos, neighbour_means(part), *kept)

    def centres(self) -> np.ndarray:
        """Where the photos were taken, (photos, 3)."""
        return np.array([photo.view.scene_from_camera[:, 3] for photo in self.photos])


class Sight(NamedTuple):
    """How one photo shows the vertices, (n,) each, as in :class:`BestPhotos`."""

    pixels: np.ndarray
    quality: np.ndarray
    whole: np.ndarray


def smooth_normals(surface: Surface, means: csr_array) -> np.ndarray:
    """Unit normals (n, 3) without the noise of single faces."""
    normals = vertex_normals(surface)
    for _ in range(NORMAL_STEPS):
        normals = means @ normals
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


def find_best_photos(
    surface: Surface,
    scene: Scene,
    ingest: Path,
    field: dict[str, Any],
    voxels: VoxelLengths,
    on_photo: Callable[[float], None],
) -> BestPhotos:
    """The best training photos of every vertex. ``field``: the content of field.json; ``voxels``: how well the surface
    is known where. Masks lie in the folder of stage ``ingest``."""
    photos, means = photos_of(scene, ingest, field), neighbour_means(surface)
    shape = len(surface.vertices), min(KEPT_PHOTOS, len(photos))
    arrays = (np.zeros(shape, kind) for kind in (np.int32, np.float32, np.float32, bool))
    kept = BestPhotos(photos, means, *arrays)
    normals = smooth_normals(surface, means)

    def seen_by(photo: Photo) -> Sight:
        return _sight(surface, normals, photo, voxels)

    for number, sight in enumerate(in_order(seen_by, photos, torch.device("cpu"))):
        _keep_best(kept, number, sight)
        on_photo((number + 1) / len(photos))
    return kept


def _sight(surface: Surface, normals: np.ndarray, photo: Photo, voxels: VoxelLengths) -> Sight:
    """A photo counts less towards its borders and next to silhouettes, and nothing where it is masked."""
    place = projected(photo, surface.vertices)
    towards = photo.view.scene_from_camera[:, 3] - surface.vertices
    distance = np.maximum(np.linalg.norm(towards, axis=1), np.finfo(float).tiny)
    cosine = (normals * towards).sum(axis=1) / distance
    ahead = place.inside & (cosine > MIN_COSINE) & (distance >= photo.view.near)
    visible, behind_edge, whole = _visible(surface, photo, place, cosine, voxels)
    size = np.array([photo.camera.width, photo.camera.height])
    border = np.minimum(place.pixels, size - place.pixels).min(axis=1) / (BORDER * size.min())
    pixels = cosine * (photo.focal_px / distance) ** 2 * np.clip(photo.sharpness, 0.1, 1.0)
    pixels = np.where(ahead & visible, pixels, 0.0).astype(np.float32)
    counts = np.where(behind_edge, IN_MARGIN, 1.0) * np.clip(border, 0.01, 1) * unmasked(photo, place)
    return Sight(pixels, (pixels * counts).astype(np.float32), whole)


def _visible(
    surface: Surface, photo: Photo, place: Projection, cosine: np.ndarray, voxels: VoxelLengths
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which vertices nothing hides, which are next to the silhouette of what lies before them, and which neither
    to that nor to the silhouette of their own surface."""
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
    edge, margin = (int(np.clip(np.ceil(each * focal * known), 1, MAX_MARGIN_PX)) for each in (1.0, MARGIN_VOXELS))
    column, row = np.clip(pixels.astype(np.int64), 0, [width - 1, height - 1]).T
    tangent = np.sqrt(1 / np.maximum(cosine, MIN_COSINE) ** 2 - 1).clip(max=MAX_TANGENT)

    def within(reach: int, nearer: bool) -> np.ndarray:
        """Whether anything is nearer, or farther, than the surface so many pixels around each vertex can be."""
        extreme = (minimum_filter if nearer else maximum_filter)(depth, size=2 * reach + 1, mode="nearest")[row, column]
        slack = DEPTH_BIAS_VOXELS * voxels.along + (reach + 0.5) * tangent * place.depth / focal
        return extreme < place.depth - slack if nearer else extreme > place.depth + slack

    whole = ~within(edge, nearer=True) & ~within(edge, nearer=False)
    return ~within(1, nearer=True), within(margin + 1, nearer=True), whole


def _keep_best(kept: BestPhotos, number: int, sight: Sight) -> None:
    """Put a photo in the place of the worst one of each vertex that it is better at."""
    vertex = np.flatnonzero(sight.quality)
    slot = kept.quality[vertex].argmin(axis=1)
    better = sight.quality[vertex] > kept.quality[vertex, slot]
    vertex, slot = vertex[better], slot[better]
    kept.number[vertex, slot] = number
    for ours, its in zip((kept.pixels, kept.quality, kept.whole), sight, strict=True):
        ours[vertex, slot] = its[vertex]
