"""Which parts of a test photo are scored where there is no time for all of it.

Tiles cover the photo. A dither mask over them by the R2 sequence (Roberts 2018) takes as many as wanted: evenly spread,
and from photo to photo others, so that no part of the pictures counts more than another.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# Pixels along an edge. Errors of neighbours are alike, so many small tiles tell more than a few large ones, of SSIM,
# too, although a window takes 11 of them (docs/experiments/score_tiles.md).
TILE_SIZE = 16
MIN_TILES = 16  # of a photo: PSNR of fewer is no measure of it
PREVIEW_SHARE = 0.25  # of the pixels that are scored of a photo in tiles, for a small image of the whole
R2_STEPS = (0.7548776662466927, 0.5698402909980532)
GOLDEN_RATIO = 0.618033988749895  # its multiples modulo 1 fill [0, 1) evenly, however many there are


class Tiles(NamedTuple):
    """Some tiles of a picture of (height, width): (n, 2) upper left ``corners`` as row and column, and their ``size``,
    rows and columns."""

    corners: np.ndarray
    size: tuple[int, int]

    def cut(self, picture: Tensor) -> Tensor:
        """The tiles (n, rows, columns, …) of a picture (height, width, …)."""
        row, column = (torch.from_numpy(start)[:, None, None] for start in self.corners.T)
        rows, columns = (torch.arange(length) for length in self.size)
        return picture[row + rows[:, None], column + columns]

    def mask(self, height: int, width: int) -> Tensor:
        """Which pixels are in a tile, (height, width) bool."""
        inside = torch.zeros(height, width, dtype=torch.bool)
        for row, column in self.corners.tolist():
            inside[row : row + self.size[0], column : column + self.size[1]] = True
        return inside


def tiles_of(height: int, width: int, fraction: float, number: int, used: Tensor | None = None) -> Tiles:
    """The tiles that stand for a ``fraction`` of the ``number``-th photo, MIN_TILES at least where it has as many.

    ``used``, (height, width) bool, says which pixels count: tiles without any are not taken.
    """
    size = min(TILE_SIZE, height), min(TILE_SIZE, width)
    starts = [
        np.rint(np.linspace(0, length - side, -(-length // side))).astype(int)
        for length, side in zip((height, width), size, strict=True)
    ]
    index = np.stack(np.meshgrid(*map(np.arange, map(len, starts)), indexing="ij"), axis=-1).reshape(-1, 2)
    tiles = Tiles(np.stack([start[i] for start, i in zip(starts, index.T, strict=True)], axis=1), size)
    rank = (number * GOLDEN_RATIO + index @ np.array(R2_STEPS)) % 1
    if used is not None:
        some = tiles.cut(used).flatten(1).any(1).numpy()
        tiles, rank = Tiles(tiles.corners[some], size), rank[some]
    count = max(round(fraction * len(rank)), MIN_TILES)
    return Tiles(tiles.corners[np.sort(np.argsort(rank, kind="stable")[:count])], size)
