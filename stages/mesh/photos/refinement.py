"""A surface moved to where the photos agree that it is.

A field's surface is known to a voxel or so, and a pixel of the photos is finer. Around each vertex a patch of its
tangent plane is shown by the photos that see it; where the surface is right, they show the same. So the vertex is moved
along its normal and the agreement is measured at each offset: the mean zero-mean normalised cross-correlation of all
pairs of photos, which exposure does not matter to (multi-view stereo on a mesh: Furukawa and Ponce 2010; Vu et al.
2012). All offsets o, in voxels, are then found together. They minimise

    Σ w (o − ô)² + Σ p o² + SMOOTHNESS Σ over edges (o_i − o_j)² + FAIRNESS Σ s e |umbrella|²

with ô the offset of best agreement and w what it is worth: the curvature of the agreement there, by its height. p is
PRIOR where two photos show a vertex and UNSEEN elsewhere: a bare wall follows its neighbours, and what no photo sees
stays. The umbrella vector of the moved surface, along the normals, bends it back. It counts where photos tell about the
surface, s: elsewhere it would shrink what is thin. That of edges of length h is h² / 4 of the curvature, which
e = (FAIR_EDGE / h)⁴ undoes, for h within EDGES: a surface is as smooth whatever its edges. Photos that show a
silhouette next to a vertex take no part there: its patch would be one half of what moves behind it. Constants:
docs/experiments/mesh.md.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg

from nerf.runtime.parallel import in_order
from stages.mesh.grid_space import VoxelLengths
from stages.mesh.photos.best_photos import BestPhotos, smooth_normals
from stages.mesh.photos.photo import Photo, projected, read_picture
from stages.mesh.surface import Surface, face_area_vectors

USED_PHOTOS = 5  # per vertex: the best, and those that look from elsewhere
APART = np.radians(12.0)  # photos farther apart than this are no better
SIDE = 7  # samples along an edge of a patch
PIXELS_PER_SAMPLE = 1.2
NOISE = 1.0  # deviation of a pixel, of 255, in a patch
MAX_PICTURE_BYTES = 1 << 29  # of all photos; where these are more, they are smaller
CHUNK = 1 << 10  # vertices at a time: what fits into a processor's cache
PRIOR, UNSEEN, SMOOTHNESS, FAIRNESS = 0.01, 0.3, 0.1, 1.0
FAIR_EDGE, EDGES = 1.5, (0.5, 2.0)  # voxels
SUPPORTED = 0.3  # what an offset is worth from where on curvature counts in full
TOLERANCE, MAX_ITERATIONS = 1e-4, 300
UNTURNED_STEPS = 3
MIN_SEEN = 100  # vertices that two photos show; of fewer nothing is said


class Sweep(NamedTuple):
    """Offsets to try: patches of ``half`` their width, as far as ``reach`` to either side in so many ``steps``; in
    voxels."""

    half: float
    reach: float
    steps: int

    def places(self) -> np.ndarray:
        """The offsets from the inside to the outside, in reaches: -1 … 1, (2 steps + 1,)."""
        return np.arange(-self.steps, self.steps + 1, dtype=np.float32) / max(self.steps, 1)


COARSE, FINE = Sweep(1.5, 2.0, 8), Sweep(1.0, 0.75, 4)
IN_PLACE = Sweep(FINE.half, 0.0, 0)


class Refined(NamedTuple):
    """``surface``, and of its vertices that two photos show: ``shift``, how far they moved, the median in voxels, and
    the mean agreement of the photos ``before`` and ``after``, 1 at most. ``kept``: whether that is better; if not, the
    surface is as it was."""

    surface: Surface
    shift: float
    before: float
    after: float

    @property
    def kept(self) -> bool:
        return self.after > self.before


class Grey(NamedTuple):
    """A photo for matching: its grey values and which pixels count, (h, w) uint8."""

    photo: Photo
    pixels: np.ndarray
    used: np.ndarray


class Patches(NamedTuple):
    """Of some vertices: places (n, 3), unit normals (n, 3), the ``photos`` that show each (n, USED_PHOTOS), -1 for
    none, and a voxel in scene units (n,), ``across`` the line of sight and along the ``normal``."""

    points: np.ndarray
    normals: np.ndarray
    photos: np.ndarray
    across: np.ndarray
    normal: np.ndarray

    def shared(self) -> np.ndarray:
        """Whether two photos show a vertex, (n,) bool."""
        return (self.photos >= 0).sum(axis=1) > 1


def refine(
    surface: Surface, best_photos: BestPhotos, voxels: VoxelLengths, report: Callable[[float], None]
) -> Refined | None:
    """Move the vertices of a surface; faces stay. ``voxels``: how well each vertex is known. None where two photos show
    hardly anything of it. Raises StageError where a photo is gone."""
    photos = _photos_apart(surface, best_photos)
    patches = _patches(surface, best_photos, photos, voxels)
    seen = patches.shared()
    if seen.sum() < MIN_SEEN:
        return None
    fine = _pictures(surface, best_photos, photos, voxels, report)
    coarse = {number: _coarser(grey) for number, grey in fine.items()}
    before = _agreement(patches, fine, IN_PLACE)[seen]
    moved = surface
    for sweep, pictures, done in ((COARSE, coarse, 0.7), (FINE, fine, 0.95)):
        offset, worth = _best_offsets(_agreement(patches, pictures, sweep), sweep, best_photos.means)
        step = _balanced(moved, patches, offset, worth, best_photos.means).clip(-sweep.reach, sweep.reach)
        shifted = moved.vertices + patches.normals * (step * patches.normal)[:, None]
        moved = Surface(_unturned(moved, shifted), moved.faces)
        patches = _patches(moved, best_photos, photos, voxels)
        report(done)
    after = _agreement(patches, fine, IN_PLACE)[seen]
    shift = (np.linalg.norm(moved.vertices - surface.vertices, axis=1) / voxels.across)[seen]
    refined = Refined(moved, float(np.median(shift)), float(before.mean()), float(after.mean()))
    return refined if refined.kept else refined._replace(surface=surface, shift=0.0)


def _photos_apart(surface: Surface, best_photos: BestPhotos) -> np.ndarray:
    """For each vertex the best photo, then by turns the best of the others times how far apart it looks from."""
    count, slots = best_photos.number.shape
    towards = best_photos.centres()[best_photos.number] - surface.vertices[:, None]
    towards = (towards / np.linalg.norm(towards, axis=2, keepdims=True)).astype(np.float32)
    found, row = np.full((count, USED_PHOTOS), -1), np.arange(count)
    gain = np.where(best_photos.whole, best_photos.quality, 0)
    for turn in range(min(USED_PHOTOS, slots)):
        best = gain.argmax(axis=1)
        left = gain[row, best] > 0
        found[left, turn] = best_photos.number[row, best][left]
        cosine = np.einsum("nsc,nc->ns", towards, towards[row, best])
        gain *= np.minimum(np.arccos(cosine.clip(-1, 1)) / APART, 1)
        gain[row, best] = 0
    return found


def _pictures(
    surface: Surface, best_photos: BestPhotos, photos: np.ndarray, voxels: VoxelLengths, report: Callable[[float], None]
) -> dict[int, Grey]:
    """Each photo that shows a vertex, at a size at which samples of the fine patches are PIXELS_PER_SAMPLE apart."""
    centres, downscale, pixels = best_photos.centres(), dict[int, float](), 0.0
    for number in np.unique(photos[photos >= 0]).tolist():
        photo, vertex = best_photos.photos[number], np.flatnonzero((photos == number).any(axis=1))
        distance = np.linalg.norm(surface.vertices[vertex] - centres[number], axis=1)
        apart = 2 * FINE.half / (SIDE - 1) * float(np.median(voxels.across[vertex] / distance)) * photo.focal_px
        downscale[number] = max(1.0, apart / PIXELS_PER_SAMPLE)
        pixels += photo.camera.width * photo.camera.height / downscale[number] ** 2
    smaller = max(1.0, (2 * pixels / MAX_PICTURE_BYTES) ** 0.5)

    def read(number: int) -> Grey:
        photo = best_photos.photos[number]
        picture = read_picture(photo, smaller * downscale[number])
        return Grey(photo, np.asarray(cv2.cvtColor(picture.pixels, cv2.COLOR_RGB2GRAY)), picture.used)

    found = dict[int, Grey]()
    for number, grey in zip(downscale, in_order(read, downscale, torch.device("cpu")), strict=True):
        found[number] = grey
        report(0.3 * len(found) / len(downscale))
    return found


def _coarser(grey: Grey) -> Grey:
    """At the size for the coarse patches."""
    height, width = (max(1, round(side * FINE.half / COARSE.half)) for side in grey.pixels.shape)
    pixels = cv2.resize(grey.pixels, (width, height), interpolation=cv2.INTER_AREA)
    used = cv2.resize(grey.used, (width, height), interpolation=cv2.INTER_NEAREST)
    return Grey(grey.photo, np.asarray(pixels), np.asarray(used))


def _patches(surface: Surface, best_photos: BestPhotos, photos: np.ndarray, voxels: VoxelLengths) -> Patches:
    normals = smooth_normals(surface, best_photos.means)
    sight = surface.vertices - best_photos.centres()[photos[:, 0].clip(0)]
    cosine = (sight * normals).sum(axis=1) / np.maximum(np.linalg.norm(sight, axis=1), np.finfo(float).tiny)
    normal = np.sqrt((cosine * voxels.along) ** 2 + (1 - cosine**2).clip(0) * voxels.across**2)
    return Patches(surface.vertices, normals, photos, voxels.across, normal)


def _agreement(patches: Patches, pictures: dict[int, Grey], sweep: Sweep) -> np.ndarray:
    """The agreement of the photos at every vertex and offset, (n, offsets); 0 where fewer than two see it."""
    order = np.lexsort(patches.photos.T[::-1])  # those that the same photos show

    def of_chunk(start: int) -> np.ndarray:
        some = order[start : start + CHUNK]
        return _chunk_agreement(Patches(*(part[some] for part in patches)), pictures, sweep)

    found = np.concatenate(list(in_order(of_chunk, range(0, len(order), CHUNK), torch.device("cpu"))))
    curves = np.empty_like(found)
    curves[order] = found
    return curves


def _chunk_agreement(patches: Patches, pictures: dict[int, Grey], sweep: Sweep) -> np.ndarray:
    """Of patches p of unit norm, the mean product of all pairs is (|Σ p|² − Σ |p|²) / (k (k − 1))."""
    shape = len(patches.points), 2 * sweep.steps + 1
    total, own = np.zeros((*shape, SIDE * SIDE), np.float32), np.zeros(shape, np.float32)
    count = np.zeros(shape[0], np.float32)
    for number in np.unique(patches.photos[patches.photos >= 0]).tolist():
        vertex = np.flatnonzero((patches.photos == number).any(axis=1))
        which, shown = _shown(Patches(*(part[vertex] for part in patches)), pictures[number], sweep)
        vertex = vertex[which]
        shown -= shown.mean(axis=2, keepdims=True)
        square = np.einsum("nos,nos->no", shown, shown)
        shown /= np.sqrt(square + (SIDE * NOISE) ** 2)[..., None]
        total[vertex] += shown
        own[vertex] += square / (square + (SIDE * NOISE) ** 2)
        count[vertex] += 1
    pairs = np.maximum(count * (count - 1), 1)[:, None]
    together = np.einsum("nos,nos->no", total, total)
    return np.where(count[:, None] > 1, (together - own) / pairs, 0)


class Affine(NamedTuple):
    """Where a photo shows some patches, pixels (m, 2): their ``middle``, from there half a patch ``across`` and ``up``,
    and along the normal to the end of a sweep, ``along`` + ``bend`` outwards and ``bend`` − ``along`` inwards."""

    middle: np.ndarray
    across: np.ndarray
    up: np.ndarray
    along: np.ndarray
    bend: np.ndarray


def _shown(patches: Patches, grey: Grey, sweep: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """What a photo shows of patches at each offset, (m, offsets, SIDE²) float32, and which patches these are: those
    before the camera and not masked."""
    which, at = _placed(patches, grey, sweep)
    along = sweep.places()[:, None]
    centre = at.middle[:, None] + along * at.along[:, None] + along**2 * at.bend[:, None]
    a, b = (each.reshape(-1, 1) for each in np.meshgrid(*2 * [np.linspace(-1, 1, SIDE, dtype=np.float32)]))
    samples = centre[:, :, None] + (a * at.across[:, None] + b * at.up[:, None])[:, None]
    shape = samples.shape[:3]
    if len(which) == 0:
        return which, np.zeros(shape, np.float32)
    x, y = (np.ascontiguousarray(samples[..., axis], np.float32).reshape(len(which), -1) for axis in (0, 1))
    found = cv2.remap(grey.pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return which, np.asarray(found, np.float32).reshape(shape)


def _placed(patches: Patches, grey: Grey, sweep: Sweep) -> tuple[np.ndarray, Affine]:
    """Where a photo shows which patches: five points of each are projected."""
    one, other = _tangents(patches.normals)
    reach = patches.normals * (max(sweep.reach, 1e-3) * patches.normal)[:, None]
    half, points, photo = sweep.half * patches.across[:, None], patches.points, grey.photo
    ends = np.concatenate([points, points - reach, points + reach, points + half * one, points + half * other])
    place = projected(photo, ends)
    which = np.flatnonzero(place.ahead.reshape(5, -1).all(axis=0))
    scale = np.array(grey.pixels.shape[::-1]) / [photo.camera.width, photo.camera.height]
    at = (place.pixels * scale - 0.5).astype(np.float32).reshape(5, -1, 2)[:, which]
    middle, inner, outer = at[:3]
    affine = Affine(middle, at[3] - middle, at[4] - middle, (outer - inner) / 2, (outer + inner) / 2 - middle)
    corners = [middle + a * affine.across + b * affine.up for a in (-1, 0, 1) for b in (-1, 0, 1)]
    counts = _all_used(grey, corners)
    return which[counts], Affine(*(part[counts] for part in affine))


def _all_used(grey: Grey, places: list[np.ndarray]) -> np.ndarray:
    """Whether the pixels at all ``places``, each (n, 2), count, (n,) bool."""
    if grey.used.all():
        return np.ones(len(places[0]), bool)
    height, width = grey.used.shape
    column, row = np.rint(np.stack(places)).astype(np.int64).clip(0, [width - 1, height - 1]).transpose(2, 0, 1)
    return np.asarray(grey.used[row, column].all(axis=0))


def _tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) across each normal and each other."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    one = np.cross(normals, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(normals, one)


def _best_offsets(agreement: np.ndarray, sweep: Sweep, means: csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Where the photos around each vertex agree best, in voxels, and what that is worth, (n,) each: the agreement's
    curvature times its height; nothing at the ends of the sweep."""
    curve = means @ agreement
    row, best = np.arange(len(curve)), curve.argmax(axis=1)
    inner = best.clip(1, 2 * sweep.steps - 1)
    before, peak, after = (curve[row, inner + step] for step in (-1, 0, 1))
    bend = np.maximum(2 * peak - before - after, 1e-6)
    length = sweep.reach / sweep.steps
    offset = (inner - sweep.steps + ((after - before) / (2 * bend)).clip(-1, 1)) * length
    worth = np.where(best == inner, bend / length**2 * peak.clip(0, 1), 0)
    return offset, worth


