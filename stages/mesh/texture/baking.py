"""The picture of a texture: every texel's colour from the photos that were chosen for its place on the surface.

A texel shows what its best photo shows there, moved to what all photos agree on at the scale of the surface's edges:
the difference is taken at the vertices, smoothed over the surface and linear within a face, so that neighbouring
photos of different brightness meet without a seam (the global seam levelling of Lempitsky and Ivanov 2007, per photo
and in closed form). Where photos take turns their weights change linearly across a face. Weights and differences
belong to vertices, not to texels: the texture is continuous across the charts' borders.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np
import torch
from scipy.sparse import csr_array

from nerf.runtime.parallel import in_order
from stages.mesh.photos.photo import Photo, Picture, colours_at, projected, read_picture, readers
from stages.mesh.rasteriser import barycentric, covered_pixels
from stages.mesh.surface import Surface
from stages.mesh.texture.atlas import Atlas
from stages.mesh.texture.view_selection import Candidates, Choice

LEVELLING_STEPS = 6  # over neighbours, of the differences between photos
FACES_AT_ONCE = 1 << 12
TEXELS_AT_ONCE = 1 << 22
GUTTER_ROWS, GUTTER_REACH = 512, 128


def bake(
    surface: Surface,
    atlas: Atlas,
    photos: Sequence[Photo],
    choice: Choice,
    means: csr_array,
    on_photo: Callable[[float], None],
) -> np.ndarray:
    """The texture, (height, width, 3) uint8 sRGB."""
    light = np.zeros((atlas.height * atlas.width, 3), np.float16)
    covered = np.zeros(atlas.height * atlas.width, bool)
    given = np.zeros(len(surface.vertices))
    for vertex, weight in choice.weights:
        given[vertex] += weight
    rest = (1 - given).clip(0)[:, None] * choice.colour
    for face, texel, corner in _texels(atlas, np.arange(len(surface.faces))):
        light[texel] = _within(corner, rest[surface.faces[face]])
        covered[texel] = True

    # The next photos are decoded on threads of their own while the cores bake this one.
    used = [index for index in range(len(photos)) if len(choice.weights[index][0])]
    count = readers([photos[index] for index in used])
    with ThreadPoolExecutor(count) as ahead:
        read = partial(read_picture, downscale=max(1.0, 1 / atlas.texels_per_pixel))
        upcoming = deque(ahead.submit(read, photos[index]) for index in used[:count])
        for done, index in enumerate(used):
            picture = upcoming.popleft().result()
            upcoming.extend(ahead.submit(read, photos[index]) for index in used[done + count : done + count + 1])
            for texel, colour in _of_photo(surface, atlas, (photos[index], picture), index, choice, means):
                light[texel] += colour
            on_photo((done + 1) / len(used))
    picture = np.empty((atlas.height * atlas.width, 3), np.uint8)
    for start in range(0, len(picture), TEXELS_AT_ONCE):
        some = slice(start, start + TEXELS_AT_ONCE)
        picture[some] = np.rint(light[some].astype(np.float32) * 255).clip(0, 255)
    del light
    shape = (atlas.height, atlas.width)
    picture = picture.reshape(*shape, 3)
    fill_gutters(picture, covered.reshape(shape))
    return picture


def _of_photo(
    surface: Surface,
    atlas: Atlas,
    shown: tuple[Photo, Picture],
    index: int,
    choice: Choice,
    means: csr_array,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What a photo adds to the texture: texels, and colours (n, 3) float32 times what they weigh. A block of faces at a
    time on each core: all that a photo shows would take more memory than the texture."""
    (photo, picture), weight = shown, choice.weight(index)
    faces = np.flatnonzero(weight[surface.faces].any(axis=1))
    level = _levelling(choice.candidates, index, choice.colour, means)
    of_vertex = np.concatenate([surface.vertices, level, weight[:, None]], axis=1)

    def of_block(some: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        part = []
        for face, texel, corner in _texels(atlas, some):
            here = _within(corner, of_vertex[surface.faces[face]])
            colour = colours_at(photo, picture, projected(photo, here[:, :3]).pixels, here[:, :3])
            part.append((texel, (colour + here[:, 3:6]).clip(0, 1) * here[:, 6:]))
        return part

    blocks = [faces[start : start + FACES_AT_ONCE] for start in range(0, len(faces), FACES_AT_ONCE)]
    for part in in_order(of_block, blocks, torch.device("cpu")):
        yield from part


def _texels(atlas: Atlas, faces: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of some faces: the face of each texel, the texel's flat index and its barycentric coordinates, in blocks."""
    corners = atlas.uv[atlas.corner[faces]]
    for index, row, column in covered_pixels(corners, atlas.width, atlas.height):
        at = np.stack([column, row], axis=1) + 0.5
        yield faces[index], row * atlas.width + column, barycentric(corners[index], at)


def _within(corner: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n, 3, channels) of three corners at barycentric coordinates (n, 3)."""
    return (corner[:, None] @ values)[:, 0]


def _levelling(candidates: Candidates, photo: int, colour: np.ndarray, means: csr_array) -> np.ndarray:
    """What has to be added to a photo's colours at each vertex to agree with the others, (n, 3), smooth."""
    vertex, slot = np.nonzero((candidates.photo == photo) & (candidates.quality > 0))
    known, difference = np.zeros((len(colour), 1), np.float32), np.zeros_like(colour)
    known[vertex] = 1
    difference[vertex] = colour[vertex] - candidates.colour[vertex, slot]
    for _ in range(LEVELLING_STEPS):
        known, difference = means @ known, means @ difference
    return np.divide(difference, known, out=np.zeros_like(difference), where=known > 0)


def fill_gutters(picture: np.ndarray, covered: np.ndarray) -> None:
    """Give every texel outside of the charts the colour of the nearest one inside, so that filtering finds no black. In
    bands, to save memory: charts more than GUTTER_REACH rows off a band do not count, unless there is none nearer."""
    for start in range(0, len(picture), GUTTER_ROWS):
        low, end = max(0, start - GUTTER_REACH), start + GUTTER_ROWS
        known = covered[low : end + GUTTER_REACH].copy()
        gaps = (start - low) * covered.shape[1] + np.flatnonzero(~known[start - low : end - low])
        if not known.any():
            known[: start - low] = True  # filled by the band before
        if not len(gaps) or not known.any():
            continue
        _, nearest = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
        )
        # Labels count the known texels, in an order that OpenCV does not promise: they are read at these texels.
        label, inside = np.asarray(nearest, np.int32).reshape(-1), np.flatnonzero(known)
        source = np.empty(int(label.max()) + 1, np.int32)
        source[label[inside]] = inside
        flat = picture[low : end + GUTTER_REACH].reshape(-1, 3)
        flat[gaps] = flat[source[label[gaps]]]
