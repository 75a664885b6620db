"""A surface cut into charts: connected faces that look the same way, each flat in the plane it looks along.

xatlas's own charts take 0.2 ms of a core per face on surfaces of fields (docs/experiments/mesh.md), more than the rest
of the stage. These take a fiftieth of that. Their many seams cost nothing but room: what the texture shows is
continuous across them (stages/mesh/texture/baking.py).
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from stages.mesh.rasteriser import covered_pixels
from stages.mesh.surface import Surface, face_area_vectors, face_neighbours, unit

SMOOTHING_STEPS = 12  # of the faces' normals over their neighbours, before a direction is chosen for each
MIN_COSINE = 0.5  # between a face and the direction of its chart: it has at least half of its area there
MIN_JOINED_COSINE = 0.15  # the same where a small chart joins a larger one
SMALL_CHART = 40  # faces; smaller charts join a neighbour that looks nearly the same way
MERGING_STEPS = 8
OVERLAP_TEXELS = 512  # a side of the picture in which a chart's faces are looked at for overlaps, at most
MAX_OVERLAP_ROUNDS = 4
# Towards the faces, edges and corners of a cube: no normal is farther than 28° from one of them.
DIRECTIONS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


class Charts(NamedTuple):
    """``chart`` (faces,) of each face, numbered from 0; ``corners`` (faces, 3, 2): each face in the plane of its chart,
    in the surface's unit of length."""

    chart: np.ndarray
    corners: np.ndarray


def cut_into_charts(surface: Surface) -> Charts:
    """Charts of a surface; within one, faces that overlap share no more than edges. Faces without area are points or
    lines in theirs."""
    neighbours = face_neighbours(surface.faces)
    normals = unit(face_area_vectors(*surface))
    direction = _chosen_directions(surface, neighbours, normals)
    corners = _flattened(surface, direction)
    chart = _connected(neighbours, direction)
    for _ in range(MAX_OVERLAP_ROUNDS):
        covered = _overlapping(chart, corners)
        if not covered.any():
            break
        chart = _connected(neighbours, 2 * chart + covered)
    else:  # what still overlaps gets a chart for each face
        alone = _overlapping(chart, corners)
        chart = np.unique(np.where(alone, len(chart) + np.arange(len(chart)), chart), return_inverse=True)[1]
    return Charts(chart, corners)


def _chosen_directions(surface: Surface, neighbours: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which of DIRECTIONS each face's chart looks along, (faces,): the one nearest to its smoothed normal, so that
    charts are large, among those that it faces itself."""
    count = len(normals)
    mean = _adjacency(neighbours, count, itself=True)
    smooth = face_area_vectors(*surface)
    for _ in range(SMOOTHING_STEPS):
        smooth = mean @ smooth
    cosine = np.where((normals == 0).all(axis=1)[:, None], 1.0, normals @ DIRECTIONS.T)
    direction = np.where(cosine >= MIN_COSINE, unit(smooth) @ DIRECTIONS.T, -2.0).argmax(axis=1)
    allowed = cosine >= MIN_JOINED_COSINE
    for _ in range(MERGING_STEPS):
        direction = _joined(neighbours, direction, allowed)
    return direction


def _joined(neighbours: np.ndarray, direction: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Directions where faces of small charts take that of the largest chart next to them, if it is larger and they face
    along it."""
    label = _connected(neighbours, direction)
    size = np.bincount(label)[label]
    best = size * len(DIRECTIONS) + direction  # of each face: the size of a chart and its direction in one number
    both = np.concatenate([neighbours, neighbours[:, ::-1]])
    face, other = both[(size[both[:, 0]] < SMALL_CHART) & (size[both[:, 1]] > size[both[:, 0]])].T
    fits = allowed[face, direction[other]]
    np.maximum.at(best, face[fits], best[other[fits]])
    return best % len(DIRECTIONS)


def _adjacency(neighbours: np.ndarray, count: int, itself: bool) -> csr_array:
    pairs = [neighbours.T, neighbours.T[::-1]] + [np.arange(count)[None].repeat(2, 0)] * itself
    row, column = np.concatenate(pairs, axis=1)
    return csr_array((np.ones(len(row)), (row, column)), (count, count))


def _connected(neighbours: np.ndarray, label: np.ndarray) -> np.ndarray:
    """A number for each set of neighbouring faces with the same label, (faces,)."""
    same = neighbours[label[neighbours[:, 0]] == label[neighbours[:, 1]]]
    return connected_components(_adjacency(same, len(label), itself=False), directed=False)[1]


def _flattened(surface: Surface, direction: np.ndarray) -> np.ndarray:
    """The faces in the planes that their directions look along, counter-clockwise, (faces, 3, 2)."""
    aside = np.where(np.abs(DIRECTIONS[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0.0, 0, 1]])
    across = unit(np.cross(aside, DIRECTIONS))
    axes = np.stack([across, np.cross(DIRECTIONS, across)], axis=2)  # (directions, 3, 2)
    return np.einsum("fij,fjk->fik", surface.vertices[surface.faces], axes[direction])


def _overlapping(chart: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Faces (faces,) bool that lie on another face of their chart: of each two the later one.

    Every chart is drawn into a picture of its own; a pixel with two faces tells.
    """
    low, high = _chart_boxes(chart, corners)
    size = np.maximum((high - low).max(axis=1), np.finfo(float).tiny)
    faces_in = np.bincount(chart)
    side = np.clip(np.ceil(4 * np.sqrt(faces_in)), 8, OVERLAP_TEXELS).astype(np.int64)
    scaled = (corners - low[chart, None]) * (side / size)[chart, None, None]
    start = np.concatenate([[0], np.cumsum(side**2)])
    owner = np.full(start[-1], -1, np.int32)
    covered = np.zeros(len(chart), bool)
    for face, row, column in covered_pixels(scaled, OVERLAP_TEXELS, OVERLAP_TEXELS):
        of = chart[face]
        inside = (row < side[of]) & (column < side[of])
        face, of, row, column = face[inside], of[inside], row[inside], column[inside]
        pixel = start[of] + row * side[of] + column
        claimed = owner[pixel] < 0
        owner[pixel[claimed]] = face[claimed]
        covered[face[owner[pixel] != face]] = True
    return covered


def _chart_boxes(chart: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest coordinates of each chart, (charts, 2)."""
    count = int(chart.max(initial=-1)) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, corners.min(axis=1))
    np.maximum.at(high, chart, corners.max(axis=1))
    return low, high
