"""Triangles: areas, normals, components, open borders, samples.

``vertices`` are (n, 3) float64, ``faces`` (m, 3) int32 indices, counter-clockwise seen from outside, that is from
the side of lower density.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_array
from scipy.sparse.csgraph import connected_components


class Surface(NamedTuple):
    """An indexed triangle mesh."""

    vertices: np.ndarray
    faces: np.ndarray


def face_area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Per face, its outward normal times twice its area, (m, 3)."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def vertex_normals(surface: Surface) -> np.ndarray:
    """Unit outward normals (n, 3), averaged over a vertex's faces by area; +z where these have no area or cancel."""
    per_corner = np.repeat(face_area_vectors(*surface), 3, axis=0)
    corner = surface.faces.reshape(-1)
    count = len(surface.vertices)
    normals = np.stack([np.bincount(corner, per_corner[:, axis], count) for axis in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    fallback = np.tile([0.0, 0.0, 1.0], (count, 1))  # glTF allows no other length than one
    return np.divide(normals, length, out=fallback, where=length > 0)


def face_areas(surface: Surface) -> np.ndarray:
    """Area of each face."""
    return np.linalg.norm(face_area_vectors(*surface), axis=1) / 2


def components(surface: Surface) -> np.ndarray:
    """The connected component of each face, numbered by decreasing area from 0."""
    first, second = surface.faces[:, [0, 1]].T, surface.faces[:, [1, 2]].T
    start, end = np.concatenate([first, second], axis=1)
    size = len(surface.vertices)
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), (size, size))
    label = connected_components(graph, directed=False)[1][surface.faces[:, 0]]
    _, label = np.unique(label, return_inverse=True)
    order = np.argsort(-np.bincount(label, face_areas(surface)), kind="stable")
    return np.argsort(order)[label]


def face_neighbours(faces: np.ndarray) -> np.ndarray:
    """Pairs of faces (pairs, 2) that share an edge; of an edge with more than two faces each with the next."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    return np.stack([order[same], order[same + 1]], axis=1) // 3


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length one; those without length stay so."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


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


def keep_faces(surface: Surface, keep: np.ndarray) -> tuple[Surface, np.ndarray]:
    """The faces marked in ``keep`` (m,) with the vertices they use, and the old index of each new vertex."""
    faces = surface.faces[keep]
    used = np.unique(faces)
    new = np.zeros(len(surface.vertices), np.int32)
    new[used] = np.arange(len(used))
    return Surface(surface.vertices[used], new[faces]), used


def is_watertight(surface: Surface) -> bool:
    """Whether every edge belongs to exactly two faces, which pass it in opposite directions."""
    start, end = directed_edges(surface)
    size = len(surface.vertices)
    forth, count = np.unique(start * size + end, return_counts=True)
    return bool((count == 1).all() and np.array_equal(forth, np.unique(end * size + start)))


def border_vertices(surface: Surface) -> np.ndarray:
    """Positions of the ends of every edge that belongs to one face only, (2 × edges, 3)."""
    return surface.vertices[border_indices(surface)]


def border_indices(surface: Surface) -> np.ndarray:
    """The ends of every edge that belongs to one face only, (2 × edges,)."""
    start, end = directed_edges(surface)
    size = len(surface.vertices)
    edge, count = np.unique(np.minimum(start, end) * size + np.maximum(start, end), return_counts=True)
    return np.concatenate(np.divmod(edge[count == 1], size))


def directed_edges(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Start and end of the three edges of each face, one face after another."""
    faces = surface.faces.astype(np.int64)
    return faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> np.ndarray:
    """``count`` points (count, 3), uniform by area over the triangles (Osada et al. 2002, equation 1).

    Stratified along the cumulated area, so that ``count`` points cover a mesh evenly. Raises ValueError for a mesh
    without area.
    """
    return sampled_faces(vertices, faces, count, seed)[0]


def sampled_faces(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The points of :func:`sample_surface`, and the face of each (count,)."""
    vertices = vertices.astype(np.float64)
    cumulated = np.cumsum(np.linalg.norm(face_area_vectors(vertices, faces), axis=-1))
    if len(faces) == 0 or not cumulated[-1] > 0:
        raise ValueError(f"cannot sample a mesh without area ({len(faces)} faces)")
    random = np.random.default_rng(seed).random((3, count))
    position = (np.arange(count) + random[0]) / count * cumulated[-1]
    chosen = np.searchsorted(cumulated, position, side="right").clip(max=len(faces) - 1)
    a, b, c = vertices[faces[chosen]].swapaxes(0, 1)
    root, fraction = np.sqrt(random[1])[:, None], random[2][:, None]
    return (1 - root) * a + root * (1 - fraction) * b + root * fraction * c, chosen
