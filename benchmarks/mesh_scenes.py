"""Synthetic photos with exact cameras and surfaces, to measure meshes by (benchmarks/mesh_truth.py).

The demo's still life; textured solids on a textured ground and before plain white; a room seen from one side.
Lengths are in world units: the still life's table, the ground and the box around a solid are 2 wide, the room is 4.
"""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from PIL import Image

from nerf.geometry.camera_paths import look_at
from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from nerf.synthetic import textures
from nerf.synthetic.scenes import Solid, SyntheticScene, photograph, ring_of_cameras, still_life
from nerf.synthetic.shapes import Box, Sphere
from pipeline.demo.truth import seen
from stages.io.transforms_export import OPENGL_FROM_OPENCV
from stages.mesh.rasteriser import barycentric, nearest_faces
from stages.mesh.surface import face_area_vectors, sampled_faces

SAMPLES_PER_SIDE = 2
TRUE_SAMPLES, VISIBLE_SAMPLES = 200_000, 40_000  # of all of the surface; of these, whether photos show them
TOWARDS_LIGHT = np.array([0.53, -0.40, 0.75])
LIGHT, AMBIENT = 0.7, 0.5
SEEN_TOLERANCE = 0.004  # of a depth; a z-buffer knows no better between its pixels
GROUND_RADIUS, GROUND_HEIGHT = 1.0, 0.0
ROOM = (2.0, 1.5, 1.25)  # half of its width, depth and height


class Points(NamedTuple):
    """Points (n, 3) on a true surface, and its outward normals there."""

    position: np.ndarray
    normal: np.ndarray

    def where(self, kept: np.ndarray) -> "Points":
        """Those that are marked or numbered."""
        return Points(self.position[kept], self.normal[kept])


class Plane(NamedTuple):
    """A flat part of a scene: a point on it, its normal, and how far from the point it reaches along x, y and z."""

    point: np.ndarray
    normal: np.ndarray
    reach: np.ndarray


class SyntheticPhotos(NamedTuple):
    """Cameras ``poses`` (n, 3, 4), world_from_camera, of a pinhole camera; ``draw`` makes the photo of a pose, sRGB in
    [0, 1]; ``surface`` is all of the true surface, ``visible`` what at least two photos show of it. ``asked``: which
    points (n, 3) lie where the truth is known, ``thin``: which belong to thin parts."""

    side: tuple[int, int]
    focal_px: float
    poses: np.ndarray
    draw: Callable[[np.ndarray], np.ndarray]
    surface: Points
    visible: Points
    planes: tuple[Plane, ...]
    size: float
    asked: Callable[[np.ndarray], np.ndarray]
    thin: Callable[[np.ndarray], np.ndarray]


