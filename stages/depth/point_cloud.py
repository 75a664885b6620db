"""Depth maps of many photos become one cloud of points: each piece of surface once, where several photos agree on it.

A photo's pixel becomes a point if the depth map of another photo has the same surface there, no more of them look
through it than see it (the geometric consistency of COLMAP's and OpenMVS's fusion), and none of those that see it has
finer pixels: that one gives the point. So every photo's points follow from the depth maps alone, in any order.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from nerf.geometry.scene import Similarity
from nerf.runtime.parallel import in_order
from stages.depth.consistency import DepthMap
from stages.depth.photos import TrainingPhotos
from stages.depth.rectification import Viewpoint
from stages.mesh.files import offset_for_float32
from stages.sfm.colmap.cameras import project

MAX_OTHERS = 10  # photos that a photo's points are looked up in, those that share most tracks
MIN_TOLERANCE, TOLERANCE_SIGMAS = 0.004, 3.0  # of the distance, by which depth maps may differ on one surface
NORMAL_WINDOW = 7  # pixels along each side of the patch whose plane gives a normal
MIN_NORMAL_PIXELS = 9
OPEN = 1e-14  # of the moments' determinant by their trace cubed: pixels in a row leave a direction open
MAX_POINTS = 10_000_000
COUNTED_PHOTOS = 8  # of which it is counted how many pixels become points, where there may be more of them than that
ReadMap = Callable[[int], DepthMap]


class PointCloud(NamedTuple):
    """``points`` (n, 3) float64 in the scene's frame, unit ``normals`` towards the photos, ``colours`` sRGB, and in how
    many photos' depth maps each is (``confidence``)."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    confidence: UInt8[np.ndarray, "n"]


def fuse(photos: TrainingPhotos, read: ReadMap, known: int, tell: Callable[[float], None]) -> PointCloud:
    """The cloud of all depth maps, which have ``known`` pixels in all."""
    others = _overlapping(photos)
    share = 1.0 if known <= MAX_POINTS else min(1.0, MAX_POINTS / (known * _kept_share(photos, read, others)))

    def of_photo(number: int) -> PointCloud:
        return _of_photo(photos, read, number, others[number], share)

    clouds = []
    for done, cloud in enumerate(in_order(of_photo, range(len(photos.views)), torch.device("cpu")), 1):
        clouds.append(cloud)
        tell(done / len(photos.views))
    cloud = PointCloud(*(np.concatenate(part) for part in zip(*clouds, strict=True)))
    share = min(1.0, MAX_POINTS / max(len(cloud.points), 1))  # the estimate may have been too low
    return cloud if share == 1 else PointCloud(*(part[_evenly(len(part), share)] for part in cloud))


def _evenly(count: int, share: float) -> Bool[np.ndarray, "count"]:
    """A ``share`` of so many, evenly."""
    return np.diff(np.floor(np.arange(count + 1) * share)) > 0


