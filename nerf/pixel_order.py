"""The order in which training meets the pixels: each once before any comes again, and every batch from all over.

Drawn with replacement, n pixels would after n draws have left out a share of 1/e; and by chance some photos would be
met more often than others for a while.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from nerf.randomness import generator

STRATUM = 256  # neighbours of which a round takes one; a power of two
EPOCHS = 1 << 40  # a counter of random numbers that no step of training has


class PixelOrder:
    """An endless sequence of the numbers below ``count``, a function of ``seed`` and the place in it alone.

    It runs in *epochs*, and they in *rounds*: a round takes one number of each *stratum* of neighbours, the strata in
    random order. Within a stratum of s numbers, round r takes the number p(r) XOR o, with a permutation p of 0 to s - 1
    for the epoch and a random o for the stratum: in s rounds each number once. So an epoch takes a table with an entry
    per stratum, not per pixel. Where ``count`` is no multiple of the stratum, numbers from 0 on fill the last one up,
    and come once more than others in an epoch.
    """

    def __init__(self, count: int, seed: int, device: torch.device | str) -> None:
        self.count, self.seed, self.device = count, seed, torch.device(device)
        self.strata = -(-count // STRATUM)
        self._tables: tuple[int, Tensor, Tensor, Tensor] | None = None

    def take(self, first: int, count: int) -> Int[Tensor, "count"]:
        """Those in the places from ``first`` on."""
        period = self.strata * STRATUM
        place = torch.arange(first, first + count, device=self.device)
        epochs = range(first // period, (first + count - 1) // period + 1)
        of_epochs = [self._of_epoch(epoch, place[place // period == epoch] % period) for epoch in epochs]
        return torch.cat(of_epochs) if of_epochs else place

    def _of_epoch(self, epoch: int, place: Int[Tensor, "places"]) -> Int[Tensor, "places"]:
        within, order, offset = self._table(epoch)
        stratum = order[place % self.strata]
        return (stratum * STRATUM + (within[place // self.strata] ^ offset[stratum])) % self.count

    def _table(self, epoch: int) -> tuple[Tensor, Tensor, Tensor]:
        """The epoch's permutation p, its order of the strata, and the strata's offsets o; the last epoch's are kept."""
        kept = self._tables  # read once: another thread may put another epoch's in its place
        if kept is None or kept[0] != epoch:
            random = generator(self.device, self.seed, EPOCHS, epoch)
            within = torch.randperm(STRATUM, generator=random, device=self.device)
            order = torch.randperm(self.strata, generator=random, device=self.device)
            offset = torch.randint(STRATUM, (self.strata,), generator=random, device=self.device)
            self._tables = kept = (epoch, within, order, offset)
        return kept[1:]
