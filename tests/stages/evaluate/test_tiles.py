"""Tiles: exact cuts, evenly spread, unbiased over photos, and nested where there are more."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.evaluate.tiles import MIN_TILES, TILE_SIZE, Tiles, tiles_of

SIDES = st.integers(1, 120)
FRACTIONS = st.floats(0.001, 1)


@given(SIDES, SIDES, FRACTIONS, st.integers(0, 500))
@settings(max_examples=60, deadline=None)
def test_as_many_tiles_as_asked_lie_in_the_photo(height: int, width: int, fraction: float, number: int):
    tiles = tiles_of(height, width, fraction, number)
    rows, columns = tiles.size
    assert (tiles.corners >= 0).all() and (tiles.corners + tiles.size <= (height, width)).all()
    assert len({*map(tuple, tiles.corners.tolist())}) == len(tiles.corners)
    possible = -(-height // rows) * -(-width // columns)
    assert len(tiles.corners) == min(possible, max(round(fraction * possible), MIN_TILES))
    picture = torch.arange(height * width).view(height, width)
    cut, mask = tiles.cut(picture), tiles.mask(height, width)
    assert cut.shape == (len(tiles.corners), rows, columns)
    assert sorted(set(cut.flatten().tolist())) == picture[mask].tolist()


@given(SIDES, SIDES, st.integers(0, 500))
@settings(max_examples=30, deadline=None)
def test_all_tiles_are_the_whole_photo(height: int, width: int, number: int):
    assert tiles_of(height, width, 1.0, number).mask(height, width).all()


def test_a_larger_fraction_takes_the_same_tiles_and_more():
    few, many = ({*map(tuple, tiles_of(480, 640, f, 3).corners.tolist())} for f in (0.1, 0.3))
    assert few < many and len(many) == 360


def test_over_many_photos_every_tile_is_taken_as_often():
    counts = torch.zeros(160, 240)
    for number in range(400):
        counts += tiles_of(160, 240, 0.2, number).mask(160, 240)
    assert counts.min() > 0.17 * 400 and counts.max() < 0.23 * 400


@pytest.mark.parametrize("fraction", [0.05, 0.12, 0.3])
def test_tiles_are_spread_evenly(fraction: float):
    counts = []
    for number in range(20):
        mask = tiles_of(640, 960, fraction, number).mask(640, 960).float()
        counts.append(mask.view(4, 160, 6, 160).mean((1, 3)))
    taken = torch.stack(counts)  # of each of 24 regions of 100 tiles
    random = (fraction * (1 - fraction) / 100) ** 0.5
    assert taken.std() < 0.5 * random, "far more even than by chance"
    assert taken.mean() == pytest.approx(fraction, rel=0.02)


def test_tiles_of_nothing_but_ignored_pixels_are_not_taken():
    used = torch.zeros(320, 320, dtype=torch.bool)
    used[:64, :] = True
    tiles = tiles_of(320, 320, 0.5, 0, used)
    assert len(tiles.corners) == 40 and (tiles.corners[:, 0] < 64).all()
    one = torch.zeros(320, 320, dtype=torch.bool)
    one[5, 5] = True
    assert tiles_of(320, 320, 0.01, 7, one).corners.tolist() == [[0, 0]]


def test_the_mean_over_tiles_is_the_photos_within_noise():
    y, x = np.mgrid[:480, :640]
    error = torch.from_numpy((np.sin(x / 90) * np.sin(y / 70)) ** 2 + 0.2 * (x > 500) + 0.1 * (y < 40))
    estimates = [float(error[tiles_of(480, 640, 0.1, number).mask(480, 640)].mean()) for number in range(200)]
    assert np.mean(estimates) == pytest.approx(float(error.mean()), rel=0.01)
    assert np.std(estimates) < 0.05 * float(error.mean())


def test_broken_on_purpose_tiles_of_one_corner_are_off():
    y, x = np.mgrid[:480, :640]
    error = torch.from_numpy((x + y) / 1000.0)
    corner = Tiles(np.array([[r, c] for r in range(0, 96, TILE_SIZE) for c in range(0, 96, TILE_SIZE)]), (16, 16))
    assert float(error[corner.mask(480, 640)].mean()) < 0.5 * float(error.mean())