class TexturedMesh(NamedTuple):
    """A solid of triangles; ``colour_of`` gives linear reflectance (n, 3) of points: face, barycentric, position."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colour_of: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def scene_of(name: str, solids: Path, width: int, photos: int | None) -> SyntheticPhotos:
    """The scene of that name; ``photos`` None: as many as it is meant to have."""
    if name == "demo":
        return _still_life(width, photos or 40)
    if name == "room":
        return _room(width, photos or 20)
    solid, _, behind = name.partition("_")
    return _solid(solids / solid, behind, width, photos or 60)


SCENES = ("demo", "spot_ground", "spot_white", "bob_ground", "bob_white", "room")


def write_photos(scene: SyntheticPhotos, folder: Path) -> None:
    """The photos and transforms.json; nothing where they are there already."""
    frames = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for number, pose in enumerate(scene.poses):
        name = f"images/photo_{number:03d}.png"
        if not (folder / name).exists():
            image = scene.draw(pose)
            Image.fromarray((255 * image.clip(0, 1)).round().astype(np.uint8)).save(folder / name)
        matrix = np.vstack([pose, [0, 0, 0, 1]])
        matrix[:3, :3] = matrix[:3, :3] @ OPENGL_FROM_OPENCV
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    width, height = scene.side
    camera = {"w": width, "h": height, "fl_x": scene.focal_px, "fl_y": scene.focal_px}
    content = camera | {"cx": width / 2, "cy": height / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def _still_life(width: int, photos: int) -> SyntheticPhotos:
    side, focal_px = (width, width * 3 // 4), 1.04 * width
    scene, poses = still_life(), ring_of_cameras(photos)
    table = Plane(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.95, 0.95, 0.03]))
    return _exact(scene, side, focal_px, poses, (table,), 2.0)


def _room(width: int, photos: int) -> SyntheticPhotos:
    """Three walls, floor, a table, a box, a ball and a lamp's thin stand, from a step to the left to one to the
    right."""
    noise = textures.make_noise(3)
    x, y, z = ROOM
    thick = 0.1

    def box(half: tuple[float, float, float], at: tuple[float, float, float], texture: Callable) -> Solid:
        pose = torch.cat([torch.eye(3), torch.tensor(at)[:, None]], dim=1)
        return Solid(Box(half), pose, partial(_placed, texture, noise, torch.tensor(at)))

    solids = [
        box((x + thick, y, thick), (0, 0, -thick), textures.mosaic),
        box((x + thick, thick, z), (0, y + thick, z), _wallpaper),
        box((thick, y, z), (-x - thick, 0, z), _plaster),
        box((thick, y, z), (x + thick, 0, z), _plaster),
        box((0.6, 0.4, 0.03), (0.3, 0.2, 0.75), textures.banded),
        box((0.35, 0.3, 0.35), (-1.2, 0.6, 0.35), textures.wrapping),
        box((0.5, 0.02, 0.35), (0.2, y - 0.02, 1.6), textures.foliage),
        *(
            box((0.03, 0.03, 0.36), (0.3 + a, 0.2 + b, 0.36), textures.peel)
            for a in (-0.55, 0.55)
            for b in (-0.35, 0.35)
        ),
        box((0.02, 0.02, 0.8), (1.4, 0.7, 0.8), textures.peel),
    ]
    ball = torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, 0.15], [0, 0, 1, 0.95]])
    solids.append(Solid(Sphere(0.17), ball, partial(textures.marble, noise)))
    across = np.linspace(-0.7, 0.7, photos)
    centres = np.stack([across, -2.6 + 0.1 * np.cos(9 * across), 1.3 + 0.35 * np.sin(7 * across)], axis=1)
    poses = look_at(centres, np.array([0.0, 0.8, 1.0]))
    floor, back = (
        Plane(np.array([0, 0, 0]), np.array([0.0, 0, 1]), np.array([x - 0.05, y - 0.05, 0.04])),
        Plane(np.array([0, y, z]), np.array([0.0, -1, 0]), np.array([x - 0.05, 0.04, z - 0.05])),
    )
    left = Plane(np.array([-x, 0, z]), np.array([1.0, 0, 0]), np.array([0.04, y - 0.05, z - 0.05]))
    scene = SyntheticScene(tuple(solids), noise)
    return _exact(scene, (width, width * 3 // 4), 0.75 * width, poses, (floor, back, left), 4.0)


def _placed(texture: Callable, noise: textures.Noise, at: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    return texture(noise, points + at)


def _plaster(noise: textures.Noise, points: torch.Tensor) -> torch.Tensor:
    """A wall with little on it."""
    return textures.mix((0.55, 0.50, 0.42), (0.72, 0.68, 0.60), noise.fractal(3 * points, 5))


def _wallpaper(noise: textures.Noise, points: torch.Tensor) -> torch.Tensor:
    """Stripes with a grain."""
    stripe = (9 * points[..., 0]).sin() * 2 + 0.5
    colour = textures.mix((0.30, 0.38, 0.42), (0.62, 0.60, 0.50), stripe)
    return colour * (0.7 + 0.5 * noise.fractal(9 * points, 4))[..., None]


def _exact(
    scene: SyntheticScene,
    side: tuple[int, int],
    focal_px: float,
    poses: np.ndarray,
    planes: tuple[Plane, ...],
    size: float,
) -> SyntheticPhotos:
    """A scene of shapes, whose rays are traced."""
    wide, tall = (SAMPLES_PER_SIDE * each for each in side)
    row, column = np.mgrid[:tall, :wide] + 0.5
    rays = np.stack([column - wide / 2, row - tall / 2, np.full_like(row, SAMPLES_PER_SIDE * focal_px)], axis=-1)
    directions = torch.tensor(rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype=torch.float32)

    def draw(pose: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return photograph(scene, directions, torch.tensor(pose, dtype=torch.float32), SAMPLES_PER_SIDE).numpy()

    points, normals = scene.surface_points(TRUE_SAMPLES, seed=0)
    surface = Points(points.double().numpy(), normals.double().numpy())
    some = surface.where(np.arange(VISIBLE_SAMPLES))
    count = np.zeros(len(some.position), int)
    for pose in poses:
        there = _in_frustum(some.position, pose, side, focal_px)
        centre = torch.tensor(pose[None, :, 3], dtype=torch.float32)
        count[there] += seen(scene, points[there], normals[there], centre).numpy()
    visible = some.where(count >= 2)
    asked, thin = (_in_room, _legs) if size > 2 else (_anywhere, _nowhere)
    return SyntheticPhotos(side, focal_px, poses, draw, surface, visible, planes, size, asked, thin)


def _in_frustum(points: np.ndarray, pose: np.ndarray, side: tuple[int, int], focal_px: float) -> np.ndarray:
    """Indices of the points that a camera's photo may show."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    pixels = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * focal_px
    return np.flatnonzero((local[:, 2] > 0) & (np.abs(pixels) < np.array(side) / 2).all(axis=1))