def _kept_share(photos: TrainingPhotos, read: ReadMap, others: list[list[int]]) -> float:
    """Which share of the known pixels become points, by some of the photos."""
    some = range(0, len(photos.views), -(-len(photos.views) // COUNTED_PHOTOS))

    def count(number: int) -> int:
        return len(_of_photo(photos, read, number, others[number], 1.0).points)

    kept = sum(in_order(count, some, torch.device("cpu")))
    return max(kept, 1) / max(sum(int(np.count_nonzero(read(number).distance)) for number in some), 1)


def _overlapping(photos: TrainingPhotos) -> list[list[int]]:
    """Of each photo the MAX_OTHERS that share most tracks with it."""
    shared = photos.tracks.shared(len(photos.views))
    found = []
    for number in range(len(photos.views)):
        row = shared[number].tocoo()
        ranked = [int(one) for one in row.col[np.argsort(-row.data, kind="stable")] if one != number]
        found.append(ranked[:MAX_OTHERS])
    return found


def _of_photo(photos: TrainingPhotos, read: ReadMap, number: int, others: list[int], share: float) -> PointCloud:
    """The points that one photo gives, or a ``share`` of them, evenly."""
    viewpoint, depth = photos.viewpoints[number], read(number)
    row, column = np.nonzero(depth.distance > 0)
    distance, sigma = depth.distance[row, column].astype(float), depth.sigma[row, column]
    rotation, centre = viewpoint.scene_from_camera[:, :3], viewpoint.scene_from_camera[:, 3]
    local = distance[:, None] * viewpoint.ray_directions[row, column]
    points = local @ rotation.T + centre
    pixel = distance / viewpoint.focal_px
    agreeing, seen_through = np.ones(len(row), np.int16), np.zeros(len(row), np.int16)
    finest = np.ones(len(row), bool)
    colours = [photos.colours(number)[row, column].astype(np.float32)]
    for other in others:
        agrees, beyond, its_pixel, colour = _look_up(photos, read, other, points, sigma)
        agreeing += agrees
        seen_through += beyond
        finer = (its_pixel < pixel) if other > number else (its_pixel <= pixel)
        finest &= ~(agrees & finer)
        colours.append(np.where(agrees[:, None], colour, np.float32(np.nan)))
    kept = np.flatnonzero(finest & (agreeing > 1) & (agreeing > seen_through))
    kept = kept[_evenly(len(kept), share)]
    colour = _medians(np.stack([one[kept] for one in colours]))
    normal = normals(viewpoint, depth)[row[kept], column[kept]] @ rotation.T
    return PointCloud(points[kept], normal, np.rint(colour).astype(np.uint8), agreeing[kept].astype(np.uint8))


def _medians(values: Float[np.ndarray, "views n 3"]) -> Float[np.ndarray, "n 3"]:
    """The lower median of each column's numbers; NaN are none. Several times faster than NumPy's."""
    known = np.isfinite(values[..., :1]).sum(axis=0)
    return np.take_along_axis(np.sort(values, axis=0), ((known - 1) // 2)[None], axis=0)[0]


def _look_up(
    photos: TrainingPhotos, read: ReadMap, other: int, points: np.ndarray, sigma: np.ndarray
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Of points: whether another photo has them on a surface, whether it sees through them, how large its pixels are
    there, and its colours."""
    viewpoint, depth = photos.viewpoints[other], read(other)
    local = (points - viewpoint.scene_from_camera[:, 3]) @ viewpoint.scene_from_camera[:, :3]
    away = np.linalg.norm(local, axis=1)
    size = np.array(viewpoint.size)
    at = project(viewpoint.camera, local) * viewpoint.scale
    inside = ((at > 0) & (at < size)).all(axis=1) & (local[:, 2] > 0)
    column, row = np.where(inside[:, None], at, 0).astype(int).T
    found = np.where(inside, depth.distance[row, column], 0)
    tolerance = np.maximum(MIN_TOLERANCE, TOLERANCE_SIGMAS * np.hypot(sigma, depth.sigma[row, column]))
    ratio = found / np.maximum(away, 1e-30) - 1
    agrees, beyond = (found > 0) & (np.abs(ratio) < tolerance), (found > 0) & (ratio > 2 * tolerance)
    return agrees, beyond, away / viewpoint.focal_px, photos.colours(other)[row, column].astype(np.float32)


def normals(viewpoint: Viewpoint, depth: DepthMap) -> Float[np.ndarray, "h w 3"]:
    """Unit normals in the camera's frame, towards it; straight towards it where too little is known around a pixel.

    The points of a plane n · X = 1 have inverse distances n · r along rays r, exactly and in any camera: n is their
    least-squares fit over a window.
    """
    rays = viewpoint.ray_directions.astype(float)
    known = (depth.distance > 0).astype(float)
    inverse = np.divide(1, depth.distance, out=np.zeros_like(known), where=known > 0)

    def summed(values: np.ndarray) -> np.ndarray:
        window = (NORMAL_WINDOW, NORMAL_WINDOW)
        return cv2.boxFilter(values * known, cv2.CV_64F, window, normalize=False, borderType=cv2.BORDER_CONSTANT)

    rows, columns = np.nonzero(summed(known) >= MIN_NORMAL_PIXELS)
    moments, sums = np.empty((3, 3, len(rows))), np.empty((3, len(rows)))
    for i in range(3):
        sums[i] = summed(rays[..., i] * inverse)[rows, columns]
        for j in range(i, 3):
            moments[i, j] = moments[j, i] = summed(rays[..., i] * rays[..., j])[rows, columns]
    # The moments' inverse is their adjugate over their determinant, which is positive: only its direction is wanted.
    adjugate = [np.cross(moments[(i + 1) % 3], moments[(i + 2) % 3], axis=0) for i in range(3)]
    determinant = (moments[0] * adjugate[0]).sum(axis=0)
    plane = adjugate[0] * sums[0] + adjugate[1] * sums[1] + adjugate[2] * sums[2]
    length = np.linalg.norm(plane, axis=0)
    solid = (determinant > OPEN * np.trace(moments) ** 3) & (length > 0)
    result = -rays
    result[rows[solid], columns[solid]] = -(plane[:, solid] / length[solid]).T
    return result


def ply_bytes(cloud: PointCloud, file_from_scene: Similarity) -> bytes:
    """Binary little-endian PLY of a cloud in another frame; double coordinates where float32 would be too coarse."""
    points = file_from_scene.points(cloud.points)
    far = len(points) > 0 and offset_for_float32(points).any()
    real, name = ("<f8", "double") if far else ("<f4", "float")
    vertex = np.empty(len(points), [("p", real, 3), ("n", "<f4", 3), ("c", "u1", 3), ("confidence", "u1")])
    vertex["p"], vertex["n"] = points, cloud.normals @ file_from_scene.rotation.T
    vertex["c"], vertex["confidence"] = cloud.colours, cloud.confidence
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertex)}",
        *(f"property {name} {axis}" for axis in "xyz"),
        *(f"property float n{axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        "property uchar confidence",
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + vertex.tobytes()
