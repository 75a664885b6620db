"""The preview of a mesh: a picture from two sides, in colours and in clay, and a small copy that turns in pages."""

import numpy as np
from scipy.spatial import KDTree

from nerf.geometry.camera_paths import levelled
from nerf.geometry.scene import Scene
from nerf.geometry.space_maps import SpaceMap
from stages.mesh.files import ColouredMesh
from stages.mesh.rasteriser import Viewpoint, frame_mesh, rasterise, shade
from stages.mesh.surface import Surface
from stages.mesh.surface.decimation import decimate

WIDTH, HEIGHT = 480, 400
UP = np.array([0.0, 0.0, 1.0])
ELEVATION = 30.0  # degrees above the horizon
ROOM_FIELD_OF_VIEW = 75.0
MIN_HORIZONTAL = 0.3  # least horizontal part of a direction for its azimuth to count: 73° above the horizon
SMALL_FACES, MAX_SMALL_VERTICES = 20_000, 65_536  # of the copy that turns: 0.3 MB in a page; indices have 16 bits
COLOUR_SHADING = 0.35  # the colours hold the shading of the photos already


def preview(mesh: ColouredMesh, scene: Scene) -> np.ndarray:
    """(2 × HEIGHT, 2 × WIDTH, 3) uint8: a row per viewpoint, colours on the left and clay on the right."""
    rows = []
    for camera in viewpoints(mesh.vertices, scene):
        fragments = rasterise(mesh.vertices, mesh.faces, camera)
        colour = shade(fragments, mesh.faces, mesh.colours, camera, COLOUR_SHADING)
        clay = shade(fragments, mesh.faces, None, camera, 1.0)
        rows.append(np.concatenate([colour, clay], axis=1))
    return np.concatenate(rows)


def small_copy(mesh: ColouredMesh, space: SpaceMap) -> dict[str, np.ndarray] | None:
    """About SMALL_FACES faces of the mesh, for pages: ``positions`` int16, 32767 being the ``radius`` of the sphere
    around the ``middle``, ``faces`` uint16, ``colours`` uint8. None for one that stays too large: it is all borders."""
    small = decimate(Surface(mesh.vertices, mesh.faces), SMALL_FACES, space)
    if len(small.vertices) > MAX_SMALL_VERTICES or not len(small.faces):
        return None
    low, high = small.vertices.min(axis=0), small.vertices.max(axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(small.vertices - middle, axis=1).max()) or 1.0
    _, nearest = KDTree(mesh.vertices).query(small.vertices)
    return {
        "positions": np.rint((small.vertices - middle) / radius * 32767).astype(np.int16),
        "faces": small.faces.astype(np.uint16),
        "colours": mesh.colours[nearest],
        "middle": middle,
        "radius": np.array([radius]),
    }


def viewpoints(vertices: np.ndarray, scene: Scene) -> tuple[Viewpoint, Viewpoint]:
    """Two views of what the photos show.

    Around an object: from the side of the photo nearest to ``ELEVATION``, and as far around from there as photos were
    taken, which is opposite if they were taken all around. Facing one way: from the middle of the cameras and from the
    camera farthest from it. Both frame the whole mesh. Inside a room the cameras' own poses are used, because from
    outside only the backs of its walls could be seen.
    """
    poses = np.stack([view.scene_from_camera for view in scene.of_split("train")])
    centres = poses[:, :, 3]
    if scene.capture_type == "object-centric":
        towards = -poses[:, :, 2]
        side = towards[np.abs(towards[:, 2] - np.sin(np.radians(ELEVATION))).argmin()]
        return _framed(vertices, side, UP), _framed(vertices, _opposite(side, towards), UP)
    first = int(np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin())
    second = int(np.linalg.norm(centres - centres[first], axis=1).argmax())
    if scene.capture_type == "inside-out":
        focal_px = WIDTH / 2 / np.tan(np.radians(ROOM_FIELD_OF_VIEW) / 2)
        return Viewpoint(poses[first], focal_px, WIDTH, HEIGHT), Viewpoint(poses[second], focal_px, WIDTH, HEIGHT)
    one, other = levelled(poses[[first, second]])
    return _framed(vertices, -one[:, 2], -one[:, 1]), _framed(vertices, -other[:, 2], -other[:, 1])


def _opposite(side: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """``side`` turned around the vertical to the azimuth of ``towards`` (n, 3) farthest from it; steep ones do not
    count."""
    length = np.linalg.norm(towards[:, :2], axis=1)
    horizontal = towards[length >= min(MIN_HORIZONTAL, length.max())][:, :2]
    one, other = (complex(*part) for part in (side[:2], horizontal[_cosine(horizontal, side[:2]).argmin()]))
    turned = abs(one) * other / abs(other) if other else one
    return np.array([turned.real, turned.imag, side[2]])


def _cosine(horizontal: np.ndarray, side: np.ndarray) -> np.ndarray:
    """The cosine of the angle between each of ``horizontal`` (n, 2) and ``side``, times a common factor."""
    return horizontal @ side / np.maximum(np.linalg.norm(horizontal, axis=1), np.finfo(float).tiny)


def _framed(vertices: np.ndarray, towards: np.ndarray, up: np.ndarray) -> Viewpoint:
    """The whole mesh from direction ``towards``; +y stands in for an ``up`` that points at the camera."""
    steep = abs(towards @ up) > 0.95
    return frame_mesh(vertices, towards, np.array([0.0, 1, 0]) if steep else up, WIDTH, HEIGHT)
