"""Which training photos see each vertex of a surface, and from where.

A vertex lies *in the frustum* of a photo where it projects into its image, its mask ignores nothing there, and it is
between near and far. It is *visible* when it also faces the camera and its ray loses no more than half of its
transmittance on the way. That is looked up in a shadow map (Williams 1978): per photo a coarse grid of rays with the
distance at which each loses half of its transmittance.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import maximum_filter

from nerf.fields.density_grid import DensityGrid, median_depth
from nerf.geometry.rays import Rays, join_rays
from nerf.geometry.scene import Camera, Scene, View
from nerf.runtime.parallel import in_order
from nerf.runtime.randomness import generator
from stages.mesh.grid_space import GridSpace
from stages.sfm.colmap.cameras import project
from stages.train.data import view_mask, view_rays

NUM_RAYS = 1 << 17  # over all photos: enough for the iso-level and the maps, seconds on two cores
# However many photos there are, a cell must not be so large that the farthest thing in it hides nothing any more.
MIN_MAP_SIDE, MAX_MAP_SIDE = 48, 96
MAX_MASK_SIDE = 384  # a cell counts as ignored if any pixel in it is, and thin things must not go
DEPTH_BIAS_VOXELS = 3.0  # the surface lies before the median depth, and the map is coarse
MIN_COSINE = 0.1  # between viewing ray and normal; below it a vertex is grazed, not visible
CHUNK = 1 << 15  # vertices at a time: what fits into a processor's cache


class Visibility(NamedTuple):
    """Per vertex: in how many photos' frustums it lies, in how many it is visible, and the mean viewing direction.

    ``direction`` (n, 3) is a unit vector from the cameras that see the vertex towards it, each weighted by the cosine
    between ray and normal; where none sees it, it is the inward normal.
    """

    in_frustum: np.ndarray
    visible: np.ndarray
    direction: np.ndarray


class ShadowMap(NamedTuple):
    """A photo and the distance at which each of its coarse grid of rays (h, w) loses half of its transmittance."""

    view: View
    camera: Camera
    rays: Rays
    depth: np.ndarray  # the largest of a cell and its neighbours, so that silhouettes hide nothing behind them
    mask: np.ndarray | None  # True where the photo counts, finer than the rays; None: everywhere


def shadow_maps(
    grid: DensityGrid,
    space: GridSpace,
    scene: Scene,
    ingest: Path,
    views: Sequence[View],
    on_view: Callable[[float], None],
) -> list[ShadowMap]:
    """One map per photo; together about ``NUM_RAYS`` rays, more of many photos, each with a sample per voxel of the
    longest edge. ``space``: the grid's. Masks lie in the folder of stage ``ingest``."""

    def map_of(view: View) -> ShadowMap:
        camera = scene.cameras[view.camera]
        pixels, longer = camera.width * camera.height, max(camera.width, camera.height)
        shared = min((pixels * len(views) / NUM_RAYS) ** 0.5, longer / MIN_MAP_SIDE)
        downscale = max(shared, longer / MAX_MAP_SIDE, 1.0)
        rays = view_rays(scene, view, downscale)
        rays = rays.each(lambda part: part.to(grid.low.device))
        mapped = space.map_rays(rays)
        depth = median_depth(grid, mapped.rays, max(grid.values.shape))[..., None]
        depth = torch.where(depth.isinf(), depth, mapped.to_scene(depth)).squeeze(-1).cpu().numpy()
        mask = view_mask(ingest, scene, view, max(1.0, longer / MAX_MASK_SIDE))
        depth = maximum_filter(depth, size=3, mode="nearest")
        return ShadowMap(view, camera, rays, depth, None if mask is None else mask.numpy())

    maps = []
    for shadow_map in in_order(map_of, views, grid.low.device):
        maps.append(shadow_map)
        on_view(len(maps) / len(views))
    return maps


def unmasked_rays(shadow_map: ShadowMap) -> Rays:
    """The rays of a map that its mask does not ignore, (n,)."""
    flat = shadow_map.rays.each(lambda part: part.flatten(0, 1))
    if shadow_map.mask is None:
        return flat
    rows, columns = (  # of the mask, at the middles of the rays' cells
        (np.arange(cells) * 2 + 1) * pixels // (2 * cells)
        for cells, pixels in zip(shadow_map.depth.shape, shadow_map.mask.shape, strict=True)
    )
    counts = torch.from_numpy(shadow_map.mask[np.ix_(rows, columns)]).flatten().to(flat.near.device)
    return flat.each(lambda part: part[counts])


