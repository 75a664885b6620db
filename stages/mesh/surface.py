"""Triangles: marching cubes, cleaning, decimation, and what is open.

``vertices`` are (n, 3) float64, ``faces`` (m, 3) int32 indices, counter-clockwise seen from outside, that is from
the side of lower density.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.contract import StageError

if TYPE_CHECKING:
    from nerf.fields.density_grid import Lattice


# Passes of nerf.fields.density_grid.smoothed: a Gaussian of a lattice point's distance. The field's finest cells are
# about as small, and what differs between two of them is noise that a lattice would pick at random
# (docs/experiments/mesh.md).
SMOOTHING = 2


class Surface(NamedTuple):
    """An indexed triangle mesh."""

    vertices: np.ndarray
    faces: np.ndarray


def solidity(lattice: "Lattice", level: float) -> "Lattice":
    """What passes 1/2 at the surface of density ``level``: the occupancy, less what is finer than the lattice."""
    from nerf.fields.density_grid import occupancy, smoothed

    return smoothed(occupancy(lattice, level), SMOOTHING)


def extract(lattice: "Lattice", level: float) -> Surface:
    """The surface where density passes ``level`` (marching cubes, Lewiner et al. 2003); open where the box cuts it.

    Raises StageError where nothing is as solid as that, or all is: of sheets of one lattice point and rods of two
    smoothing leaves nothing.
    """
    from skimage.measure import marching_cubes

    values = solidity(lattice, level).values.cpu().numpy()
    if not values.min() < 0.5 < values.max():
        raise StageError(
            "mesh.too-thin",
            f"no surface at density {level:.3g}",
            f"between neighbours of the lattice it averages {values.min():.0%} to {values.max():.0%} of solid: what is "
            "there is too thin for the lattice, or fills the box",
            "Give a higher --mesh.resolution or another --mesh.level.",
        )
    index, faces, _, _ = marching_cubes(values, 0.5, gradient_direction="ascent")
    vertices = lattice.low.cpu().double().numpy() + index * lattice.spacing().cpu().double().numpy()
    return Surface(vertices, faces.astype(np.int32))


def face_crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of each face, the vector (m, 3) along its outward normal that is as long as twice its area."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def vertex_normals(surface: Surface) -> np.ndarray:
    """Unit outward normals (n, 3), averaged over a vertex's faces by area; +z where these have no area or cancel."""
    cross = np.repeat(face_crosses(*surface), 3, axis=0)
    corner = surface.faces.reshape(-1)
    count = len(surface.vertices)
    normals = np.stack([np.bincount(corner, cross[:, axis], count) for axis in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    anywhere = np.tile([0.0, 0.0, 1.0], (count, 1))  # glTF allows no other length than one
    return np.divide(normals, length, out=anywhere, where=length > 0)


def face_areas(surface: Surface) -> np.ndarray:
    """Area of each face."""
    return np.linalg.norm(face_crosses(*surface), axis=1) / 2


def components(surface: Surface) -> np.ndarray:
    """The number of the connected component of each face, 0 for the one of largest area, then downwards."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first, second = surface.faces[:, [0, 1]].T, surface.faces[:, [1, 2]].T
    start, end = np.concatenate([first, second], axis=1)
    size = len(surface.vertices)
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), (size, size))
    label = connected_components(graph, directed=False)[1][surface.faces[:, 0]]
    _, label = np.unique(label, return_inverse=True)
    order = np.argsort(-np.bincount(label, face_areas(surface)), kind="stable")
    return np.argsort(order)[label]


def keep_faces(surface: Surface, keep: np.ndarray) -> tuple[Surface, np.ndarray]:
    """The faces marked in ``keep`` (m,) with the vertices they use, and the old index of each new vertex."""
    faces = surface.faces[keep]
    used = np.unique(faces)
    new = np.zeros(len(surface.vertices), np.int32)
    new[used] = np.arange(len(used))
    return Surface(surface.vertices[used], new[faces]), used


def decimate(surface: Surface, max_faces: int) -> Surface:
    """Collapse edges until ``max_faces`` remain (quadrics, Garland and Heckbert 1997); open borders stay put, and what
    folds onto itself goes."""
    from fast_simplification import simplify

    if len(surface.faces) <= max_faces:
        return surface
    vertices, faces, *_ = simplify(surface.vertices, surface.faces, target_count=max_faces, preserve_border=True)
    return keep_faces(Surface(vertices.astype(np.float64), faces.astype(np.int32)), ~_cancel(faces))[0]


def _cancel(faces: np.ndarray) -> np.ndarray:
    """Which faces are back to back with a copy of themselves, or have a vertex twice, (m,) bool.

    Nothing opens without them. Slivers between three vertices are kept, without area, too: they join their neighbours.
    """
    a, b, c = faces.astype(np.int64).T
    winding = np.sign(b - a) * np.sign(c - b) * np.sign(c - a)
    which = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    return (np.bincount(which, winding) == 0)[which]


def is_watertight(surface: Surface) -> bool:
    """Whether every edge belongs to exactly two faces, which pass it in opposite directions."""
    start, end = _directed_edges(surface)
    size = len(surface.vertices)
    forth, count = np.unique(start * size + end, return_counts=True)
    return bool((count == 1).all() and np.array_equal(forth, np.unique(end * size + start)))


def border_vertices(surface: Surface) -> np.ndarray:
    """Positions of the ends of every edge that belongs to one face only, (2 × edges, 3)."""
    start, end = _directed_edges(surface)
    size = len(surface.vertices)
    edge, count = np.unique(np.minimum(start, end) * size + np.maximum(start, end), return_counts=True)
    return surface.vertices[np.concatenate(np.divmod(edge[count == 1], size))]


def _directed_edges(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    faces = surface.faces.astype(np.int64)
    return faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
