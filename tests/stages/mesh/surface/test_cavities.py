"""Which empty space is filled: what no photo looks into, also where a pit leads there."""

import numpy as np
import pytest

from stages.mesh.surface.cavities import fill_cavities

SIDE = 40
MIDDLE = np.full(3, (SIDE - 1) / 2)


def shell(gap: int = 0) -> np.ndarray:
    """A hollow ball, its wall four points thick, with a square hole so many points wide."""
    index = np.indices((SIDE, SIDE, SIDE)).reshape(3, -1).T - MIDDLE
    radius = np.linalg.norm(index, axis=1)
    solid = (radius < 14) & (radius > 10)
    hole = (np.abs(index[:, :2]) < gap / 2).all(axis=1) & (index[:, 2] > 0)
    return (solid & ~hole).reshape(SIDE, SIDE, SIDE).astype(np.float32)


def nobody(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


@pytest.mark.parametrize("gap", [0, 2, 6])
def test_space_behind_a_narrow_gap_is_filled(gap):
    occupancy = shell(gap)
    assert fill_cavities(occupancy, nobody) > 3000
    index = np.argwhere(occupancy < 0.5) - MIDDLE
    radius = np.linalg.norm(index, axis=1)
    assert radius.min() > 12, "what is left is the end of the gap"
    assert (radius > 14).any()


def test_space_behind_a_wide_gap_stays():
    occupancy = shell(10)
    assert fill_cavities(occupancy, nobody) == 0
    np.testing.assert_array_equal(occupancy, shell(10))


@pytest.mark.parametrize(("share", "filled"), [(0.05, True), (0.5, False)])
def test_a_room_that_photos_see_from_inside_stays(share, filled):
    inside = []

    def seen(points: np.ndarray) -> np.ndarray:
        inside.append(np.linalg.norm(points - MIDDLE, axis=1).max())
        return np.full(len(points), share)

    assert (fill_cavities(shell(), seen) > 0) == filled
    assert inside[0] < 10, "only space that does not reach the border is asked for"


def test_what_is_full_or_empty_or_open_stays():
    for occupancy in (np.zeros((5, 5, 5)), np.ones((5, 5, 5)), np.ones((1, 1, 1)), shell()[:, :, SIDE // 2 :].copy()):
        before = occupancy.copy()
        assert fill_cavities(occupancy, nobody) == 0
        np.testing.assert_array_equal(occupancy, before)