def _solid(folder: Path, behind: str, width: int, photos: int) -> SyntheticPhotos:
    """A textured solid whose box has a diagonal of 2, on a textured ground or before plain white."""
    solid, lowest = _loaded(folder), 0.0
    meshes, planes = [solid], ()
    if behind == "ground":
        meshes.append(_ground())
        planes = (Plane(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.9, 0.9, 0.03])),)
    else:
        lowest = -0.5
    height = float(solid.vertices[:, 2].max())
    turn, middle = np.arange(photos) * math.pi * (3 - math.sqrt(5)), np.array([0, 0, height / 2])
    rise = np.linspace(0.3 if behind == "ground" else lowest, 0.85, photos)[
        np.random.default_rng(0).permutation(photos)
    ]
    ring = np.stack([np.cos(turn) * np.sqrt(1 - rise**2), np.sin(turn) * np.sqrt(1 - rise**2), rise], axis=1)
    poses, side, focal_px = look_at(middle + 3.0 * ring, middle), (width, width), 1.25 * width
    draw = partial(_rasterised, meshes, side, focal_px, 1.0 if behind == "white" else 0.55)
    surface = Points(*(np.concatenate(parts) for parts in zip(*(_sampled(mesh) for mesh in meshes), strict=True)))
    surface = surface.where(_on_ground(surface.position)) if behind == "ground" else surface
    some = surface.where(np.random.default_rng(1).permutation(len(surface.position))[:VISIBLE_SAMPLES])
    visible = some.where(_seen_count(some, meshes, poses, side, focal_px) >= 2)
    asked = _on_ground if behind == "ground" else _anywhere
    return SyntheticPhotos(side, focal_px, poses, draw, surface, visible, planes, 2.0, asked, _nowhere)


def _anywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


def _nowhere(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points), bool)


def _on_ground(points: np.ndarray) -> np.ndarray:
    return np.hypot(points[:, 0], points[:, 1]) < GROUND_RADIUS


def _in_room(points: np.ndarray) -> np.ndarray:
    return np.all(np.abs(points - [0, 0, ROOM[2]]) < np.array(ROOM) + 0.2, axis=1)


def _legs(points: np.ndarray) -> np.ndarray:
    """The legs of the table and the stand."""
    x, y, z = points.T
    legs = (np.abs(np.abs(x - 0.3) - 0.55) < 0.031) & (np.abs(np.abs(y - 0.2) - 0.35) < 0.031) & (z < 0.7)
    stand = (np.abs(x - 1.4) < 0.021) & (np.abs(y - 0.7) < 0.021)
    return (legs | stand) & (z > 0.02)


