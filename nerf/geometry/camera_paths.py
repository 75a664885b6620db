"""Camera paths for videos that stay near the photos: space that no photo shows renders badly.

All paths are poses ``scene_from_camera`` [rotation | centre] of shape (frames, 3, 4), numpy float64, rotations
orthonormal, OpenCV axes, in the scene frame where +z is up. ``orbit`` and ``spiral`` return to where they began: the
last frame is one step before the first. ``interpolated`` runs from one end of its tour to the other.
"""

import numpy as np
from jaxtyping import Float

from nerf.geometry.reconstruction import closest_point_to_lines, spatial_median
from nerf.geometry.region_of_interest import look_at_point

FULL_CIRCLE_GAP_DEG = 60.0  # cameras with no wider gap in azimuth surround the object
SMOOTHING_DEG = 20.0  # standard deviation over azimuth within which an orbit averages the cameras' radius and height
STEEPEST = 0.15  # least horizontal distance of an orbit to its axis and to what it looks at, in distances (81 degrees)
CLEAR_SHARE = CLEAR_REACH = 0.9  # of a path, and of what its cameras have free before them
SPIRAL_SHARE = 0.7  # quantile of the cameras' offsets that the spiral reaches
ROUNDING = 1e-9  # of tour lengths of about 10: reversing a stretch gains more, or the search would run in circles
ALONG = 0.1  # sine of the angle, 6 degrees, within which a view is along a direction
FRAMES_PER_KEY, MIN_KEY_CAMERAS = 8, 4  # interpolated: frames for each camera it sets out for, so that it is not a blur
MAX_TOUR_CAMERAS = 1000  # that a tour knows of; of more, those farthest from each other
NEIGHBOURS = 3  # of each camera, to which a tour may go on from it
FINE = 16  # points of a tour for each of its steps from camera to camera
ROUNDED_STEPS = 2  # to either side over which a tour is averaged, or, where photos stand closer, as far as
ROUNDED_FRAMES, SMOOTH_FRAMES = 4, 120  # this many frames go: hands shake. Of fewer than 120 as if there were 120

UP = np.array([0.0, 0.0, 1.0])
Poses = Float[np.ndarray, "frames 3 4"]


def orbit(cameras: Float[np.ndarray, "n 3 4"], frames: int) -> Poses:
    """Around the point all cameras look at, at the height and distance that the cameras near each azimuth have, and
    looking where these look.

    Cameras on an arc (with a gap of more than 60 degrees) give a swing to and fro within that arc.
    """
    centres = cameras[:, :, 3]
    target = closest_point_to_lines(centres, cameras[:, :, 2])
    offsets = centres - target
    azimuths = np.arctan2(offsets[:, 1], offsets[:, 0])
    start, width = _arc(azimuths)
    phase = np.arange(frames) / frames
    if 2 * np.pi - width <= np.radians(FULL_CIRCLE_GAP_DEG):
        path = start + 2 * np.pi * phase
    else:
        path = start + width * (1 - np.cos(2 * np.pi * phase)) / 2
    weight = _nearness(azimuths, path)
    radius, height = weight @ np.linalg.norm(offsets[:, :2], axis=1), weight @ offsets[:, 2]
    radius = np.maximum(radius, STEEPEST * np.hypot(radius, height))
    around = np.stack([radius * np.cos(path), radius * np.sin(path), height], axis=1)
    ahead = np.sum(-offsets * cameras[:, :, 2], axis=1, keepdims=True)
    seen = weight @ (offsets + ahead * cameras[:, :, 2])  # of lines of sight, where they are nearest to the target
    level = np.linalg.norm((seen - around)[:, :2], axis=1) / np.linalg.norm(seen - around, axis=1)
    return look_at(target + around, target + (seen if level.min() >= STEEPEST else 0 * seen))


