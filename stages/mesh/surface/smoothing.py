"""Smoothing that keeps edges: first of the faces' normals, then of the vertices, which follow them.

A field's noise turns faces of a voxel's size by ten degrees and more while it moves them by a fraction of a voxel. A
normal becomes the mean of its neighbours', by area, of which those that look elsewhere count less the more they do
(bilateral normal filtering, Zheng et al. 2011, "Bilateral normal filtering for mesh denoising", equation 3, the
neighbours of a face being those across its edges). Vertices move along normals until faces have them (Sun et al. 2007,
"Fast and effective feature-preserving mesh denoising", equation 12), so they hardly move along the surface.
"""

import numpy as np
from scipy.sparse import csr_array

from stages.mesh.surface import Surface, face_area_vectors, face_neighbours, unit

# Length of the difference of two unit normals, 17 degrees: noise is less, an edge is more (docs/experiments/mesh.md).
NOISE = 0.3
NORMAL_STEPS, VERTEX_STEPS = 40, 10


def smoothed(surface: Surface) -> Surface:
    """The surface with smooth faces between its edges. Faces without area follow the others."""
    return surface._replace(vertices=_fitted(surface, _smooth_normals(surface)))


def _smooth_normals(surface: Surface) -> np.ndarray:
    """Unit normals of the faces (m, 3); zero where neither a face nor those around it have an area."""
    vectors = face_area_vectors(*surface)
    area, count = np.linalg.norm(vectors, axis=1), len(vectors)
    normals = unit(vectors)
    pairs, itself = face_neighbours(surface.faces), np.arange(count)[:, None].repeat(2, axis=1)
    row, column = np.concatenate([pairs, pairs[:, ::-1], itself]).T
    weights = csr_array((np.ones(len(row)), (row, column)), (count, count))
    face, neighbour = np.repeat(np.arange(count), np.diff(weights.indptr)), weights.indices
    for _ in range(NORMAL_STEPS):
        difference = np.square(normals[face] - normals[neighbour]).sum(axis=1)
        weights.data = area[neighbour] * np.exp(-difference / (2 * NOISE**2))
        normals = unit(weights @ normals)
    return normals


def _fitted(surface: Surface, normals: np.ndarray) -> np.ndarray:
    """The vertices (n, 3), moved to where the faces have such normals (m, 3): each by the mean, over its faces, of the
    way to the plane through a face's middle."""
    faces, vertices = surface.faces, surface.vertices
    size = len(vertices), len(faces)
    of_vertex = csr_array((np.ones(faces.size), (faces.reshape(-1), np.repeat(np.arange(size[1]), 3))), size)
    count = np.maximum(of_vertex @ np.ones(size[1]), 1)[:, None]
    across = (of_vertex @ (normals[:, :, None] * normals[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    for _ in range(VERTEX_STEPS):
        heights = (normals * vertices[faces].mean(axis=1)).sum(axis=1, keepdims=True)
        ways = of_vertex @ (heights * normals) - np.einsum("nij,nj->ni", across, vertices)
        vertices = vertices + ways / count
    return vertices
