"""The picture of a mesh for the report: from two sides, in its colours and in clay."""

from typing import TYPE_CHECKING

import numpy as np

from stages.mesh_preview import Viewpoint, framing, preview

if TYPE_CHECKING:
    from nerf.scene import Scene
    from stages.mesh_files import ColouredMesh

WIDTH, HEIGHT = 480, 400
UP = np.array([0.0, 0.0, 1.0])
ROOM_FIELD_OF_VIEW = 75.0
BAKED_SHADING = 0.35  # the colours hold the light of the photos already


def picture(mesh: "ColouredMesh", scene: "Scene") -> np.ndarray:
    """(2 × HEIGHT, 2 × WIDTH, 3) uint8: a row per viewpoint, colours on the left and clay on the right."""
    rows = []
    for camera in viewpoints(mesh.vertices, scene):
        colour = preview(mesh.vertices, mesh.faces, mesh.colours, camera, BAKED_SHADING)
        clay = preview(mesh.vertices, mesh.faces, None, camera)
        rows.append(np.concatenate([colour, clay], axis=1))
    return np.concatenate(rows)


def viewpoints(vertices: np.ndarray, scene: "Scene") -> tuple[Viewpoint, Viewpoint]:
    """Two sides from which photos were taken: near the middle of the cameras, and the one farthest from it.

    Around an object or in front of one, the whole mesh is framed from there; inside a room the cameras' own poses
    are used, because from outside only the backs of its walls could be seen.
    """
    poses = np.stack([view.scene_from_camera for view in scene.of_split("train")])
    centres = poses[:, :, 3]
    first = int(np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin())
    second = int(np.linalg.norm(centres - centres[first], axis=1).argmax())
    if scene.layout == "inside":
        focal_px = WIDTH / 2 / np.tan(np.radians(ROOM_FIELD_OF_VIEW) / 2)
        return Viewpoint(poses[first], focal_px, WIDTH, HEIGHT), Viewpoint(poses[second], focal_px, WIDTH, HEIGHT)
    return _framed(vertices, poses[first]), _framed(vertices, poses[second])


def _framed(vertices: np.ndarray, pose: np.ndarray) -> Viewpoint:
    """The whole mesh from a camera's side; +z is up unless the camera looks along it."""
    backward = -pose[:, 2]
    up = UP if abs(backward @ UP) < 0.95 else -pose[:, 1]
    return framing(vertices, backward, up, WIDTH, HEIGHT)
