"""The order in which training meets the pixels: each once before any comes again, and every batch from all over.

Drawn with replacement, n pixels would after n draws have left out a share of 1/e; and by chance some photos would be
met more often than others for a while.
"""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from nerf.runtime.randomness import generator

BLOCK_SIZE = 256  # neighbours of which a round takes one; a power of two
EPOCHS = 1 << 40  # a counter of random numbers that no step of training has


class _Epoch(NamedTuple):
    """``within``: the permutation p; ``order``: of the blocks; ``offset``: o of each block; ``shift``: of all."""

    number: int
    within: Int[Tensor, "block"]
    order: Int[Tensor, "blocks"]
    offset: Int[Tensor, "blocks"]
    shift: Int[Tensor, "1"]


class PixelSampler:
    """An endless sequence of the numbers below ``count``; which one stands in a place depends on ``seed`` and the kind
    of device alone.

    It runs in *epochs*, and they in *rounds*: a round takes one number of each *block* of s neighbours, the blocks in
    an order of the epoch's. Of its block, round r takes the number p(r) XOR o, with a permutation p of 0 to s - 1 and
    an o for the block: in s rounds each number once. All of that is random, anew for every epoch, and takes a table
    with an entry per block, not per pixel.

    Where ``count`` is no multiple of s, the last block is filled up with numbers of the first, which come once more
    than others in this epoch; where the first begins is random, so that these are others in each.
    """

    def __init__(self, count: int, seed: int, device: torch.device | str) -> None:
        self.count, self.seed, self.device = count, seed, torch.device(device)
        self.blocks = -(-count // BLOCK_SIZE)
        self._last: _Epoch | None = None

    def take(self, first: int, count: int) -> Int[Tensor, "count"]:
        """Those in the places from ``first`` on."""
        period, end = self.blocks * BLOCK_SIZE, first + count
        epochs = range(first // period, max(first, end - 1) // period + 1)
        return torch.cat([self._part(e, max(first - e * period, 0), min(end - e * period, period)) for e in epochs])

    def _part(self, epoch: int, first: int, end: int) -> Int[Tensor, "places"]:
        _, within, order, offset, shift = self._epoch(epoch)
        place = torch.arange(first, end, device=self.device)
        block = order[place % self.blocks]
        return (block * BLOCK_SIZE + (within[place // self.blocks] ^ offset[block]) + shift) % self.count

    def _epoch(self, number: int) -> _Epoch:
        """The last one is kept, as the next batch is most often of the same."""
        epoch = self._last  # read once: another thread may put another in its place
        if epoch is None or epoch.number != number:
            random = generator(self.device, self.seed, EPOCHS, number)
            within = torch.randperm(BLOCK_SIZE, generator=random, device=self.device)
            order = torch.randperm(self.blocks, generator=random, device=self.device)
            offset = torch.randint(BLOCK_SIZE, (self.blocks,), generator=random, device=self.device)
            shift = torch.randint(self.count, (1,), generator=random, device=self.device)
            self._last = epoch = _Epoch(number, within, order, offset, shift)
        return epoch