def keeps_clear(path: Poses, cameras: Float[np.ndarray, "n 3 4"], near: Float[np.ndarray, "n"]) -> bool:
    """Whether a path stays where space is known to be free: nine tenths of it less far from some camera than that one
    has nothing before it, nine tenths of its ``near``. Where cameras stood close by and far away, or along a line, a
    path fitted to all of them leads through places where nobody stood, and what stands there."""
    apart = np.linalg.norm(path[:, None, :, 3] - cameras[:, :, 3], axis=2) / near
    return bool(np.quantile(apart.min(axis=1), CLEAR_SHARE) <= CLEAR_REACH)


def zoomed(
    cameras: Float[np.ndarray, "n 3 4"], focals: Float[np.ndarray, "n"], path: Poses
) -> Float[np.ndarray, "frames"]:
    """Focal lengths along a path: where the cameras near a frame show little of the scene, by a longer lens, a wider
    view would show what nobody saw.

    The geometric mean of the cameras' ``focals``, weighted by 1 / (d² + s²) for their distance d from the frame and the
    cameras' median distance s from their middle, so that lenses that were changed on the spot make no zoom waver.
    """
    spread = np.median(np.linalg.norm(cameras[:, :, 3] - spatial_median(cameras[:, :, 3]), axis=1))
    apart = np.linalg.norm(path[:, None, :, 3] - cameras[:, :, 3], axis=2) / (spread if spread > 0 else 1.0)
    weight = 1 / (apart**2 + 1)
    return np.exp(weight @ np.log(focals) / weight.sum(axis=1))


def _arc(azimuths: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """(start, width) in radians of the shortest arc that holds all azimuths."""
    ordered = np.sort(azimuths)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest])


