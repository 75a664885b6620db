"""The occupancy grid measures blocks of 2³ cells, in turn, each at a point within."""

import pytest
import torch
from torch import Tensor

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.occupancy_grid import WARMUP_STEPS, OccupancyGrid
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import BRICK_CELLS, cell_corners

CELLS = 16
NUMBERS = torch.arange(CELLS**3)


def cache_of_a_slope(axis: int, monkeypatch: pytest.MonkeyPatch) -> OccupancyGrid:
    """Of a field in which a step is as thick as its point is far along an axis, in cells."""
    model = HashGridField(
        HashGridSettings(num_levels=1, log2_hashmap_size=6, base_res=2, max_res=2, occupancy_resolution=CELLS),
        0,
        reference,
    )

    def slope(unit: Tensor) -> Tensor:
        return CELLS * unit[:, axis] / model.stepping.step_size

    monkeypatch.setattr(model, "unit_density", slope)
    return OccupancyGrid(model)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_young_field_is_measured_in_every_cell(axis: int, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = cache_of_a_slope(axis, monkeypatch)
    cache.update(15, torch.Generator().manual_seed(0))
    block = (CELLS * cell_corners(CELLS, NUMBERS)[:, axis] / 2).floor()
    assert torch.equal((cache.optical_thickness / 2).floor(), block)


def test_an_old_field_is_measured_brick_by_brick_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    cache = cache_of_a_slope(0, monkeypatch)
    cache.update(WARMUP_STEPS + 15, torch.Generator().manual_seed(0))
    turn = (WARMUP_STEPS + 16) // 16 % 4
    due = torch.eq(NUMBERS // BRICK_CELLS % 4, turn)
    assert torch.equal(cache.optical_thickness > 0, due)
