"""How the cameras stand, and the cube that holds what they were taken for.

All lengths are relative to the scene's own: the cameras' distance to what they look at, or the spread of their
standpoints. Points count once per photo that sees them, so a spurious point seen twice weighs little; extents are
quantiles, so neither far points nor a far camera shrink the scene.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nerf.geometry.reconstruction import (
    Reconstruction,
    angles_deg,
    closest_point_to_lines,
    extent,
    spatial_median,
    within,
)

CaptureType = Literal["object-centric", "inside-out", "forward-facing"]

FORWARD_DEG = 30.0  # four fifths of the optical axes within this of their median: all photos face one way
CONVERGENT_DEG = 30.0  # four fifths of the axes within this of the direction to their common focus: they look at it
MIN_WIDTH = 0.5  # of what the photos see at the focus; textured spots may be small, the object around them is not
FORWARD_REACH = 3.0  # the farthest depth the cube takes in, in median depths; beyond, detail is below a pixel's
INSIDE_REACH = 2.0  # likewise around a camera that looks outward
FAR_CAMERA = 5.0  # a camera so many times as far from the cameras' middle as is usual does not count, nor what it sees
CORE, WHOLE = 0.95, 0.999  # shares of the observations that the cube should hold, and that are the whole scene
CARVED = 48  # points along an edge of the cube that is carved
MAX_CARVING_PHOTOS = 200  # photos that carve it; more tell no more
MISTAKEN = 0.05  # of the photos in which a point is: so many may call it background by mistake
GROWTH = 1.25  # a cube that becomes WHOLE by growing at most this much is grown
# Share of the observations beyond the cube from which on a scene goes on there, whatever alpha says: ten times what
# WHOLE leaves to points that are wrong.
GOES_ON = 0.01


class Region(NamedTuple):
    """A cube of half side ``half`` about ``centre``."""

    centre: Float[np.ndarray, "3"]
    half: float


def focus(scene: Reconstruction) -> Float[np.ndarray, "3"]:
    """The point nearest to the optical axes: what the photos have in common."""
    return closest_point_to_lines(scene.centres, scene.axes)


def find_capture_type(scene: Reconstruction) -> CaptureType:
    """Forward-facing: the axes are nearly parallel; object-centric: they meet in front of the cameras; inside-out:
    neither."""
    middle = spatial_median(scene.axes)
    length = np.linalg.norm(middle)
    if length > 0 and np.quantile(angles_deg(scene.axes, middle / length), 0.8) <= FORWARD_DEG:
        return "forward-facing"
    return "object-centric" if look_at_point(scene.centres, scene.axes, focus(scene)) else "inside-out"


def look_at_point(
    centres: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "n 3"], point: Float[np.ndarray, "3"]
) -> bool:
    """Whether four fifths of the photos look within CONVERGENT_DEG of a point; one that stands on it does not."""
    towards = point - centres
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    ray_direction = np.divide(towards, distance, out=-axes, where=distance > 0)
    return bool(np.quantile(angles_deg(axes, ray_direction), 0.8) <= CONVERGENT_DEG)


def find_region(scene: Reconstruction, capture_type: CaptureType) -> Region:
    """The cube, aligned with the axes of the frame ``scene`` is in, before it is :func:`grown`.

    Object-centric: centred on the focus, holding 95 % of the observed points but not reaching beyond the cameras.
    Forward-facing: the photos' frusta between the nearest and farthest observed depths. Inside-out: the observed points
    and the cameras, up to twice the usual viewing distance. Photos with alpha show nothing but the object: it is held
    whole.
    Raises ValueError when the cameras stand in one place and there are no points to give a scale.
    """
    if capture_type == "object-centric" and scene.opaque is not None:
        cube = _carved(scene, scene.opaque)
    else:
        find = {"object-centric": _object_centric, "forward-facing": _forward_facing, "inside-out": _inside_out}
        cube = find[capture_type](scene)
    if not cube.half > 0:
        raise ValueError("all cameras have the same position, and there are no points")
    return cube


def beyond_alpha(scene: Reconstruction, cube: Region, may_grow: bool) -> float:
    """The share of observations that contradict photos with alpha, by which there is no more than the cube: their
    points lie beyond it, even when it is grown where it may. 0 without observations."""
    if not len(scene.point):
        return 0.0
    return share_beyond(scene, cube.centre, (GROWTH if may_grow else 1) * cube.half)


def share_beyond(scene: Reconstruction, centre: Float[np.ndarray, "3"], half: float) -> float:
    """The share of observations whose point lies outside a cube; 1 without observations (nothing is known)."""
    reach = _reach(scene, centre)
    return float((reach > half).mean()) if len(reach) else 1.0


def _reach(scene: Reconstruction, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "observations"]:
    """Half side of the cube about ``centre`` that just holds each observation's point."""
    return np.abs(scene.points - centre).max(axis=1, initial=0.0)[scene.point]


