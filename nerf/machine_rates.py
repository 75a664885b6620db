"""What this machine can do at most: matrix products, random reads of a table, streaming through memory.

Measured in the way a training step uses it: one piece of work on each core at the same time (nerf/parallel.py), since
cores share caches and memory. The fastest of many runs counts, in seconds that the core computed.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from nerf.parallel import in_order, workers
from nerf.stopwatch import Stopwatch, Work

PRODUCT_ROWS = 1 << 13  # points that one product has, as in a chunk of a step
GATHERED = 1 << 17  # rows read at once, of 4 float32, as a grid's table has them
STREAMED = 1 << 22  # numbers copied at once: 32 MB read and written, more than caches hold
FEWEST_RUNS = 3


class Rates(NamedTuple):
    """Per core and second, all cores being busy: multiplications and additions of float32 matrix products, rows read
    at random places, bytes copied (read and written ones both count)."""

    products: float
    rows: float
    bytes: float

    def seconds(self, work: Work) -> float:
        """Of a core, for so much work at these rates."""
        return sum(amount / rate for amount, rate in zip(work, self, strict=True))


def measure_rates(device: torch.device, width: int, rows: int, seconds: float) -> Rates:
    """The rates of products (n, width) x (width, width) and of reading from a table of ``rows``, in about ``seconds``.
    Changes no random state."""
    return Rates(
        measure_products(device, width, seconds / 3),
        measure_gather(device, rows, seconds / 3),
        measure_copy(device, seconds / 3),
    )


def measure_products(device: torch.device, width: int, seconds: float) -> float:
    """Multiplications and additions a core does in a second, in float32 products (n, width) x (width, width)."""

    def make() -> Callable[[], object]:
        a, b = torch.ones(PRODUCT_ROWS, width, device=device), torch.ones(width, width, device=device)
        out = torch.empty_like(a)
        return lambda: torch.mm(a, b, out=out)

    return 2 * PRODUCT_ROWS * width * width / _best_on_every_core(make, device, seconds)


def measure_gather(device: torch.device, rows: int, seconds: float) -> float:
    """Rows of 16 bytes that a core reads in a second at random places of a table that all cores share."""
    # Each row as one number: torch copies rows of several numbers one by one, eight times slower.
    table = torch.ones(rows, dtype=torch.complex128, device=device)

    def make() -> Callable[[], object]:
        random = torch.Generator().manual_seed(0)
        index = torch.randint(rows, (GATHERED,), generator=random).to(device)
        found = torch.empty(GATHERED, dtype=torch.complex128, device=device)
        return lambda: torch.index_select(table, 0, index, out=found)

    return GATHERED / _best_on_every_core(make, device, seconds)


def measure_copy(device: torch.device, seconds: float) -> float:
    """Bytes that a core reads and writes in a second, copying."""

    def make() -> Callable[[], object]:
        much = torch.ones(STREAMED, device=device)
        there = torch.empty_like(much)
        return lambda: there.copy_(much)

    return 2 * 4 * STREAMED / _best_on_every_core(make, device, seconds)


def _best_on_every_core(make: Callable[[], Callable[[], object]], device: torch.device, seconds: float) -> float:
    """Seconds of the fastest run, averaged over the cores, each repeating work of its own at the same time."""
    clock = Stopwatch(device)

    def best(_: int) -> float:
        work, until, found = make(), time.perf_counter() + seconds, list[float]()
        while len(found) < FEWEST_RUNS or time.perf_counter() < until:
            started = clock.now()
            work()
            found.append(clock.now() - started)
        return min(found)

    cores = workers() if device.type == "cpu" else 1
    each = list(in_order(best, range(cores), device))
    return sum(each) / cores
