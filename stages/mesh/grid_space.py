"""Where the points of the density grid are evenly spaced: in the scene, or in normalised device coordinates (NDC) where
cameras face one way.

There photos show the same number of pixels for a cell near by as for one far away. In the scene, cells would be too
large for what is near, and a wall far away, whose density is spread over more length, would stay below the iso-level
(docs/experiments/mesh.md). Surfaces and photos are in the scene; only grid, iso-level and rays that look for it are in
the grid's space.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf.fields.interface import RadianceModel
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.ndc import Ndc
from stages.contract import StageError
from stages.mesh.surface import Surface, keep_faces

GridSpace = Box | Ndc
# Of the cube: on its faces rounding says whether a field is asked or what lies beyond it.
INSIDE = 1 - 1e-5


class DensityIn(NamedTuple):
    """A field's density in the space of a grid."""

    space: GridSpace
    model: RadianceModel

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """At points of that space, per unit length along the line of sight from the space's apex."""
        if isinstance(self.space, Box):
            return self.model.density(points)
        return self.model.density(self.space.inverse(points)) * self.space.scene_length(points)


class VoxelLengths(NamedTuple):
    """Of the voxels around points (n,), in scene units: along the line of sight, and across it."""

    along: np.ndarray
    across: np.ndarray


class VoxelSize(NamedTuple):
    """How large the voxels of a grid are in the scene: where its space is not the scene, the farther away the larger.
    ``spacing`` (3,) is in units of the space."""

    space: GridSpace
    spacing: np.ndarray

    def at(self, vertices: np.ndarray) -> VoxelLengths:
        """Around scene points (n, 3)."""
        if isinstance(self.space, Box):
            return VoxelLengths(*2 * [np.full(len(vertices), float(self.spacing.max()))])
        mapped = self.space.forward(torch.from_numpy(vertices))
        depth = 2 * self.space.near / (1 - mapped[:, 2].numpy() / self.space.half)
        across = float((self.spacing[:2] * self.space.slopes).max()) / self.space.half * depth
        return VoxelLengths(float(self.spacing[2]) * self.space.scene_length(mapped).numpy(), across)


def grid_space(space: SpaceMap) -> GridSpace:
    """That of a field's grid; space beyond the region of interest, which the contraction holds, is not meshed."""
    return space if isinstance(space, Ndc) else Box()


def box_in(space: GridSpace, region: np.ndarray) -> np.ndarray:
    """The box (2, 3) of the grid's space around what it shows of a ``region`` (2, 3) of the scene. Raises StageError
    where it shows nothing of it."""
    if isinstance(space, Box):
        return region
    corners = np.stack(np.meshgrid(*region.T, indexing="ij"), axis=-1).reshape(-1, 3)
    mapped, half = space.forward(torch.from_numpy(corners)).numpy(), INSIDE * space.half
    box = np.clip([mapped.min(axis=0), mapped.max(axis=0)], -half, half)
    if not (box[1] > box[0]).all():
        raise StageError(
            "mesh.region-not-seen",
            "the photos show nothing of the region of interest",
            "it lies beside what they show, or before the near plane of all",
            "Give another --normalise.roi, or leave it out.",
        )
    return box


def points_of_grid(space: GridSpace, box: np.ndarray, resolution: int, points: np.ndarray) -> tuple[int, int, int]:
    """Grid points along each edge of a box of the space, together about ``resolution``³. Voxels are as long in the
    scene as wide: all of them, or in normalised device coordinates those at the median depth of the sparse ``points``
    (n, 3) before the cameras."""
    sides = box[1] - box[0]
    if isinstance(space, Ndc):
        depth = (points - np.array(space.apex)) @ np.array(space.axes[2])
        before = depth[depth > space.near]
        depth_of_all = float(np.median(before)) if len(before) else 2 * space.near
        sides = sides * [*space.slopes, depth_of_all / (2 * space.near)]
    counts = (resolution - 1) * sides / np.prod(sides) ** (1 / 3) + 1
    x, y, z = (max(2, round(float(count))) for count in counts)
    return x, y, z


def to_scene(points: np.ndarray, space: GridSpace) -> np.ndarray:
    """Points (n, 3) of the grid's space in the scene."""
    return points if isinstance(space, Box) else space.inverse(torch.from_numpy(points)).numpy()


def in_scene(surface: Surface, space: GridSpace, region: np.ndarray) -> Surface:
    """A surface of the grid's space with its vertices in the scene, as far as it lies in the ``region`` (2, 3). Raises
    StageError where nothing does."""
    if isinstance(space, Box):
        return surface
    vertices = to_scene(surface.vertices, space)
    inside = ((vertices >= region[0]) & (vertices <= region[1])).all(axis=1)[surface.faces].all(axis=1)
    if not inside.any():
        why = "all of it is nearer, farther or more to the side"
        hint = "Give a larger --normalise.roi, or another --mesh.iso-level."
        raise StageError("mesh.nothing-in-region", "no surface lies in the region of interest", why, hint)
    return keep_faces(Surface(vertices, surface.faces), inside)[0]