def _balanced(
    surface: Surface, patches: Patches, offset: np.ndarray, worth: np.ndarray, means: csr_array
) -> np.ndarray:
    """The offsets that minimise the sum at the head of this module, in voxels, (n,)."""
    count = len(offset)
    linked = csr_array((np.ones(means.nnz), means.indices, means.indptr), (count, count))  # with themselves
    degree = np.diff(means.indptr) - 1.0
    umbrella = eye_array(count) - diags_array(1 / np.maximum(degree, 1)) @ (linked - eye_array(count))
    edge = (_edge_lengths(surface, means) / patches.across).clip(*EDGES)
    support = diags_array(np.clip(means @ worth / SUPPORTED, 0, 1) * (FAIR_EDGE / edge) ** 4)
    # Lengths are in voxels of the vertex in the middle; offsets move the others by their own.
    own = diags_array(1 / patches.normal) @ umbrella
    pull = (diags_array(patches.normal) @ own.T @ support @ own).tocsr()
    bending = (pull @ diags_array(patches.normal)).tocoo()
    row, column = bending.coords
    aligned = (patches.normals[row] * patches.normals[column]).sum(axis=1)
    fair = csr_array((FAIRNESS * bending.data * aligned, (row, column)), (count, count))
    known = FAIRNESS * (patches.normals * (pull @ surface.vertices)).sum(axis=1)
    stay = np.where(patches.shared(), PRIOR, UNSEEN)
    smooth = SMOOTHNESS * (diags_array(degree + 1) - linked)
    system = (fair + smooth + diags_array(worth + stay)).tocsr()
    jacobi = diags_array(1 / system.diagonal())
    return cg(system, worth * offset - known, rtol=TOLERANCE, maxiter=MAX_ITERATIONS, M=jacobi)[0]


def _edge_lengths(surface: Surface, means: csr_array) -> np.ndarray:
    """The root mean square length of the edges at each vertex, (n,)."""
    count = np.diff(means.indptr)  # with the vertex itself
    vertex = np.repeat(np.arange(len(count)), count)
    square = ((surface.vertices[vertex] - surface.vertices[means.indices]) ** 2).sum(axis=1)
    return np.sqrt(np.bincount(vertex, square, len(count)) / np.maximum(count - 1, 1))


def _unturned(surface: Surface, shifted: np.ndarray) -> np.ndarray:
    """The ``shifted`` vertices (n, 3); those of faces that would turn over stay."""
    was = face_area_vectors(*surface)
    shifted = shifted.copy()
    for _ in range(UNTURNED_STEPS):
        turned = (was * face_area_vectors(shifted, surface.faces)).sum(axis=1) < 0
        if not turned.any():
            break
        stays = np.unique(surface.faces[turned])
        shifted[stays] = surface.vertices[stays]
    return shifted
