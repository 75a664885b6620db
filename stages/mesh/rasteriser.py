"""A shaded picture of a mesh without GPU, display or library: a z-buffer in numpy.

Triangles are cut into rows of pixels, all triangles at once and in blocks of about fixed size.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerf.geometry.camera_paths import look_at
from stages.mesh.surface import face_area_vectors

SUPERSAMPLING = 2
FIELD_OF_VIEW = 35.0  # degrees
CHUNK = 1 << 17  # triangle-pixel pairs at a time, about: what fits into a processor's cache
KEY_LIGHT, HEADLIGHT, AMBIENT = 0.45, 0.30, 0.30  # fractions of the shading; together a little over 1
TOWARDS_LIGHT = np.array([-0.5, -0.75, -0.45]) / np.linalg.norm([0.5, 0.75, 0.45])  # camera axes: upper left, behind
CLAY = np.array([205, 200, 192], np.uint8)
BACKFACE = np.array([96, 84, 92], np.float32)  # the inside of an open surface must not pass for its outside
BACKGROUND_TOP, BACKGROUND_BOTTOM = np.array([250.0, 251, 253]), np.array([222.0, 226, 232])


class Viewpoint(NamedTuple):
    """A pinhole camera with OpenCV axes: pose [R | centre] (3, 4), focal length and size in pixels."""

    from_camera: np.ndarray
    focal_px: float
    width: int
    height: int


class Fragments(NamedTuple):
    """What a viewpoint sees, per subpixel on the mesh: the part of a picture worth doing once for several colours.

    ``pixel`` is its flat index, ``face`` the face in front, ``barycentric`` (n, 3) its perspective-correct weights,
    ``light`` how bright it is, and ``backfacing`` whether the back of the face is seen.
    """

    pixel: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    light: np.ndarray
    backfacing: np.ndarray


def rasterise(vertices: np.ndarray, faces: np.ndarray, camera: Viewpoint) -> Fragments:
    """The faces in front, and the light on them. Faces that reach behind the camera are left out."""
    camera = _supersampled(camera)
    points = _in_camera(vertices, camera)
    depth = points[:, 2]
    usable = np.flatnonzero((depth > 1e-6 * np.abs(points).max(initial=1e-30))[faces].all(axis=1))
    divisor = np.where(depth > 0, depth, 1.0)[:, None]
    pixels = points[:, :2] / divisor * camera.focal_px + [camera.width / 2, camera.height / 2]
    winner, _ = nearest_faces(pixels, depth, faces[usable], camera.width, camera.height)
    pixel = np.flatnonzero(winner >= 0)
    face = usable[winner[pixel]]
    return Fragments(pixel, face, *_lit(points, faces, face, pixel, camera))


def shade(
    fragments: Fragments, faces: np.ndarray, colours: np.ndarray | None, camera: Viewpoint, shading: float
) -> np.ndarray:
    """Colour the fragments of a mesh and average the subpixels, to (height, width, 3) uint8.

    ``colours`` are one uint8 triple per vertex, or None for plain clay; ``shading`` blends from the colours as they
    are (0) to fully lit (1).
    """
    image = _background(_supersampled(camera))
    if colours is None:
        colour = CLAY.astype(np.float32)
    else:
        colour = (fragments.barycentric[:, :, None] * colours[faces[fragments.face]]).sum(axis=1)
    light = fragments.light[:, None]
    lit = colour * (1 - shading + shading * light)
    image[fragments.pixel] = np.clip(
        np.where(fragments.backfacing[:, None], 0.5 * lit + 0.5 * BACKFACE * light, lit), 0, 255
    )
    tiled = image.reshape(camera.height, SUPERSAMPLING, camera.width, SUPERSAMPLING, 3)
    return np.rint(tiled.mean(axis=(1, 3))).astype(np.uint8)


def _supersampled(camera: Viewpoint) -> Viewpoint:
    pose, focal_px, width, height = camera
    return Viewpoint(pose, focal_px * SUPERSAMPLING, width * SUPERSAMPLING, height * SUPERSAMPLING)


def _in_camera(vertices: np.ndarray, camera: Viewpoint) -> np.ndarray:
    return (vertices - camera.from_camera[:, 3]) @ camera.from_camera[:, :3]


def nearest_faces(
    pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """A z-buffer: the face in front at each pixel of an image, -1 where there is none, and 1/depth there, both flat.

    ``pixels`` (n, 2) are where a camera shows the vertices, at ``depth`` (n,) along its axis; all ``faces`` must lie in
    front of it. 1/depth is linear across a face, so depths are right in perspective.
    """
    front, winner = np.zeros(width * height), np.full(width * height, -1)
    inverse_depth = 1 / depth[faces] if len(faces) else np.zeros((0, 3))
    for face, row, column in covered_pixels(pixels[faces], width, height):
        weights = barycentric(pixels[faces[face]], np.stack([column, row], axis=1) + 0.5)
        nearness, pixel = (weights * inverse_depth[face]).sum(axis=1), row * width + column
        np.maximum.at(front, pixel, nearness)
        ahead = nearness == front[pixel]
        winner[pixel[ahead]] = face[ahead]
    return winner, front


def covered_pixels(corners: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Triangles (n, 3, 2) and the pixels whose centres they cover, in blocks of (triangle, row, column), in the order
    of the triangles.

    A centre on an edge belongs to the triangle on its right or below, so that triangles that share edges share no
    pixel; those without area have none. ``corners`` must be finite.
    """
    first, last = _centres(corners[:, :, 1].min(axis=1), corners[:, :, 1].max(axis=1), height)
    rows = np.maximum(last - first, 0)
    across = np.ptp(corners[:, :, 0], axis=1).clip(max=width)
    todo = np.flatnonzero(rows)
    pairs = np.cumsum(rows[todo] * (across[todo] + 1))
    for block in np.split(todo, np.searchsorted(pairs, np.arange(CHUNK, pairs[-1], CHUNK))) if len(todo) else []:
        triangle = np.repeat(block, rows[block])
        row = first[triangle] + _counted(rows[block])
        low, high = _centres(*_span(corners[triangle], row + 0.5), width)
        columns = np.maximum(high - low, 0)
        yield np.repeat(triangle, columns), np.repeat(row, columns), np.repeat(low, columns) + _counted(columns)