def sample_rays(maps: list[ShadowMap], count: int) -> Rays:
    """``count`` random rays of the maps, or all where there are fewer. Every k-th instead would come from a single
    column of each photo wherever k is a multiple of the maps' width."""
    rays = join_rays(unmasked_rays(shadow_map) for shadow_map in maps)
    order = torch.randperm(len(rays.near), generator=generator("cpu", 0))
    chosen = order[:count].sort().values.to(rays.near.device)
    return rays.each(lambda part: part[chosen])


def vertex_visibility(
    vertices: np.ndarray, normals: np.ndarray, maps: Sequence[ShadowMap], voxels: np.ndarray
) -> Visibility:
    """The visibility of every vertex in all photos; ``voxels`` (n,): the grid's spacing around each, in scene units."""

    def of_chunk(start: int) -> Visibility:
        some = slice(start, start + CHUNK)
        return _chunk_visibility(vertices[some], normals[some], maps, voxels[some])

    chunks = list(in_order(of_chunk, range(0, len(vertices), CHUNK), torch.device("cpu")))
    return Visibility(*map(np.concatenate, zip(*chunks, strict=True)))


def seen_share(points: np.ndarray, maps: Sequence[ShadowMap]) -> np.ndarray:
    """Of the photos whose frustums hold each point (n, 3), the share whose rays reach it; 0 where there are none."""
    in_frustum, seen = np.zeros(len(points)), np.zeros(len(points))
    for inside, sight in in_order(lambda shadow_map: _sight(points, shadow_map), maps, torch.device("cpu")):
        in_frustum[inside] += 1
        seen[inside] += sight.distance <= sight.depth
    return seen / np.maximum(in_frustum, 1)


def _chunk_visibility(
    vertices: np.ndarray, normals: np.ndarray, maps: Sequence[ShadowMap], voxels: np.ndarray
) -> Visibility:
    in_frustum = np.zeros(len(vertices), np.int32)
    visible = np.zeros(len(vertices), np.int32)
    total = np.zeros_like(vertices)
    for shadow_map in maps:
        inside, (direction, distance, depth) = _sight(vertices, shadow_map)
        in_frustum[inside] += 1
        cosine = -(direction * normals[inside]).sum(axis=1)
        sees = (cosine > MIN_COSINE) & (distance <= depth + DEPTH_BIAS_VOXELS * voxels[inside])
        visible[inside[sees]] += 1
        total[inside[sees]] += direction[sees] * cosine[sees, None]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    direction = np.where(length > 0, total / np.where(length > 0, length, 1), -normals)
    return Visibility(in_frustum, visible, direction)


class _Sight(NamedTuple):
    """Of the points in a photo's frustum: unit vectors from its camera to them (n, 3), how far they are (n,), and at
    which distance the rays there lose half of their transmittance (n,)."""

    direction: np.ndarray
    distance: np.ndarray
    depth: np.ndarray


def _sight(points: np.ndarray, shadow_map: ShadowMap) -> tuple[np.ndarray, _Sight]:
    """Which points lie in the frustum, as indices, and what is known of them."""
    offset = points - shadow_map.view.scene_from_camera[:, 3]
    distance = np.linalg.norm(offset, axis=1)
    cell = _cells(offset, shadow_map)
    inside = np.flatnonzero((cell >= 0) & (distance >= shadow_map.view.near) & (distance <= shadow_map.view.far))
    distance = distance[inside]
    return inside, _Sight(offset[inside] / distance[:, None], distance, shadow_map.depth.reshape(-1)[cell[inside]])


def _cells(offset: np.ndarray, shadow_map: ShadowMap) -> np.ndarray:
    """The flat index of each point's cell in the shadow map, -1 outside the image and where its mask ignores it."""
    height, width = shadow_map.depth.shape
    camera = shadow_map.camera
    points = offset @ shadow_map.view.scene_from_camera[:, :3]
    cell = np.full(len(points), -1)
    position = project(camera, points) / [camera.width, camera.height]  # [0, 1) in the image
    inside = np.flatnonzero(((position >= 0) & (position < 1)).all(axis=1))
    if shadow_map.mask is not None:
        column, row = (position[inside] * shadow_map.mask.shape[::-1]).astype(np.int64).T
        inside = inside[shadow_map.mask[row, column]]
    column, row = (position[inside] * [width, height]).astype(np.int64).T
    cell[inside] = row * width + column
    return cell
