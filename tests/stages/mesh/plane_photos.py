"""Photos of the plane z = 0 from above it, and surfaces over it."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.io.files import write_png
from stages.io.photos import Photo, write_photos
from stages.mesh.grid_space import VoxelLengths
from stages.mesh.surface import Surface


def square_camera(side: int) -> Camera:
    """Of 44 degrees, its photos ``side`` pixels wide and high."""
    return Camera("PINHOLE", side, side, (1.25 * side, 1.25 * side, side / 2, side / 2))


def sheet(cells: int, height: Callable[..., np.ndarray] = lambda x, y: np.zeros_like(x), half: float = 0.8) -> Surface:
    """The square [-half, half]² seen from above, each vertex at ``height`` (x, y)."""
    line = np.linspace(-half, half, cells + 1)
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(np.stack([x, y, height(x, y)], axis=1), faces.astype(np.int32))


def known(surface: Surface, voxel: float) -> VoxelLengths:
    """How well the surface is known: everywhere alike."""
    return VoxelLengths(*2 * [np.full(len(surface.vertices), voxel)])


def ring_of_views(count: int, radius: float, height: float) -> tuple[View, ...]:
    """Views of the plane's middle from a circle above it."""
    angle = 2 * math.pi * np.arange(count) / count
    centres = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    poses = [look_at(centre[None], np.zeros(3), np.array([0.0, 1, 0]))[0] for centre in centres]
    return tuple(View(f"{i}.png", f"images/{i}.png", 0, pose, 0.1, 9.0, "train") for i, pose in enumerate(poses))


def scene_of(camera: Camera, views: tuple[View, ...]) -> Scene:
    """Photos by one camera, not turned or scaled."""
    return Scene((camera,), views, Similarity(1.0, np.eye(3), np.zeros(3)), True, False, "forward-facing", True)


def seen_points(camera: Camera, view: View) -> np.ndarray:
    """Where the rays of a photo's pixels meet the plane, (pixels, 3)."""
    at = (np.arange(camera.width) + 0.5 - camera.width / 2) / camera.params[0]
    x, y = np.meshgrid(at, at)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ view.scene_from_camera[:, :3].T
    centre = view.scene_from_camera[:, 3]
    return centre - rays * (centre[2] / rays[:, 2:])


def write_plane_photos(
    folder: Path,
    camera: Camera,
    views: tuple[View, ...],
    colours: Callable[[int, np.ndarray], np.ndarray],
    alpha: np.ndarray | None = None,
) -> None:
    """Photos in a folder as ingest leaves them; ``colours`` (number, points): what one shows of the plane, (n, 3)."""
    photos = []
    for number, view in enumerate(views):
        shown = np.clip(colours(number, seen_points(camera, view)), 0, 1)
        pixels = np.rint(255 * shown).astype(np.uint8).reshape(camera.height, camera.width, 3)
        write_png(folder / view.file, pixels if alpha is None else np.dstack([pixels, alpha]))
        photos.append(Photo(view.name, view.file, camera.width, camera.height, 0, None, None, False, 1.0))
    write_photos(folder, photos, [], {})