def _centres(low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The first pixel whose centre is in [low, high) and the one after the last, of ``size`` pixels."""
    first, last = (np.ceil(end - 0.5).clip(0, size).astype(np.int64) for end in (low, high))
    return first, last


def _counted(lengths: np.ndarray) -> np.ndarray:
    """0 … n - 1 for each n of ``lengths``, one after another."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _span(corners: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Between which x each triangle (n, 3, 2) crosses the line at its ``y`` (n,). Two triangles that share an edge get
    the same x for it, to the bit: its ends are taken in the order of their y."""
    low, high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        swapped = (corners[:, a, 1] > corners[:, b, 1])[:, None]
        (ax, ay), (bx, by) = (np.where(swapped, corners[:, i], corners[:, j]).T for i, j in ((b, a), (a, b)))
        crosses = (ay <= y) & (y < by)
        x = ax + (y - ay) * np.divide(bx - ax, by - ay, out=np.zeros_like(y), where=crosses)
        low[crosses] = np.minimum(low, x)[crosses]
        high[crosses] = np.maximum(high, x)[crosses]
    return low, high


def barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (n, 3) of points (n, 2) in 2-D triangles (n, 3, 2); the middle of those without area."""
    edges = corners - point[:, None]
    parts = _cross(edges[:, [1, 2, 0]], edges[:, [2, 0, 1]])
    area = parts.sum(axis=1, keepdims=True)
    return np.divide(parts, area, out=np.full_like(parts, 1 / 3), where=area != 0)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _lit(
    points: np.ndarray, faces: np.ndarray, face: np.ndarray, pixel: np.ndarray, camera: Viewpoint
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Barycentric weights, light and backfacing of :class:`Fragments`, float32; ``points`` are in camera coordinates.

    What belongs to a face is computed once for it, in float64: a small one's cross products nearly cancel.
    """
    a, b, c = points[faces].swapaxes(0, 1)
    opposite = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1).astype(np.float32)
    normals = face_area_vectors(points, faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=normals, where=length > 0).astype(np.float32)[face]
    row, column = np.divmod(pixel, camera.width)
    ray = np.stack([column + 0.5 - camera.width / 2, row + 0.5 - camera.height / 2], axis=1) / camera.focal_px
    ray = np.concatenate([ray, np.ones((len(ray), 1))], axis=1).astype(np.float32)
    barycentric = np.einsum("nkj,nj->nk", opposite[face], ray)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    towards = np.einsum("nj,nj->n", normals, ray)
    backfacing = towards > 0
    normals[backfacing] *= -1
    light = KEY_LIGHT * np.clip(normals @ TOWARDS_LIGHT.astype(np.float32), 0, 1)
    light += HEADLIGHT * np.abs(towards) / np.linalg.norm(ray, axis=1)
    light += AMBIENT * (0.5 - 0.5 * normals[:, 1]) + 0.15
    return barycentric, light, backfacing


def _background(camera: Viewpoint) -> np.ndarray:
    """A light vertical gradient, flat (pixels, 3)."""
    height = np.linspace(0, 1, camera.height)[:, None]
    rows = (1 - height) * BACKGROUND_TOP + height * BACKGROUND_BOTTOM
    return np.repeat(rows.astype(np.float32), camera.width, axis=0)


def frame_mesh(vertices: np.ndarray, towards: np.ndarray, up: np.ndarray, width: int, height: int) -> Viewpoint:
    """A camera that shows all of ``vertices`` from direction ``towards`` (from the mesh to the camera)."""
    towards = towards / np.linalg.norm(towards)
    focal_px = min(width, height) / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    pose = look_at(towards[None], np.zeros(3), up)[0]
    turned = vertices @ pose[:, :3]
    middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
    turned = turned - middle
    reach = np.abs(turned[:, :2]) * focal_px / (0.46 * np.array([width, height]))
    distance = float((reach.max(axis=1) - turned[:, 2]).max())
    centre = (middle - [0, 0, distance]) @ pose[:, :3].T
    return Viewpoint(np.concatenate([pose[:, :3], centre[:, None]], axis=1), focal_px, width, height)
