"""Keeps the density cache of a grid field up to date: a slow memory of how much light a step in each cell stops.

A cell holds the largest optical thickness of one lattice step seen lately: it is measured again now and then, what it
held fading meanwhile, and raised at once where training finds more.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.fields.hash_grid import HashGridField
from nerf.geometry.contraction import uncontract
from nerf.kernels import CONTRACTED_BOX
from nerf.kernels.torch.occupancy import BRICK_CELLS
from nerf.runtime.parallel import in_order

EVERY, FADE = 16, 0.7  # steps between two measurements, and what of a cell's thickness outlives its own
YOUNG_STEPS = 256  # a young field changes everywhere: all cells are measured each time,
PARTS = 4  # later a part of them in turn
THIN = 0.01  # a cell as thin as this, or as the mean cell, counts as empty
CHUNK = 1 << 14  # points measured at once
BLOCK_SIDE, BRICK_BLOCKS = 2, 8  # cells are measured in blocks of 2³: 8 of them in a brick


class OccupancyGrid:
    """The thickness of every cell, in the order of the field's ``bits``, which follow from it. Cells that are not
    ``usable`` stay empty; None: all are."""

    def __init__(self, field: HashGridField, usable: Bool[Tensor, "cache"] | None = None) -> None:
        self.field, self.unusable = field, None if usable is None else ~usable
        self.thickness = torch.zeros(field.settings.occupancy_resolution**3, device=field.table.device)
        self.corners, self.block_of_cell = _blocks(field)
        self.usable_count = len(self.thickness) if usable is None else max(1, int(usable.sum()))
        if usable is not None:
            field.occupy(field.backend.occupancy_bits(usable.float(), 0.5))

    def raise_to(self, unit: Float[Tensor, "points 3"], thickness: Float[Tensor, "points"]) -> None:
        """Take note of what training has found at some points, in unit coordinates."""
        self.field.backend.scatter_max(self.field.lattice.cells, self.thickness, unit, thickness)

    def refresh(self, step: int, random: torch.Generator) -> None:
        """Measure what is due at the end of step number ``step``; if something is, set the field's bits anew."""
        turn, early = divmod(step + 1, EVERY)
        if early:
            return
        parts = 1 if step < YOUNG_STEPS else PARTS
        self._measure_part(turn % parts, parts, random)
        if self.unusable is not None:
            self.thickness.masked_fill_(self.unusable, 0)
        self.field.occupy(self.field.backend.occupancy_bits(self.thickness, min(THIN, self._mean())))

    def _mean(self) -> float:
        """Of the usable cells; summed in rows, so that no result depends on how many threads share the work."""
        rows = self.thickness.view(-1, self.field.settings.occupancy_resolution)
        return float(rows.sum(-1).double().sum()) / self.usable_count

    def _measure_part(self, part: int, parts: int, random: torch.Generator) -> None:
        """Measure every ``parts``-th brick, beginning with number ``part``: each block at a random point of it."""
        corners = self.corners[part::parts].flatten(0, 1)
        side = BLOCK_SIDE / self.field.settings.occupancy_resolution
        points = corners + side * torch.rand(corners.shape, generator=random, device=corners.device)
        measured = torch.cat(list(in_order(self._measure, points.split(CHUNK), points.device)))
        of_cells = measured.view(-1, BRICK_BLOCKS).index_select(1, self.block_of_cell)
        thickness = self.thickness.view(-1, BRICK_CELLS)[part::parts]
        torch.maximum(thickness.mul_(FADE), of_cells, out=thickness)

    def _measure(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        return self.field.unit_density(unit) * self._step_length(unit)

    def _step_length(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"] | float:
        """The lattice's step at points, as seen from a camera near the origin.

        The outermost cells reach to infinity; their points count as half a cell within.
        """
        lattice = self.field.lattice
        if not lattice.cone:
            return lattice.step
        margin = 0.5 / lattice.cells
        within = 2 * CONTRACTED_BOX * (unit.clamp(margin, 1 - margin) - 0.5)
        return (lattice.cone * uncontract(within).norm(dim=-1)).clamp(min=lattice.step)


def _blocks(field: HashGridField) -> tuple[Float[Tensor, "bricks blocks 3"], Int[Tensor, "cells"]]:
    """The nearest corner of each brick's blocks, in unit coordinates, and the block that each cell of a brick is in."""
    # A cell's number ends in the binary digits x₁x₀y₁y₀z₁z₀: a block is all values of x₀, y₀, z₀.
    first = torch.arange(BRICK_CELLS).view(2, 2, 2, 2, 2, 2)[:, 0, :, 0, :, 0].flatten()
    block = torch.arange(BRICK_BLOCKS).view(2, 1, 2, 1, 2, 1).expand(2, 2, 2, 2, 2, 2).flatten()
    device, cells = field.table.device, field.settings.occupancy_resolution
    bricks = torch.arange(0, cells**3, BRICK_CELLS)[:, None]
    corners = field.backend.cell_corners(cells, (bricks + first).flatten().to(device))
    return corners.view(-1, BRICK_BLOCKS, 3), block.to(device)
