"""A shaded picture of a mesh without GPU, display or library: a z-buffer in numpy.

Every triangle is tested against the pixels of its bounding box, all triangles at once and in blocks of fixed size.
"""

from typing import NamedTuple

import numpy as np

from nerf.geometry.camera_paths import look_at
from stages.mesh.surface import face_area_vectors

SUPERSAMPLING = 2
FIELD_OF_VIEW = 35.0  # degrees
CHUNK = 1 << 17  # triangle-pixel pairs tested at a time: what fits into a processor's cache
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
    winner = _nearest_faces(pixels, depth, faces[usable], camera)
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


def _nearest_faces(pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, camera: Viewpoint) -> np.ndarray:
    """The face in front at each pixel, flat, -1 where there is none."""
    corners = pixels[faces]
    size = np.array([camera.width, camera.height])
    first = np.clip(np.ceil(corners.min(axis=1) - 0.5), 0, size).astype(np.int64)
    last = np.clip(np.floor(corners.max(axis=1) - 0.5), -1, size - 1).astype(np.int64)
    extent = np.maximum(last - first + 1, 0)
    pairs = extent.prod(axis=1)
    inverse_depth = 1 / depth[faces]
    best = np.zeros(camera.width * camera.height)
    winner = np.full(camera.width * camera.height, -1)
    todo = np.flatnonzero(pairs)
    ends = np.cumsum(pairs[todo])
    for block in np.split(todo, np.searchsorted(ends, np.arange(CHUNK, ends[-1], CHUNK)) if len(ends) else []):
        face = np.repeat(block, pairs[block])
        within = np.arange(len(face)) - np.repeat(np.cumsum(pairs[block]) - pairs[block], pairs[block])
        row, column = np.divmod(within, extent[face, 0])
        x, y = first[face, 0] + column, first[face, 1] + row
        barycentric = _barycentric(corners[face], np.stack([x, y], axis=1) + 0.5)
        inside = (barycentric >= 0).all(axis=1)
        face, pixel = face[inside], y[inside] * camera.width + x[inside]
        nearness = (barycentric[inside] * inverse_depth[face]).sum(axis=1)
        order = np.argsort(nearness, kind="stable")  # of equal pixels the last, nearest, assignment stands
        pixel, face, nearness = pixel[order], face[order], nearness[order]
        front = nearness > best[pixel]
        best[pixel[front]], winner[pixel[front]] = nearness[front], face[front]
    return winner


def _barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (n, 3) of points in 2-D triangles (n, 3, 2); negative for triangles without area."""
    edges = corners - point[:, None]
    parts = _cross(edges[:, [1, 2, 0]], edges[:, [2, 0, 1]])
    area = parts.sum(axis=1, keepdims=True)
    return np.divide(parts, area, out=np.full_like(parts, -1.0), where=area != 0)


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
