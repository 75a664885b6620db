"""Keeps the density cache of a grid field up to date: a slow memory of how much light a step in each cell stops.

A cell holds the largest optical thickness of one lattice step seen lately: it is measured again now and then, what it
held fading meanwhile, and raised at once where training finds more.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.contraction import uncontract
from nerf.grid_field import GridField
from nerf.kernels import CONTRACTED_BOX
from nerf.parallel import in_order

YOUNG_STEPS = 256  # a young field changes everywhere: all blocks of 2³ cells are measured, at one point each
YOUNG_EVERY, YOUNG_FADE = 16, 0.8
EVERY, FADE, MEASURED_CELLS = 64, 0.9, 26_000  # afterwards: so many cells, drawn at random
THIN = 0.01  # a cell as thin as this, or as the mean cell, counts as empty
CHUNK = 1 << 14  # points measured at once


class DensityCache:
    """The thickness of every cell, in the order of the field's ``bits``, which follow from it."""

    def __init__(self, field: GridField) -> None:
        self.field = field
        self.thickness = torch.zeros(field.settings.cache_cells**3, device=field.table.device)

    def raise_to(self, unit: Float[Tensor, "points 3"], thickness: Float[Tensor, "points"]) -> None:
        """Take note of what training has found at some points, in unit coordinates."""
        self._update(unit, thickness, 1.0)

    def refresh(self, step: int, random: torch.Generator) -> None:
        """Measure what is due at the end of step number ``step``; if something is, set the field's bits anew."""
        young = step < YOUNG_STEPS
        if (step + 1) % (YOUNG_EVERY if young else EVERY):
            return
        if young:
            self._measure_blocks(random)
        else:
            self._measure_some(random)
        self.field.bits.copy_(self.field.backend.occupied_bits(self.thickness, min(THIN, self._mean())))

    def _mean(self) -> float:
        """Summed in rows, so that the result does not depend on how many threads share the work."""
        rows = self.thickness.view(-1, self.field.settings.cache_cells)
        return float(rows.sum(-1).double().sum()) / len(self.thickness)

    def _measure_blocks(self, random: torch.Generator) -> None:
        cells, device = self.field.settings.cache_cells, self.thickness.device
        # A cell's number ends in the binary digits x₁x₀y₁y₀z₁z₀, so a block of 2³ cells is all values of x₀, y₀, z₀.
        blocks = (-1, 2, 2, 2, 2, 2, 2)
        first = torch.arange(cells**3, device=device).view(blocks)[:, :, 0, :, 0, :, 0].flatten()
        measured = self._measure(self._points_in(first, 2, random)).view(-1, 2, 1, 2, 1, 2, 1)
        thickness = self.thickness.view(blocks)
        torch.maximum(thickness.mul_(YOUNG_FADE), measured, out=thickness)

    def _measure_some(self, random: torch.Generator) -> None:
        count, device = len(self.thickness), self.thickness.device
        chosen = torch.randint(count, (MEASURED_CELLS,), generator=random, device=device)
        unit = self._points_in(chosen, 1, random)
        self._update(unit, self._measure(unit), FADE)

    def _points_in(self, cell: Tensor, side: int, random: torch.Generator) -> Float[Tensor, "points 3"]:
        """A random point in each cube of ``side`` cells that begins at a cell."""
        cells = self.field.settings.cache_cells
        corners = self.field.backend.cell_corners(cells, cell)
        return corners + side / cells * torch.rand(corners.shape, generator=random, device=corners.device)

    def _measure(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        sigma = torch.cat(list(in_order(self.field.unit_density, unit.split(CHUNK), unit.device)))
        return sigma * self._step_length(unit)

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

    def _update(self, unit: Float[Tensor, "points 3"], values: Float[Tensor, "points"], decay: float) -> None:
        self.field.backend.update_cache(self.field.lattice.cells, self.thickness, unit, values, decay)
