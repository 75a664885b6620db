import torch

from nerf.kernels.cache import cell_numbers
from nerf.kernels.reference import cell_corners, occupied_bits, raise_cache


def test_every_cell_has_one_number_and_bricks_are_words() -> None:
    numbers = torch.arange(12**3)
    corners = cell_corners(12, numbers)
    assert torch.equal(cell_numbers(12, corners + 0.5 / 12).long(), numbers)
    assert len(corners.unique(dim=0)) == 12**3
    bricks = (corners * 3).floor().view(-1, 64, 3)
    assert torch.equal(bricks, bricks[:, :1].expand_as(bricks))
    assert corners[1].tolist() == torch.tensor([0, 0, 1 / 12]).tolist()


def test_points_outside_belong_to_the_nearest_cell() -> None:
    outside = torch.tensor([[-0.1, 0.5, 1.0], [2.0, 0.5, -3.0]])
    assert torch.equal(cell_numbers(8, outside), cell_numbers(8, outside.clamp(0, 0.999)))


def test_cells_rise_to_the_largest_value() -> None:
    thickness = torch.full((64,), 1.0)
    points = torch.tensor([[0.1, 0.1, 0.1], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    raise_cache(4, thickness, points, torch.tensor([0.1, 2.0, 0.3, 0.2]))
    assert thickness[0] == 2
    assert (thickness[1:] == 1).all()


def test_bits_say_which_cells_exceed_the_threshold() -> None:
    thickness = torch.rand(512, generator=torch.Generator().manual_seed(1))
    bits = occupied_bits(thickness, 0.4)
    assert bits.shape == (8,) and bits.dtype == torch.int64
    unpacked = [(word >> bit) & 1 == 1 for word in bits.tolist() for bit in range(64)]
    assert unpacked == (thickness > 0.4).tolist()
    assert occupied_bits(torch.full((64,), 2.0), 1.0).tolist() == [-1]
    assert occupied_bits(torch.full((64,), 1.0), 1.0).tolist() == [0]
