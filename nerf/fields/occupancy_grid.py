"""The occupancy grid of a hash-grid field (Müller et al. 2022, section 5.2): which cells may hold something.

A cell holds an exponential moving maximum of the optical thickness that one step of a ray has in it: measured again at
regular intervals, decaying meanwhile, and raised at once where a training sample finds more.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.fields.hash_grid import HashGridField
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels.torch.occupancy import BRICK_CELLS
from nerf.runtime.parallel import in_order

UPDATE_INTERVAL = 16  # steps between two updates
EMA_DECAY = 0.7  # of a cell's optical thickness, at each measurement
WARMUP_STEPS = 256  # an untrained field changes everywhere: all cells are measured at each update,
UPDATE_FRACTIONS = 4  # later a quarter of them in turn
OCCUPANCY_THRESHOLD = 0.01  # a cell of no more optical thickness than this, or than the mean cell, counts as empty
CHUNK_POINTS = 1 << 14  # measured at once
BLOCK_SIDE, BRICK_BLOCKS = 2, 8  # cells are measured in blocks of 2³: 8 of them in a brick


class OccupancyGrid:
    """The optical thickness of every cell, in the order of the field's ``occupancy_bits``, which follow from it. Cells
    outside ``mask`` stay empty; None: there are none."""

    def __init__(self, field: HashGridField, mask: Bool[Tensor, "cells"] | None = None) -> None:
        self.field, self.masked_out = field, None if mask is None else ~mask
        self.optical_thickness = torch.zeros(field.settings.occupancy_resolution**3, device=field.table.device)
        self.corners, self.block_of_cell = _blocks(field)
        self.cell_count = len(self.optical_thickness) if mask is None else max(1, int(mask.sum()))
        if mask is not None:
            field.set_occupancy(field.backend.occupancy_bits(mask.float(), 0.5))

    def raise_to(self, unit: Float[Tensor, "points 3"], optical_thickness: Float[Tensor, "points"]) -> None:
        """Raise the cells of training samples, given in unit coordinates, to their optical thickness."""
        self.field.backend.scatter_max(
            self.field.stepping.occupancy_resolution, self.optical_thickness, unit, optical_thickness
        )

    def update(self, step: int, random: torch.Generator) -> None:
        """Measure what is due at the end of step number ``step``; if something is, set the field's bits anew."""
        turn, early = divmod(step + 1, UPDATE_INTERVAL)
        if early:
            return
        parts = 1 if step < WARMUP_STEPS else UPDATE_FRACTIONS
        self._measure_part(turn % parts, parts, random)
        if self.masked_out is not None:
            self.optical_thickness.masked_fill_(self.masked_out, 0)
        self.field.set_occupancy(
            self.field.backend.occupancy_bits(self.optical_thickness, min(OCCUPANCY_THRESHOLD, self._mean()))
        )

    def _mean(self) -> float:
        """Of the cells in the mask; summed in rows, so that no result depends on how many threads share the work."""
        rows = self.optical_thickness.view(-1, self.field.settings.occupancy_resolution)
        return float(rows.sum(-1).double().sum()) / self.cell_count

    def _measure_part(self, part: int, parts: int, random: torch.Generator) -> None:
        """Measure every ``parts``-th brick, beginning with number ``part``: each block at a random point of it."""
        corners = self.corners[part::parts].flatten(0, 1)
        side = BLOCK_SIDE / self.field.settings.occupancy_resolution
        points = corners + side * torch.rand(corners.shape, generator=random, device=corners.device)
        measured = torch.cat(list(in_order(self._measure, points.split(CHUNK_POINTS), points.device)))
        of_cells = measured.view(-1, BRICK_BLOCKS).index_select(1, self.block_of_cell)
        optical_thickness = self.optical_thickness.view(-1, BRICK_CELLS)[part::parts]
        torch.maximum(optical_thickness.mul_(EMA_DECAY), of_cells, out=optical_thickness)

    def _measure(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        return self.field.unit_density(unit) * self._step_length(unit)

    def _step_length(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"] | float:
        """The step size at points in scene units, as seen from a camera near the origin, or near the apex of normalised
        device coordinates.

        The outermost cells reach to infinity; their points count as half a cell within.
        """
        stepping, space = self.field.stepping, self.field.space
        if not space.unbounded:
            return stepping.step_size
        margin = 0.5 / stepping.occupancy_resolution
        within = 2 * space.half * (unit.clamp(margin, 1 - margin) - 0.5)
        if isinstance(space, Ndc):
            return stepping.step_size * space.scene_length(within)
        return (stepping.cone_angle * space.inverse(within).norm(dim=-1)).clamp(min=stepping.step_size)


def _blocks(field: HashGridField) -> tuple[Float[Tensor, "bricks blocks 3"], Int[Tensor, "cells"]]:
    """The nearest corner of each brick's blocks, in unit coordinates, and the block that each cell of a brick is in."""
    # A cell's number ends in the binary digits x₁x₀y₁y₀z₁z₀: a block is all values of x₀, y₀, z₀.
    first = torch.arange(BRICK_CELLS).view(2, 2, 2, 2, 2, 2)[:, 0, :, 0, :, 0].flatten()
    block = torch.arange(BRICK_BLOCKS).view(2, 1, 2, 1, 2, 1).expand(2, 2, 2, 2, 2, 2).flatten()
    device, cells = field.table.device, field.settings.occupancy_resolution
    bricks = torch.arange(0, cells**3, BRICK_CELLS)[:, None]
    corners = field.backend.cell_corners(cells, (bricks + first).flatten().to(device))
    return corners.view(-1, BRICK_BLOCKS, 3), block.to(device)
