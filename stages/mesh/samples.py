"""Points on a surface, uniform by area."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def sample_surface(vertices: "np.ndarray", faces: "np.ndarray", count: int, seed: int) -> "np.ndarray":
    """``count`` points (count, 3), uniform by area over the triangles (Osada et al. 2002, equation 1).

    Stratified along the cumulated area, so that ``count`` points cover a mesh evenly. Raises ValueError for
    a mesh without area.
    """
    import numpy as np

    from stages.mesh.surface import face_crosses

    vertices = vertices.astype(np.float64)
    cumulated = np.cumsum(np.linalg.norm(face_crosses(vertices, faces), axis=-1))
    if len(faces) == 0 or not cumulated[-1] > 0:
        raise ValueError(f"cannot sample a mesh without area ({len(faces)} faces)")
    random = np.random.default_rng(seed).random((3, count))
    along = (np.arange(count) + random[0]) / count * cumulated[-1]
    drawn = np.searchsorted(cumulated, along, side="right").clip(max=len(faces) - 1)
    a, b, c = vertices[faces[drawn]].swapaxes(0, 1)
    root, share = np.sqrt(random[1])[:, None], random[2][:, None]
    return (1 - root) * a + root * (1 - share) * b + root * share * c