def grown(cube: Region, scene: Reconstruction) -> Region:
    """Let the cube hold the whole scene where that costs little; or as much of it as costs little where alpha says that
    there is no more, for then what is beyond is not shown at all."""
    if not len(scene.point):
        return cube
    whole = float(np.quantile(_reach(scene, cube.centre), WHOLE))
    if whole > GROWTH * cube.half and scene.opaque is None:
        return cube
    return Region(cube.centre, max(cube.half, min(whole, GROWTH * cube.half)))


def _near_by(scene: Reconstruction) -> Bool[np.ndarray, "n"]:
    """All photos but those taken far from where the others were."""
    distance = np.linalg.norm(scene.centres - spatial_median(scene.centres), axis=1)
    return distance <= FAR_CAMERA * np.median(distance)


def _object_centric(scene: Reconstruction) -> Region:
    centre = focus(scene)
    distance = float(np.median(np.linalg.norm(scene.centres - centre, axis=1)))
    width = distance * float(np.median(_half_widths(scene)))
    if not len(scene.point):
        return Region(centre, width)
    half = float(np.quantile(_reach(scene, centre)[_near_by(scene)[scene.view]], CORE))
    return Region(centre, min(max(half, MIN_WIDTH * width), distance))


def _carved(scene: Reconstruction, opaque: Float[np.ndarray, "n 2 2"]) -> Region:
    """What may be opaque, bare or textured: carved out of a cube that surely holds it by every photo's rectangle."""
    centre, near_by = focus(scene), _near_by(scene)
    distance = np.linalg.norm(scene.centres - centre, axis=1)
    widest = np.tan(np.minimum(np.abs(opaque).max(axis=(1, 2)), np.pi / 4))
    half = float(min((distance * widest)[near_by].max(), np.median(distance)))
    side = np.linspace(-half, half, CARVED)
    points = centre + np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    seen, clear = np.zeros(len(points), int), np.zeros(len(points), int)
    views = range(0, len(scene.centres), -(-len(scene.centres) // MAX_CARVING_PHOTOS))
    for view in views:
        at, shown = scene.project(view, points)
        seen += shown
        clear += shown & ~within(at, opaque[view])
        kept = clear <= MISTAKEN * len(views)  # the others are background even if all photos show them
        points, seen, clear = points[kept], seen[kept], clear[kept]
    left = points[(seen > clear) & (clear <= MISTAKEN * seen)]
    if not len(left):
        return Region(centre, half)
    low, high = extent(left)
    return Region((low + high) / 2, float(min((high - low).max() / 2 + side[1] - side[0], half)))


def _half_widths(scene: Reconstruction) -> Float[np.ndarray, "n"]:
    """How far each photo sees to the side, at unit depth; at most 1 (45 degrees)."""
    sideways = np.abs(scene.ray_directions[..., :2]).max(-1) / np.maximum(scene.ray_directions[..., 2], 1e-3)
    return np.minimum(sideways.max(-1), 1.0)


def _forward_facing(scene: Reconstruction) -> Region:
    near, far = _depth_extent(scene)
    near_by = _near_by(scene)
    ends = np.concatenate([scene.centres[:, None] + depth * scene.rays for depth in (near, far)], axis=1)
    low, high = np.quantile(ends[near_by].reshape(-1, 3), [0.02, 0.98], axis=0)
    return Region((low + high) / 2, float((high - low).max() / 2))


def _depth_extent(scene: Reconstruction) -> tuple[float, float]:
    """The depths between which photos that face one way show something."""
    if len(scene.point):
        depths = scene.distances()[_near_by(scene)[scene.view]]
        near, far = np.quantile(depths, [1 - CORE, CORE])
        return float(near), float(min(far, FORWARD_REACH * np.median(depths)))
    spread = float(np.median(np.linalg.norm(scene.centres - spatial_median(scene.centres), axis=1)))
    distance = float(np.median(np.linalg.norm(scene.centres - focus(scene), axis=1)))
    # axes that meet closer than this are parallel up to noise: fall back on a comfortable stereo base, 1 : 8
    depth = distance if distance > 4 * spread else 8 * spread
    return depth / 2, depth * 2


def _inside_out(scene: Reconstruction) -> Region:
    middle = spatial_median(scene.centres)
    spread = np.linalg.norm(scene.centres - middle, axis=1)
    centres = scene.centres[_near_by(scene)]
    low, high = centres.min(axis=0), centres.max(axis=0)
    if not len(scene.point):
        return Region(middle, 3 * float(np.quantile(spread, 0.9)))
    reach = INSIDE_REACH * np.median(scene.distances())
    seen = scene.points[scene.point[_near_by(scene)[scene.view]]]
    points = np.quantile(seen, [(1 - CORE) / 2, (1 + CORE) / 2], axis=0)
    low = np.minimum(low, np.maximum(points[0], low - reach))
    high = np.maximum(high, np.minimum(points[1], high + reach))
    return Region((low + high) / 2, float((high - low).max() / 2))
