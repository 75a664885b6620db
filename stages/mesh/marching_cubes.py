"""Marching cubes: the surface where a density grid reaches the iso-level."""

from collections.abc import Callable

import numpy as np
from skimage.measure import marching_cubes

from nerf.fields.density_grid import DensityGrid, occupancy, smoothed
from stages.contract import StageError
from stages.mesh.surface import Surface
from stages.mesh.surface.cavities import fill_cavities

# Passes of nerf.fields.density_grid.smoothed: a Gaussian of one grid spacing. The field's finest cells are about as
# small, and what differs between two of them is noise that a grid would pick at random (docs/experiments/mesh.md).
SMOOTHING_PASSES = 2


def smoothed_occupancy(grid: DensityGrid, iso_level: float) -> DensityGrid:
    """The occupancy, 1/2 where the density is ``iso_level``, without what is finer than the grid."""
    return smoothed(occupancy(grid, iso_level), SMOOTHING_PASSES)


def extract_surface(
    grid: DensityGrid, iso_level: float, seen: Callable[[np.ndarray], np.ndarray] | None = None
) -> Surface:
    """The surface at density ``iso_level`` (marching cubes, Lewiner et al. 2003); open where the box cuts it. ``seen``,
    the share of photos that see points of the grid's space (n, 3): no surface of cavities, where these are few.

    Raises StageError where no point is that dense, or all are. Smoothing leaves nothing of sheets one grid point thick
    and of rods two grid points thick.
    """
    values = smoothed_occupancy(grid, iso_level).values.cpu().numpy()
    if not values.min() < 0.5 < values.max():
        raise StageError(
            "mesh.too-thin",
            f"no surface at density {iso_level:.3g}",
            f"the smoothed occupancy runs from {values.min():.0%} to {values.max():.0%} and does not pass 50%: the "
            "scene is too thin for the grid, or fills the box",
            "Give a higher --mesh.resolution or another --mesh.iso-level.",
        )
    low, spacing = grid.low.cpu().double().numpy(), grid.spacing().cpu().double().numpy()
    if seen is not None:
        fill_cavities(values, lambda index: seen(low + index * spacing))
    index, faces, _, _ = marching_cubes(values, 0.5, gradient_direction="ascent")
    return Surface(low + index * spacing, faces.astype(np.int32))
