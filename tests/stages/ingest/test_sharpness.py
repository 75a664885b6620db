"""How sharp a photo is, beside its neighbours."""

import cv2
import numpy as np
import pytest

from stages.ingest.sharpness import BLURRED, WIDTH, relative_sharpness, sharpness
from tests.blots import blots


def test_the_variance_of_the_laplacian_in_closed_form() -> None:
    """A chessboard of single pixels of m ± a has a Laplacian of ±8a, mirrored at the borders."""
    y, x = np.mgrid[:20, :30]
    board = np.where((x + y) % 2, 140, 100).astype(np.uint8)
    assert sharpness(np.dstack([board] * 3)) == pytest.approx((8 * 20 / 120) ** 2, rel=1e-3)
    assert sharpness(board) == sharpness(np.dstack([board] * 3))
    assert sharpness(np.full((20, 30, 3), 77, np.uint8)) == 0


def test_blur_lowers_it_and_transparent_parts_have_none() -> None:
    picture = blots(0)
    blurred = [sharpness(cv2.GaussianBlur(picture, (0, 0), sigma)) for sigma in (1, 2, 4)]
    assert sharpness(picture) > 2 * blurred[0] > 4 * blurred[1] > 8 * blurred[2] > 0
    hidden = np.dstack([picture, np.zeros(picture.shape[:2], np.uint8)])
    assert sharpness(hidden) == 0


@pytest.mark.parametrize("stops", [-1.0, 1.0])
def test_another_exposure_is_as_sharp(stops: float) -> None:
    linear = (blots(0) * 0.5 / 255) ** 2.2
    exposed = [np.rint(255 * (linear * 2**ev) ** (1 / 2.2)).astype(np.uint8) for ev in (0.0, stops)]
    assert sharpness(exposed[1]) == pytest.approx(sharpness(exposed[0]), rel=0.1)


def test_a_black_picture_is_not_sharp() -> None:
    assert sharpness(np.zeros((20, 30, 3), np.uint8)) == 0


def test_large_photos_are_looked_at_small() -> None:
    picture = blots(0, WIDTH, 200)
    doubled = cv2.resize(picture, (2 * WIDTH, 400), interpolation=cv2.INTER_NEAREST)
    assert sharpness(doubled) == pytest.approx(sharpness(picture), rel=0.01)


def test_a_smear_of_four_pixels_counts_as_blurred() -> None:
    picture = blots(2, WIDTH, 600)
    smeared = [sharpness(cv2.blur(picture, (length, 1))) / sharpness(picture) for length in (2, 8)]
    assert smeared[1] < BLURRED < smeared[0]


def test_each_photo_is_compared_with_three_neighbours_a_side() -> None:
    values = [10.0, 20.0, 30.0, 5.0, 40.0, 50.0, 60.0, 1000.0]
    relative = relative_sharpness(values, [0] * 8)
    assert relative[3] == pytest.approx(5 / 35, rel=1e-3)  # of 10 20 30 | 40 50 60
    assert relative[0] == pytest.approx(10 / 20)  # of 20 30 5
    assert relative_sharpness([1.0, 7.0, 2.0, 7.0, 3.0, 7.0, 4.0, 7.0], [0, 1] * 4)[1] == 1


def test_too_few_neighbours_or_blank_ones_say_nothing() -> None:
    assert relative_sharpness([1.0, 2.0, 3.0], [0, 0, 0]) == [None] * 3
    assert relative_sharpness([1.0, 2.0, 3.0, 4.0], [0, 0, 0, 1])[3] is None
    assert relative_sharpness([1.0, 0.0, 0.0, 0.0, 0.0], [0] * 5)[0] is None
    assert relative_sharpness([], []) == []
