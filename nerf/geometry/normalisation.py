"""The similarity that carries a reconstruction into the scene frame, and all that is decided along with it."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf import REGION_HALF_SIZE
from nerf.geometry.near_far import near_and_far
from nerf.geometry.reconstruction import Reconstruction, spatial_median
from nerf.geometry.region_of_interest import (
    GOES_ON,
    CaptureType,
    Region,
    beyond_alpha,
    find_capture_type,
    find_region,
    grown,
    share_beyond,
)
from nerf.geometry.scene import Similarity
from nerf.geometry.up_vector import Up, Witness, find_up

MIN_HEADING = 0.3  # the level part of a unit vector, at least, that is one: it points no steeper than 73 deg
# Of the distance from the origin: what places differ by that are written with twelve digits, or rounded a few times.
ONE_PLACE = 1e-12
MIN_HALF_SIZE = (
    1e-30  # of the region in input units: what single-precision numbers, in which meshes are written, still tell apart
)


class Normalisation(NamedTuple):
    """The scene frame and what is known of the scene in it.

    ``bounded``: the photos have alpha, and the points agree that there is no more than it leaves; ``beyond_alpha`` is
    the share of observations that do not. ``beyond`` is the share of observations outside the region, ``arc_deg`` how
    far the cameras reach around it.
    """

    scene_from_sfm: Similarity
    capture_type: CaptureType
    bounded: bool
    up: Up  # in the sfm frame
    near: Float[np.ndarray, "n"]
    far: Float[np.ndarray, "n"]
    beyond_alpha: float
    beyond: float
    arc_deg: float


def normalise(
    sfm: Reconstruction, roi: tuple[float, float, float, float] | None, places: Witness | None = None
) -> Normalisation:
    """Choose the scene frame: region of interest in [-0.9, 0.9]^3, +z up, +y where the photos look.

    ``roi`` (x, y, z, radius in the sfm frame) replaces the automatic region; the cube's half side is the radius.
    ``places`` is up by where on Earth the photos were taken.
    The result is the same up to rounding for every similar reconstruction: x' = scale rotation (x - centre) with
    all three found from shapes alone, in float64 relative to the cameras' middle.
    Raises ValueError when the cameras stand in one place and there are no points, or where the scene is too small for
    numbers, be it at its distance from the origin or by itself.
    """
    capture_type, up = find_capture_type(sfm), find_up(sfm, places)
    rotation = _frame(up.direction, sfm)
    middle = spatial_median(sfm.centres)
    _check_extent(sfm, middle)
    upright = sfm.in_frame(rotation, middle)
    given = None if roi is None else Region(rotation @ (np.array(roi[:3]) - middle), roi[3])
    cube = given or find_region(upright, capture_type)
    contradicted = 0.0 if upright.opaque is None else beyond_alpha(upright, cube, may_grow=given is None)
    if contradicted >= GOES_ON:
        upright = replace(upright, opaque=None)
        cube = given or find_region(upright, capture_type)
    region = given or grown(cube, upright)
    if not region.half >= MIN_HALF_SIZE:
        raise ValueError(f"it is {region.half:.2g} units large, and it needs at least {MIN_HALF_SIZE:g}")
    scale = REGION_HALF_SIZE / region.half
    centre = middle + rotation.T @ region.centre
    scene = upright.in_frame(np.eye(3), region.centre, scale)
    # Points cannot prove that nothing lies beyond the cube: sky and plain walls have none. Only alpha does.
    bounded = upright.opaque is not None
    near, far = near_and_far(scene, bounded)
    return Normalisation(
        scene_from_sfm=Similarity(scale, rotation, -scale * (rotation @ centre)),
        capture_type=capture_type,
        bounded=bounded,
        up=up,
        near=near,
        far=far,
        beyond_alpha=contradicted,
        beyond=share_beyond(scene, np.zeros(3), REGION_HALF_SIZE),
        arc_deg=_arc_deg(scene.centres),
    )


def _check_extent(sfm: Reconstruction, middle: Float[np.ndarray, "3"]) -> None:
    places = np.concatenate([sfm.centres, sfm.points])
    extent, distance = np.abs(places - middle).max(), np.abs(places).max()
    if 0 < extent <= ONE_PLACE * distance:
        raise ValueError(
            f"its cameras and points lie within {extent:.2g} units, {distance:.2g} from the origin: float64 cannot "
            "tell them apart"
        )


def _frame(up: Float[np.ndarray, "3"], sfm: Reconstruction) -> Float[np.ndarray, "3 3"]:
    """Rotation that takes ``up`` to +z and the photos' heading to +y.

    The heading is where most photos look, so that walls line up with the cube; where they look everywhere, it is
    the first photo's. Of a photo that looks along up, the upper edge serves: flights and fields line up with it.
    """
    axes, ups = (vectors - np.outer(vectors @ up, up) for vectors in (sfm.axes, sfm.ups))
    candidates = np.stack([spatial_median(axes), axes[0], ups[0]])
    lengths = np.linalg.norm(candidates, axis=1)
    chosen = int(np.argmax(lengths > MIN_HEADING))
    y = candidates[chosen] / lengths[chosen]
    return np.stack([np.cross(y, up), y, up])


def _arc_deg(centres: Float[np.ndarray, "n 3"]) -> float:
    """The arc about the z axis over which cameras stand: the full turn less the widest gap between neighbours."""
    azimuths = np.sort(np.degrees(np.arctan2(centres[:, 1], centres[:, 0])))
    gaps = np.diff(azimuths, append=azimuths[0] + 360)
    return float(360 - gaps.max())