def _nearness(azimuths: Float[np.ndarray, "n"], path: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames n"]:
    """Of the cameras to each frame in azimuth: weights whose sum is 1.

    exp(k (cos difference - 1)) (von Mises) is periodic and never vanishes, so that no azimuth is empty.
    """
    concentration = 1 / np.radians(SMOOTHING_DEG) ** 2
    closeness = concentration * (np.cos(path[:, None] - azimuths) - 1)
    weight = np.exp(closeness - closeness.max(axis=1, keepdims=True))
    return weight / weight.sum(axis=1, keepdims=True)


def spiral(cameras: Float[np.ndarray, "n 3 4"], frames: int) -> Poses:
    """Two turns of an ellipse before the scene that also moves in and out (LLFF's render path).

    Centred on the cameras, all frames look at one point as far ahead as the region of interest's centre (Mildenhall
    et al. 2019, ``render_path_spiral``); its half axes are 70 % quantiles of the cameras' offsets, where the published
    code takes 90 % and with it leaves the cameras' own grid at the corners.
    """
    mean, target = average_pose(cameras), _before(cameras)
    offsets = (cameras[:, :, 3] - mean[:, 3]) @ mean[:, :3]
    reach = np.quantile(np.abs(offsets), SPIRAL_SHARE, axis=0)
    angle = 4 * np.pi * np.arange(frames) / frames
    local = reach * np.stack([np.cos(angle), -np.sin(angle), -np.sin(angle / 2)], axis=1)
    return look_at(mean[:, 3] + local @ mean[:, :3].T, target, up=-mean[:, 1])


def suits_spiral(cameras: Float[np.ndarray, "n 3 4"]) -> bool:
    """Whether the cameras, too, look at what a spiral looks at: where they reach far along a wall, or over the ground,
    they look at what is before each of them, and all the spiral's views but a few would be of directions unseen."""
    return look_at_point(cameras[:, :, 3], cameras[:, :, 2], _before(cameras))


def _before(cameras: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3"]:
    """The point that the average camera looks at, as far ahead as the region's centre, which is the origin."""
    mean = average_pose(cameras)
    return mean[:, 3] + max(-mean[:, 3] @ mean[:, 2], 0.5) * mean[:, 2]


def average_pose(cameras: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3 4"]:
    """The spatial median of the centres with the rotation nearest to the mean of the rotations."""
    rotation = nearest_rotations(cameras[:, :, :3].mean(axis=0))
    return np.concatenate([rotation, spatial_median(cameras[:, :, 3])[:, None]], axis=1)


def interpolated(cameras: Float[np.ndarray, "n 3 4"], frames: int) -> Poses:
    """From camera to neighbouring camera along a short tour, at constant speed.

    It sets out for one camera in eight frames, the ones farthest from each other, and gets from one to the next by way
    of others, so that it leads around walls as the photos do. Centres and rotation matrices alike are averaged along
    the tour, which rounds its corners, and each matrix is carried to the nearest rotation. Speed counts one radian of
    turning as much as the cameras' median distance from their middle.
    """
    spread = np.median(np.linalg.norm(cameras[:, :, 3] - spatial_median(cameras[:, :, 3]), axis=1))
    unit = np.append(np.full(9, np.sqrt(2)), np.full(3, spread if spread > 0 else 1.0))
    features = np.concatenate([cameras[:, :, :3].reshape(-1, 9), cameras[:, :, 3]], axis=1) / unit
    features = features[_farthest(features, MAX_TOUR_CAMERAS)]
    tour = features[_route(features, max(MIN_KEY_CAMERAS, frames // FRAMES_PER_KEY))]
    fine = _evenly(tour, FINE * (len(tour) - 1) + 1)
    reach = max(ROUNDED_STEPS * FINE, ROUNDED_FRAMES * len(fine) // max(frames, SMOOTH_FRAMES))
    path = _rotating(_rounded(fine, reach))
    poses = _rotating(_evenly(path, frames)) * unit
    return np.concatenate([poses[:, :9].reshape(-1, 3, 3), poses[:, 9:, None]], axis=2)


def levelled(cameras: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
    """Cameras that face one way, each turned about its own axis until its upper edge is up, or, where they look down or
    up, on the side of +y: of a flight to and fro every other line is upside down, and a path would flip with it.

    One that looks along that direction is left as it is.
    """
    middle = np.abs(spatial_median(cameras[:, :, 2]))
    up = UP if middle[2] <= middle[1] + ROUNDING else np.array([0.0, 1.0, 0.0])
    x = np.cross(cameras[:, :, 2], up)
    clear = np.linalg.norm(x, axis=1) > ALONG
    turned = cameras.copy()
    z, x = cameras[clear, :, 2], _unit(x[clear])
    turned[clear, :, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    return turned


def _evenly(path: Float[np.ndarray, "m d"], count: int) -> Float[np.ndarray, "{count} d"]:
    """``count`` points at equal distances along straight lines from row to row, both ends among them."""
    length = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    at = np.linspace(0, length[-1], count)
    return np.stack([np.interp(at, length, column) for column in path.T], axis=1)


def _rounded(path: Float[np.ndarray, "m d"], reach: int) -> Float[np.ndarray, "m d"]:
    """Each row averaged with ``reach`` others to either side, the closer the more. Beyond its ends the path goes on
    mirrored, so that they stay."""
    weight = np.bartlett(2 * reach + 1) / reach
    longer = np.pad(path, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.stack([np.convolve(column, weight, mode="valid") for column in longer.T], axis=1)


def _rotating(features: Float[np.ndarray, "m 12"]) -> Float[np.ndarray, "m 12"]:
    """The same with its matrices carried to the nearest rotations, in the features' scale."""
    rotation = nearest_rotations(features[:, :9].reshape(-1, 3, 3)).reshape(-1, 9) / np.sqrt(2)
    return np.concatenate([rotation, features[:, 9:]], axis=1)


def _route(features: Float[np.ndarray, "n d"], count: int) -> np.ndarray:
    """Rows that follow each other on a short way through ``count`` of them, the farthest from each other.

    Each step leads to a neighbour: one of the few nearest, or the next on the tree that joins all with the least
    length. Steps cost the square of their length, so that many short ones beat a long one.
    """
    square = np.sum(features**2, axis=1)
    cost = np.maximum(square[:, None] + square - 2 * features @ features.T, 0)
    kth = min(NEIGHBOURS, len(cost) - 1)  # row by row, each the nearest to itself
    near = cost <= np.partition(cost, kth, axis=1)[:, kth, None]
    near[np.arange(len(cost)), _tree(cost, 0, 0.0)[1]] = True
    cost = np.where(near | near.T, cost, np.inf)
    keys = _farthest(features, count)
    lengths, before = (np.stack(each) for each in zip(*(_tree(cost, int(key), 1.0) for key in keys), strict=True))
    tour = _short_tour(lengths[:, keys])
    route = [keys[tour[-1]]]
    for start in tour[-2::-1]:  # from the end, as the trees say where each row was reached from
        while route[-1] != keys[start]:
            route.append(before[start, route[-1]])
    return np.array(route)


def _tree(cost: Float[np.ndarray, "n n"], start: int, carried: float) -> tuple[Float[np.ndarray, "n"], np.ndarray]:
    """How all rows are reached from ``start``: at which cost, and from which row; ``start`` from itself.

    ``carried`` is 1 for the shortest way to each (Dijkstra 1959), 0 for the least sum of all steps (Prim 1957).
    """
    reached, before = np.full(len(cost), np.inf), np.full(len(cost), start)
    reached[start] = 0
    left = np.ones(len(cost), bool)
    for _ in cost:
        at = int(np.argmin(np.where(left, reached, np.inf)))
        left[at] = False
        through = carried * reached[at] + cost[at]
        better = left & (through < reached)
        reached[better], before[better] = through[better], at
    return reached, before


def _farthest(features: Float[np.ndarray, "n d"], count: int) -> np.ndarray:
    """Indices of up to ``count`` rows, each the farthest from those before it; the first is row 0."""
    chosen = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < min(count, len(features)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.array(chosen)


def _short_tour(cost: Float[np.ndarray, "n n"]) -> np.ndarray:
    """An order of the rows with a short path through them: nearest neighbours, then 2-opt until nothing improves."""
    tour = [int(np.argmax(cost.sum(axis=1)))]  # the most remote one: an end of the path
    while len(tour) < len(cost):
        remaining = np.setdiff1d(np.arange(len(cost)), tour)
        tour.append(int(remaining[np.argmin(cost[tour[-1], remaining])]))
    best = np.array(tour)
    while (shorter := _uncrossed(best, cost)) is not None:
        best = shorter
    return best


def _uncrossed(tour: np.ndarray, cost: Float[np.ndarray, "n n"]) -> np.ndarray | None:
    """The tour with one stretch reversed that makes it shorter, or None."""
    for i in range(len(tour) - 1):
        for j in range(i + 1, len(tour)):
            before = cost[tour[i - 1], tour[i]] if i else 0.0
            before_turned = cost[tour[i - 1], tour[j]] if i else 0.0
            after = cost[tour[j], tour[j + 1]] if j + 1 < len(tour) else 0.0
            after_turned = cost[tour[i], tour[j + 1]] if j + 1 < len(tour) else 0.0
            if before_turned + after_turned < before + after - ROUNDING:
                return np.concatenate([tour[:i], tour[i : j + 1][::-1], tour[j + 1 :]])
    return None


def look_at(
    centres: Float[np.ndarray, "frames 3"],
    target: Float[np.ndarray, "*each 3"],
    up: Float[np.ndarray, "3"] = UP,
) -> Poses:
    """Poses at ``centres`` that look at ``target``, one for all or for each, and keep the horizon level. No view may be
    along ``up``."""
    z = _unit(target - centres)
    x = _unit(np.cross(z, up))
    return np.stack([x, np.cross(z, x), z, centres], axis=2)


def nearest_rotations(matrices: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotation nearest to each matrix in the Frobenius norm (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrices)
    sign = np.linalg.det(u @ vt)[..., None, None] * np.array([0.0, 0.0, 1.0]) + np.array([1.0, 1.0, 0.0])
    return (u * sign) @ vt


def _unit(vectors: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "frames 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
