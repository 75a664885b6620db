"""Which way is up, from the cameras alone, or by where on Earth they stood.

People hold cameras level far more often than they point them level, so the image x axes lie in a horizontal
plane although the image y axes do not; and people walk on floors, so standpoints often share a plane as well. Both
make *up* the direction that a set of vectors avoids. The set that avoids its direction best decides, provided
that direction agrees with where the photos' upper edges point; these edges alone decide where neither set is flat
enough. Places by GPS are a third witness, and the only one that knows a photo of the ground from one of a wall: without
them, photos that all look straight down, turned one way, are taken for photos of a wall.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf.geometry.reconstruction import Reconstruction, angles_deg, spatial_median

MAX_FLATNESS = 0.25  # tan 14 deg: a set of directions that leaves its plane further than this has no plane
MAX_PITCH_DEG = 65.0  # between the plane's normal and the upper edges, which lean as far as the photos look down
MAX_DISAGREEMENT_DEG = 35.0  # among the upper edges
# Length of the mean of the upper edges, which are unit vectors. Level photos that look all around have a shorter one
# only where they look 73 deg down, beyond MAX_PITCH_DEG; else it says that edges cancel, and what is left is noise.
MIN_EDGES = 0.3
MIN_LOOK = 0.15  # sin 9 deg: photos that look down or up by less, on average, do not tell which of the two
# tan 5 deg, less than the 14 deg of a plane: heights by GPS drift for minutes, and what drifts tilts the whole scene
# without being off from it.
MAX_TILT = 0.087


class Up(NamedTuple):
    """A unit up vector; ``known`` is False where the cameras disagree and it is merely the first photo's up.

    ``source`` says what decided it.
    """

    direction: Float[np.ndarray, "3"]
    known: bool
    source: str


class Witness(NamedTuple):
    """A unit up vector, the tangent of the angle by which it may be off, and what says so."""

    tilt: float
    direction: Float[np.ndarray, "3"]
    source: str


def find_up(scene: Reconstruction, places: Witness | None = None) -> Up:
    """The up vector best supported by the poses, or by the cameras' ``places``, whichever is more certain."""
    edges = _unit(spatial_median(scene.ups)[None])[0]
    witnesses = [*_planes(scene, edges), *([places] if places is not None and places.tilt <= MAX_TILT else [])]
    if witnesses:
        best = min(witnesses, key=lambda witness: round(witness.tilt, 6))
        return Up(best.direction, True, best.source)
    # three quarters must agree: a few photos turned by 90 degrees are common, half of them turned is no evidence
    if np.quantile(angles_deg(scene.ups, edges), 0.75) < MAX_DISAGREEMENT_DEG:
        return Up(edges, True, "upper edges")
    return Up(scene.ups[0], False, "first photo")


def up_by_places(centres: Float[np.ndarray, "n 3"], enu_from_sfm: Float[np.ndarray, "4 4"], error_m: float) -> Witness:
    """Up where cameras at ``centres`` have places on Earth, ``error_m`` off in the median, height included.

    It may be off by that error at the distance which these cameras reach to either side of the line they are closest
    to: about a line nothing keeps a scene from rolling. That is not divided by the square root of their number, since
    what GPS says of neighbouring photos is wrong by about the same.
    """
    scale = float(np.linalg.norm(enu_from_sfm[2, :3]))
    width = scale * np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(centres))
    return Witness(error_m / width if width > 0 else np.inf, enu_from_sfm[2, :3] / scale, "GPS")


def _planes(scene: Reconstruction, edges: Float[np.ndarray, "3"]) -> Iterator[Witness]:
    """The normals of the planes that a set of vectors keeps to, those that can be up.

    The upper ``edges`` say which side of a plane is up, and that it is no wall. Where these cancel (a ring of photos
    turned on their side, flights to and fro over the ground), standpoints share a floor and photos look down.
    """
    count = len(scene.centres)
    # As of any fit, in which a plane's place and two angles are free: three standpoints always share one.
    of_fit = np.sqrt(max(count - 3, 0) / count)
    standpoints = (_unit(scene.centres - spatial_median(scene.centres)), "level standpoints", of_fit)
    if np.linalg.norm(scene.ups.mean(axis=0)) >= MIN_EDGES:
        upwards, least = edges, np.cos(np.radians(MAX_PITCH_DEG))
        sets = ((scene.rights, "level horizons", 1.0), standpoints)
    else:
        upwards, least, sets = -scene.axes.mean(axis=0), MIN_LOOK, (standpoints,)
    for vectors, source, certainty in sets:
        flatness, normal = _avoided_direction(vectors)
        agreement = float(normal @ upwards)
        if flatness < certainty * MAX_FLATNESS and abs(agreement) > least:
            yield Witness(flatness / certainty, np.sign(agreement) * normal, source)


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
