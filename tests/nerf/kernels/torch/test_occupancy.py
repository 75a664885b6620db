import torch

from nerf.kernels.torch import cell_corners, occupancy_bits, scatter_max
from nerf.kernels.torch.occupancy import MAX_EMPTY_DISTANCE, binary_occupancy, cell_numbers


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
    scatter_max(4, thickness, points, torch.tensor([0.1, 2.0, 0.3, 0.2]))
    assert thickness[0] == 2
    assert (thickness[1:] == 1).all()


def test_bits_say_which_cells_exceed_the_threshold() -> None:
    thickness = torch.rand(512, generator=torch.Generator().manual_seed(1))
    bits = occupancy_bits(thickness, 0.4)
    assert bits.shape == (8,) and bits.dtype == torch.int64
    unpacked = [(word >> bit) & 1 == 1 for word in bits.tolist() for bit in range(64)]
    assert unpacked == (thickness > 0.4).tolist()
    assert occupancy_bits(torch.full((64,), 2.0), 1.0).tolist() == [-1]
    assert occupancy_bits(torch.full((64,), 1.0), 1.0).tolist() == [0]


def test_clearance_is_the_distance_to_the_nearest_occupied_brick() -> None:
    side = 12
    bits = torch.zeros(side**3, dtype=torch.int64)
    filled = torch.tensor([3, 11 * side**2 + 2 * side + 9])
    bits[filled] = torch.tensor([1, -(1 << 63)])
    place = torch.cartesian_prod(*3 * [torch.arange(side)])
    distance = (place[:, None] - place[filled]).abs().amax(-1).amin(-1)
    assert (distance > MAX_EMPTY_DISTANCE).any() and (distance == 0).sum() == 2
    assert torch.equal(binary_occupancy(bits).empty_distance.long(), distance.clamp(max=MAX_EMPTY_DISTANCE))


def test_empty_distance_is_zero_in_full_grids() -> None:
    assert binary_occupancy(torch.full((8,), -1)).empty_distance.tolist() == [0] * 8
    assert binary_occupancy(torch.zeros(8, dtype=torch.int64)).empty_distance.tolist() == [MAX_EMPTY_DISTANCE] * 8
    assert binary_occupancy(torch.zeros(1, dtype=torch.int64)).empty_distance.tolist() == [MAX_EMPTY_DISTANCE]
