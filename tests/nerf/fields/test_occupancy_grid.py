"""The density cache measures blocks of 2³ cells, in turn, each at a point within."""

import pytest
import torch
from torch import Tensor

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.occupancy_grid import YOUNG_STEPS, OccupancyGrid
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import BRICK_CELLS, cell_corners

CELLS = 16
NUMBERS = torch.arange(CELLS**3)


def cache_of_a_slope(axis: int, monkeypatch: pytest.MonkeyPatch) -> OccupancyGrid:
    """Of a field in which a step is as thick as its point is far along an axis, in cells."""
    model = HashGridField(
        HashGridSettings(levels=1, log2_rows=6, coarsest=2, finest=2, occupancy_resolution=CELLS), 0, reference
    )

    def slope(unit: Tensor) -> Tensor:
        return CELLS * unit[:, axis] / model.lattice.step

    monkeypatch.setattr(model, "unit_density", slope)
    return OccupancyGrid(model)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_young_field_is_measured_everywhere_each_cell_in_its_block(
    axis: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = cache_of_a_slope(axis, monkeypatch)
    cache.refresh(15, torch.Generator().manual_seed(0))
    block = (CELLS * cell_corners(CELLS, NUMBERS)[:, axis] / 2).floor()
    assert torch.equal((cache.thickness / 2).floor(), block)


def test_an_old_field_is_measured_brick_by_brick_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    cache = cache_of_a_slope(0, monkeypatch)
    cache.refresh(YOUNG_STEPS + 15, torch.Generator().manual_seed(0))
    turn = (YOUNG_STEPS + 16) // 16 % 4
    due = torch.eq(NUMBERS // BRICK_CELLS % 4, turn)
    assert torch.equal(cache.thickness > 0, due)
