"""What this machine can do at most: matrix products, random reads of a table, streaming through memory.

Measured in the way a training step uses it: one piece of work on each core at the same time (nerf/runtime/parallel.py),
since cores share caches and memory. The fastest of many runs counts, in seconds that the core computed.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from nerf.runtime.parallel import in_order, workers
from nerf.runtime.profiler import Profiler, WorkCounts

MATMUL_ROWS = 1 << 13  # points that one product has, as in a chunk of a step
GATHERED_ROWS = 1 << 17  # rows read at once, of 4 float32, as a grid's table has them
# float32 that all cores together copy at once: 128 MB read and as much written, more than their shared cache holds (60
# to 105 MB on servers); each at least MIN_STREAMED_FLOATS, which its own cache does not.
STREAMED_FLOATS, MIN_STREAMED_FLOATS = 1 << 25, 1 << 22
MIN_RUNS = 3


class Rates(NamedTuple):
    """Per core and second, all cores being busy: multiplications and additions of float32 matrix products, rows read
    at random places, bytes copied (read and written ones both count)."""

    matmul_flops: float
    gathered_rows: float
    streamed_bytes: float

    def seconds(self, work: WorkCounts) -> float:
        """Of a core, for so much work at these rates."""
        return sum(amount / rate for amount, rate in zip(work, self, strict=True))


def measure_rates(device: torch.device, width: int, rows: int, seconds: float) -> Rates:
    """The rates of products (n, width) x (width, width) and of reading from a table of ``rows``, in about ``seconds``.
    Changes no random state."""
    return Rates(
        measure_matmul(device, width, seconds / 3),
        measure_gather(device, rows, seconds / 3),
        measure_copy(device, seconds / 3),
    )


def measure_matmul(device: torch.device, width: int, seconds: float) -> float:
    """Multiplications and additions a core does in a second, in float32 products (n, width) x (width, width)."""

    def make() -> Callable[[], object]:
        a, b = torch.ones(MATMUL_ROWS, width, device=device), torch.ones(width, width, device=device)
        out = torch.empty_like(a)
        return lambda: torch.mm(a, b, out=out)

    return 2 * MATMUL_ROWS * width * width / _best_on_every_core(make, device, seconds)


def measure_gather(device: torch.device, rows: int, seconds: float) -> float:
    """Rows of 16 bytes that a core reads in a second at random places of a table that all cores share."""
    # Each row as one number: torch copies rows of several numbers one by one, eight times slower.
    table = torch.ones(rows, dtype=torch.complex128, device=device)

    def make() -> Callable[[], object]:
        random = torch.Generator().manual_seed(0)
        index = torch.randint(rows, (GATHERED_ROWS,), generator=random).to(device)
        found = torch.empty(GATHERED_ROWS, dtype=torch.complex128, device=device)
        return lambda: torch.index_select(table, 0, index, out=found)

    return GATHERED_ROWS / _best_on_every_core(make, device, seconds)


def measure_copy(device: torch.device, seconds: float) -> float:
    """Bytes that a core reads and writes in a second, copying."""
    count = copied_bytes(device) // 4

    def make() -> Callable[[], object]:
        much = torch.ones(count, device=device)
        there = torch.empty_like(much)
        return lambda: there.copy_(much)

    return 2 * 4 * count / _best_on_every_core(make, device, seconds)


def copied_bytes(device: torch.device) -> int:
    """How much each core copies at once in :func:`measure_copy`."""
    return 4 * max(MIN_STREAMED_FLOATS, STREAMED_FLOATS // _cores(device))


def _cores(device: torch.device) -> int:
    return workers() if device.type == "cpu" else 1


def _best_on_every_core(make: Callable[[], Callable[[], object]], device: torch.device, seconds: float) -> float:
    """Seconds of the fastest run, averaged over the cores, each repeating work of its own at the same time."""
    clock = Profiler(device)

    def best(_: int) -> float:
        work, until, found = make(), time.perf_counter() + seconds, list[float]()
        while len(found) < MIN_RUNS or time.perf_counter() < until:
            started, runs, spent = clock.now(), 0, 0.0
            while spent <= 0:  # clocks of a thread's time move in steps that may be longer than a run
                work()
                runs, spent = runs + 1, clock.now() - started
            found.append(spent / runs)
        return min(found)

    each = list(in_order(best, range(_cores(device)), device))
    return sum(each) / len(each)
