"""Which way is up, from the cameras alone.

People hold cameras level far more often than they point them level, so the image x axes lie in a horizontal
plane although the image y axes do not; and people walk on floors, so standpoints often share a plane as well. Both
make *up* the direction that a set of vectors avoids. The set that avoids its direction best decides, provided
that direction agrees with where the photos' upper edges point; these edges alone decide where neither set is flat
enough. Gravity itself is not seen: photos that all look straight down at the ground are taken for photos of a wall.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf.reconstruction import Reconstruction, angles_deg, spatial_median

MOST_FLATNESS = 0.25  # tan 14 deg: a set of directions that leaves its plane further than this has no plane
MOST_PITCH_DEG = 65.0  # between the plane's normal and the upper edges, which lean as far as the photos look down
MOST_DISAGREEMENT_DEG = 35.0  # among the upper edges


class Up(NamedTuple):
    """A unit up vector; ``known`` is False where the cameras disagree and it is merely the first photo's up.

    ``source`` says what decided it.
    """

    direction: Float[np.ndarray, "3"]
    known: bool
    source: str


def find_up(scene: Reconstruction) -> Up:
    """The up vector best supported by the poses."""
    edges = _unit(spatial_median(scene.ups)[None])[0]
    planes = [
        (*_avoided_direction(vectors), source)
        for vectors, source in (
            (scene.rights, "level horizons"),
            (_unit(scene.centres - spatial_median(scene.centres)), "level standpoints"),
        )
    ]
    for flatness, normal, source in sorted(planes, key=lambda plane: round(plane[0], 6)):
        normal = normal if normal @ edges > 0 else -normal
        if flatness < MOST_FLATNESS and angles_deg(normal, edges) < MOST_PITCH_DEG:
            return Up(normal, True, source)
    # three quarters must agree: a few photos turned by 90 degrees are common, half of them turned is no evidence
    if np.quantile(angles_deg(scene.ups, edges), 0.75) < MOST_DISAGREEMENT_DEG:
        return Up(edges, True, "upper edges")
    return Up(scene.ups[0], False, "first photo")


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Directions of vectors; their length would let one far camera decide. Zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def _avoided_direction(vectors: Float[np.ndarray, "n 3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """(flatness, normal) of the plane through 0 along ``vectors``: least over middle singular value.

    It is the tangent of the angle by which the normal is uncertain, so vectors along one line (no plane) count
    as not flat.
    """
    _, (largest, middle, least), axes = np.linalg.svd(vectors, full_matrices=len(vectors) < 3)
    flatness = least / middle if middle > 0.1 * largest else np.inf
    return float(flatness), axes[2]
