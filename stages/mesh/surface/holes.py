"""Closes holes of a surface: for printing, or where too few photos saw a part of it."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stages.mesh.surface import Surface, directed_edges, face_areas


class Closed(NamedTuple):
    """How many ``holes`` were closed, how many are ``left``, and which share of the area the new faces are."""

    holes: int
    left: int
    area_share: float


def close_holes(surface: Surface, max_size: float) -> tuple[Surface, Closed]:
    """Close each hole whose border fits into a box of ``max_size`` (a fraction of the surface's own box, by their
    diagonals) with a fan of triangles around the mean of its border. Where parts of the surface touch in a single
    vertex, each gets one of its own. A border along which edges have more than two faces is left as it is."""
    surface = separated(surface)
    limit = max_size * float(np.linalg.norm(np.ptp(surface.vertices, axis=0))) * (1 + 1e-9)
    loops, left = _border_loops(surface)
    vertices, faces = [surface.vertices], [surface.faces]
    count = len(surface.vertices)
    for loop in loops:
        border = surface.vertices[loop]
        if float(np.linalg.norm(np.ptp(border, axis=0))) > limit:
            left += 1
            continue
        vertices.append(border.mean(axis=0, keepdims=True))
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), count)], axis=1).astype(np.int32))
        count += 1
    closed = Surface(np.concatenate(vertices), np.concatenate(faces))
    areas = face_areas(closed)
    invented = float(areas[len(surface.faces) :].sum() / areas.sum()) if areas.sum() > 0 else 0.0
    return closed, Closed(len(vertices) - 1, left, invented)


def separated(surface: Surface) -> Surface:
    """The surface with a vertex for each fan of faces: faces share one only if they hang together there by edges."""
    faces = surface.faces
    corner = np.arange(faces.size).reshape(-1, 3)
    start, end = directed_edges(surface)
    at_start, at_end = corner.reshape(-1), corner[:, [1, 2, 0]].reshape(-1)
    key = np.minimum(start, end) * len(surface.vertices) + np.maximum(start, end)
    low, high = np.where(start < end, at_start, at_end), np.where(start < end, at_end, at_start)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, other = order[same], order[same + 1]
    row, column = np.concatenate([low[one], high[one]]), np.concatenate([low[other], high[other]])
    graph = coo_matrix((np.ones(len(row), bool), (row, column)), (faces.size, faces.size))
    label = connected_components(graph, directed=False)[1]
    first = np.unique(label, return_index=True)[1]
    return Surface(surface.vertices[faces.reshape(-1)[first]], label.reshape(-1, 3).astype(np.int32))


def _border_loops(surface: Surface) -> tuple[list[np.ndarray], int]:
    """The vertices of each closed border, in the direction of its faces, and how many borders are none: their edges do
    not follow each other one by one."""
    start, end = directed_edges(surface)
    size = len(surface.vertices)
    key = np.minimum(start, end) * size + np.maximum(start, end)
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    open_ = count[which] == 1
    following = dict(zip(start[open_].tolist(), end[open_].tolist(), strict=True))
    broken = int(open_.sum()) - len(following)  # vertices with two borders
    loops, seen = [], set[int]()
    for first in following:
        loop, vertex = [], first
        while vertex in following and vertex not in seen:
            seen.add(vertex)
            loop.append(vertex)
            vertex = following[vertex]
        if len(loop) >= 3 and vertex == first:
            loops.append(np.array(loop))
        elif loop:
            broken += 1
    return loops, broken
