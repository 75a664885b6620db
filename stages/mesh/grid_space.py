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
from stages.mesh.surface import Surface

GridSpace = Box | Ndc


class DensityIn(NamedTuple):
    """A field's density in the space of a grid."""

    space: GridSpace
    model: RadianceModel

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """At points of that space, per unit length along the line of sight from the space's apex."""
        if isinstance(self.space, Box):
            return self.model.density(points)
        return self.model.density(self.space.inverse(points)) * self.space.scene_length(points)


class VoxelSize(NamedTuple):
    """How large the voxels of a grid are in the scene: where its space is not the scene, the farther away the larger.
    ``spacing`` is in units of the space."""

    space: GridSpace
    spacing: float

    def at(self, vertices: np.ndarray) -> np.ndarray:
        """Length in scene units, along the line of sight, of the voxels around scene points (n, 3); (n,) float64."""
        if isinstance(self.space, Box):
            return np.full(len(vertices), self.spacing)
        mapped = self.space.forward(torch.from_numpy(vertices))
        return self.spacing * self.space.scene_length(mapped).numpy()


def grid_space(space: SpaceMap) -> GridSpace:
    """That of a field's grid; space beyond the region of interest, which the contraction holds, is not meshed."""
    return space if isinstance(space, Ndc) else Box()


def box_in(space: GridSpace, box: np.ndarray) -> np.ndarray:
    """The box (2, 3) of the grid's space around what it shows of a box (2, 3) in the scene."""
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    mapped = space.forward(torch.from_numpy(corners)).numpy()
    return np.clip([mapped.min(axis=0), mapped.max(axis=0)], -space.half, space.half)


def in_scene(surface: Surface, space: GridSpace) -> Surface:
    """A surface of the grid's space, with its vertices in the scene."""
    return surface._replace(vertices=space.inverse(torch.from_numpy(surface.vertices)).numpy())
