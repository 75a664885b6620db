"""Fewer triangles for the same surface."""

import numpy as np
import torch
from fast_simplification import simplify

from nerf.geometry.space_maps import SpaceMap
from stages.mesh.surface import Surface, keep_faces

# fast_simplification collapses what costs less than limits that grow from a fixed one. In scene units everything costs
# less than the first, and edges go in the order of the faces: the error is a tenth larger (docs/experiments/mesh.md).
SCALE = 100.0


def decimate(surface: Surface, max_faces: int, space: SpaceMap) -> Surface:
    """Collapse edges until ``max_faces`` remain (quadrics, Garland and Heckbert 1997); open borders stay put, and faces
    folded onto each other are removed.

    Distances count as in the field's ``space``: where cameras face one way, by what they are in the photos, so that
    what is near has its share of the faces.
    """
    if len(surface.faces) <= max_faces:
        return surface
    mapped = SCALE * space.forward(torch.from_numpy(surface.vertices)).numpy()
    vertices, faces, *_ = simplify(mapped, surface.faces, target_count=max_faces, preserve_border=True)
    vertices = space.inverse(torch.from_numpy(vertices.astype(np.float64) / SCALE)).numpy()
    return keep_faces(Surface(vertices, faces.astype(np.int32)), ~_folded_pairs(faces))[0]


def _folded_pairs(faces: np.ndarray) -> np.ndarray:
    """Faces that lie back to back with a copy of themselves, or have a vertex twice, (m,) bool.

    Removing them opens nothing. Other faces without area are kept: they join their neighbours.
    """
    a, b, c = faces.astype(np.int64).T
    winding = np.sign(b - a) * np.sign(c - b) * np.sign(c - a)
    which = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    return (np.bincount(which, winding) == 0)[which]