def _loaded(folder: Path) -> TexturedMesh:
    """The mesh of a folder, upright, standing at z = 0 over the origin, with its picture."""
    loaded: Any = trimesh.load_mesh(  # its types do not tell what a file holds
        next(folder.glob("*.obj")), process=False, skip_materials=True
    )
    picture = np.asarray(Image.open(next(folder.glob("*.png"))).convert("RGB"), np.float32) / 255
    linear = srgb_to_linear(torch.from_numpy(picture)).numpy()
    vertices = np.asarray(loaded.vertices, float)[:, [0, 2, 1]] * [1, -1, 1]
    vertices *= 2 / np.linalg.norm(np.ptp(vertices, axis=0))
    vertices -= [*(vertices.min(0) + vertices.max(0))[:2] / 2, vertices[:, 2].min()]
    faces, uv = np.asarray(loaded.faces), np.asarray(loaded.visual.uv)
    tall, wide, _ = linear.shape

    def colour_of(face: np.ndarray, weights: np.ndarray, _: np.ndarray) -> np.ndarray:
        at = np.einsum("ni,nic->nc", weights, uv[faces[face]])
        column = (at[:, 0] * wide).astype(int).clip(0, wide - 1)
        return linear[((1 - at[:, 1]) * tall).astype(int).clip(0, tall - 1), column]

    return TexturedMesh(vertices, faces, _smooth_normals(vertices, faces), colour_of)


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of vertices; those at one place (on both sides of a seam of the texture) share one."""
    _, which = np.unique(vertices.round(6), axis=0, return_inverse=True)
    which = which.reshape(-1)
    total = np.zeros((which.max() + 1, 3))
    np.add.at(total, which[faces].reshape(-1), np.repeat(face_area_vectors(vertices, faces), 3, axis=0))
    return (total / np.linalg.norm(total, axis=1, keepdims=True))[which]


def _ground() -> TexturedMesh:
    """A square of tiles, cut finely enough that none reaches behind a camera."""
    line = np.linspace(-1.6, 1.6, 33)
    grid = np.stack(np.meshgrid(line, line, [GROUND_HEIGHT], indexing="ij"), axis=-1).reshape(-1, 3)
    corner = (np.arange(32)[:, None] * 33 + np.arange(32)).reshape(-1)
    faces = np.concatenate(
        [np.stack([corner, corner + 33, corner + 34], 1), np.stack([corner, corner + 34, corner + 1], 1)]
    )
    noise = textures.make_noise(5)

    def colour_of(_: np.ndarray, __: np.ndarray, points: np.ndarray) -> np.ndarray:
        return textures.mosaic(noise, torch.tensor(points, dtype=torch.float32)).numpy()

    return TexturedMesh(grid, faces, np.tile([0.0, 0, 1], (len(grid), 1)), colour_of)


def _sampled(mesh: TexturedMesh) -> Points:
    points, face = sampled_faces(mesh.vertices, mesh.faces, TRUE_SAMPLES, seed=0)
    normal = face_area_vectors(mesh.vertices, mesh.faces)[face]
    return Points(points, normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _depths(meshes: list[TexturedMesh], pose: np.ndarray, wide: int, tall: int, focal_px: float) -> tuple:
    """All faces of the meshes in one z-buffer."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)])
    local = (vertices - pose[:, 3]) @ pose[:, :3]
    pixels = local[:, :2] / local[:, 2:] * focal_px + [wide / 2, tall / 2]
    return vertices, faces, pixels, local[:, 2], *nearest_faces(pixels, local[:, 2], faces, wide, tall)


def _rasterised(
    meshes: list[TexturedMesh], side: tuple[int, int], focal_px: float, background: float, pose: np.ndarray
) -> np.ndarray:
    """A photo of the meshes under a light and a sky, averaged over the samples of a pixel."""
    wide, tall = (SAMPLES_PER_SIDE * each for each in side)
    vertices, faces, pixels, depth, winner, _ = _depths(meshes, pose, wide, tall, SAMPLES_PER_SIDE * focal_px)
    pixel = np.flatnonzero(winner >= 0)
    face = winner[pixel]
    row, column = np.divmod(pixel, wide)
    weights = barycentric(pixels[faces[face]], np.stack([column, row], axis=1) + 0.5) / depth[faces[face]]
    weights /= weights.sum(axis=1, keepdims=True)
    points = np.einsum("ni,nic->nc", weights, vertices[faces[face]])
    normals = np.einsum("ni,nic->nc", weights, np.concatenate([mesh.normals for mesh in meshes])[faces[face]])
    light = AMBIENT * (0.75 + 0.25 * normals[:, 2]) + LIGHT * (normals @ TOWARDS_LIGHT).clip(0)
    image, first = np.full((tall * wide, 3), background, np.float32), 0
    for mesh in meshes:
        mine = (face >= first) & (face < first + len(mesh.faces))
        reflected = mesh.colour_of(face[mine] - first, weights[mine], points[mine]) * light[mine, None]
        image[pixel[mine]] = linear_to_srgb(torch.from_numpy(reflected.clip(0, 1))).numpy()
        first += len(mesh.faces)
    return image.reshape(side[1], SAMPLES_PER_SIDE, side[0], SAMPLES_PER_SIDE, 3).mean((1, 3))


def _seen_count(
    surface: Points, meshes: list[TexturedMesh], poses: np.ndarray, side: tuple[int, int], focal_px: float
) -> np.ndarray:
    """How many photos show each point."""
    count = np.zeros(len(surface.position), int)
    for pose in poses:
        *_, front = _depths(meshes, pose, *side, focal_px)
        there = _in_frustum(surface.position, pose, side, focal_px)
        local = (surface.position[there] - pose[:, 3]) @ pose[:, :3]
        column, row = (local[:, :2] / local[:, 2:] * focal_px + np.array(side) / 2).astype(int).T
        facing = (surface.normal[there] * (pose[:, 3] - surface.position[there])).sum(1) > 0
        count[there] += facing & (local[:, 2] * front[row * side[0] + column] < 1 + SEEN_TOLERANCE)
    return count
