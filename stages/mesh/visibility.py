"""What the training photos say about a surface: which vertices they cover, which they see, and from where.

A photo *covers* a vertex that lies inside its image where its mask ignores nothing, between its near and far; it *sees*
the vertex when the vertex faces it and no more than half of the light is lost on the way. Losses are looked up in a
shadow map (Williams 1978): one coarse map per photo of the distance at which its rays lose half of their light.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from nerf.fields.density_grid import DensityGrid
    from nerf.geometry.rays import Rays
    from nerf.geometry.scene import Camera, Scene, View

RAYS = 1 << 17  # over all photos: enough for the level and the maps, seconds on two cores
LONGEST = 96
LONGEST_MASK = 384  # a cell counts as ignored if any pixel in it is, and thin things must not go
SLACK_VOXELS = 3.0  # the surface lies before the median depth, and the map is coarse
EDGE_ON = 0.1  # cosine between viewing ray and normal below which a vertex is not seen but grazed
ANGLE_SLACK = 0.02  # the outermost ray goes through a pixel's centre, the image ends half a cell further
BLOCK = 1 << 15  # vertices at a time: what fits into a processor's cache


class Sight(NamedTuple):
    """Per vertex: how many photos cover it, how many see it, and the mean viewing direction (n, 3).

    The direction is a unit vector from the cameras that see the vertex towards it, each weighted by how squarely
    it looks at the surface; where none does, it is the inward normal.
    """

    covered: np.ndarray
    seen: np.ndarray
    direction: np.ndarray


class ShadowMap(NamedTuple):
    """A photo and the distance at which each of its coarse grid of rays (h, w) loses half of its light."""

    view: "View"
    camera: "Camera"
    rays: "Rays"
    reach: np.ndarray  # the farthest among a cell and its neighbours, so that silhouettes hide nothing behind them
    widest: float  # cosine between the optical axis and the outermost ray
    used: np.ndarray | None  # what the mask leaves of the photo, finer than the rays; None: all


def shadow_maps(
    grid: "DensityGrid", scene: "Scene", ingest: Path, views: Sequence["View"], on_view: Callable[[float], None]
) -> list[ShadowMap]:
    """One map per photo; together about ``RAYS`` rays, each with a sample per voxel of the longest edge. Masks lie in
    the folder of stage ``ingest``."""
    from scipy.ndimage import maximum_filter

    from nerf.fields.density_grid import median_depth
    from stages.train.data import view_mask, view_rays

    maps = []
    for number, view in enumerate(views):
        camera = scene.cameras[view.camera]
        pixels = camera.width * camera.height
        downscale = max((pixels * len(views) / RAYS) ** 0.5, max(camera.width, camera.height) / LONGEST, 1.0)
        rays = view_rays(scene, view, downscale)
        rays = rays.each(lambda part: part.to(grid.low.device))
        stop = median_depth(grid, rays, max(grid.values.shape)).cpu().numpy()
        widest = float((rays.directions.cpu().double().numpy() @ view.scene_from_camera[:, 2]).min())
        mask = view_mask(ingest, scene, view, max(1.0, max(camera.width, camera.height) / LONGEST_MASK))
        used = None if mask is None else mask.numpy()
        maps.append(ShadowMap(view, camera, rays, maximum_filter(stop, size=3, mode="nearest"), widest, used))
        on_view((number + 1) / len(views))
    return maps


def used_rays(shadow: ShadowMap) -> "Rays":
    """The rays of a map that its mask does not ignore, (n,)."""
    import torch

    flat = shadow.rays.each(lambda part: part.flatten(0, 1))
    if shadow.used is None:
        return flat
    rows, columns = (  # of the mask, at the middles of the rays' cells
        (np.arange(cells) * 2 + 1) * pixels // (2 * cells)
        for cells, pixels in zip(shadow.reach.shape, shadow.used.shape, strict=True)
    )
    used = torch.from_numpy(shadow.used[np.ix_(rows, columns)]).flatten().to(flat.near.device)
    return flat.each(lambda part: part[used])


def drawn_rays(maps: list[ShadowMap], most: int) -> "Rays":
    """``most`` of the maps' rays, or all where there are fewer, each as likely as any other: every k-th would be those
    of a single column of each photo wherever k is a multiple of the maps' width."""
    import torch

    from nerf.geometry.rays import join_rays
    from nerf.runtime.randomness import generator

    every = join_rays(used_rays(one) for one in maps)
    order = torch.randperm(len(every.near), generator=generator("cpu", 0))
    chosen = order[:most].sort().values.to(every.near.device)
    return every.each(lambda part: part[chosen])


def look(vertices: np.ndarray, normals: np.ndarray, maps: Sequence[ShadowMap], voxel: float) -> Sight:
    """Look at every vertex from every photo; ``voxel`` is the grid's spacing in scene units."""
    parts = [
        _look(vertices[start : start + BLOCK], normals[start : start + BLOCK], maps, voxel)
        for start in range(0, len(vertices), BLOCK)
    ]
    return Sight(*map(np.concatenate, zip(*parts, strict=True)))


def _look(vertices: np.ndarray, normals: np.ndarray, maps: Sequence[ShadowMap], voxel: float) -> Sight:
    covered = np.zeros(len(vertices), np.int32)
    seen = np.zeros(len(vertices), np.int32)
    towards = np.zeros_like(vertices)
    for shadow in maps:
        offset = vertices - shadow.view.scene_from_camera[:, 3]
        distance = np.linalg.norm(offset, axis=1)
        cell = _cells(offset, distance, shadow)
        inside = np.flatnonzero((cell >= 0) & (distance >= shadow.view.near) & (distance <= shadow.view.far))
        covered[inside] += 1
        direction = offset[inside] / distance[inside, None]
        facing = -(direction * normals[inside]).sum(axis=1)
        reach = shadow.reach.reshape(-1)[cell[inside]] + SLACK_VOXELS * voxel
        sees = (facing > EDGE_ON) & (distance[inside] <= reach)
        seen[inside[sees]] += 1
        towards[inside[sees]] += direction[sees] * facing[sees, None]
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    direction = np.where(length > 0, towards / np.where(length > 0, length, 1), -normals)
    return Sight(covered, seen, direction)


def _cells(offset: np.ndarray, distance: np.ndarray, shadow: ShadowMap) -> np.ndarray:
    """The flat index of each point's cell in the shadow map, -1 outside the image and where its mask ignores it.

    Lens polynomials fold back far outside of the image; points at wider angles than any ray are therefore refused.
    """
    from stages.sfm.colmap.cameras import project

    height, width = shadow.reach.shape
    points = offset @ shadow.view.scene_from_camera[:, :3]
    cell = np.full(len(points), -1)
    ahead = np.flatnonzero(points[:, 2] > max(shadow.widest - ANGLE_SLACK, 1e-6) * distance)
    share = project(shadow.camera, points[ahead]) / [shadow.camera.width, shadow.camera.height]
    shown = np.flatnonzero(((share >= 0) & (share < 1)).all(axis=1))
    if shadow.used is not None:
        column, row = (share[shown] * shadow.used.shape[::-1]).astype(np.int64).T
        shown = shown[shadow.used[row, column]]
    column, row = (share[shown] * [width, height]).astype(np.int64).T
    cell[ahead[shown]] = row * width + column
    return cell
