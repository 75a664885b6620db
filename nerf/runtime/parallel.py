"""One chunk of work per core, results in the order of the chunks.

On a CPU, one Python thread per core with torch's own threads off beats torch's threads inside every operation: no
barrier after each of them, and no collapse when other programs want the cores too (docs/experiments/step_time.md).
Chunks are cut by the caller, never by the number of cores, so results do not depend on it.
"""

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from nerf.runtime.profiler import OTHER, span

Item = TypeVar("Item")
Result = TypeVar("Result")


_taken: int | None = None


def take_over_cores() -> None:
    """From now on all cores belong to :func:`in_order`, as many as torch has threads now: torch's own are off.

    They would spin for a while after each of their operations, on the very cores that the chunks need.
    """
    global _taken
    if _taken is None:
        _taken = torch.get_num_threads()
        torch.set_num_threads(1)


def workers() -> int:
    """How many chunks :func:`in_order` computes at once on the CPU."""
    return _taken or torch.get_num_threads()


def in_order(function: Callable[[Item], Result], items: Iterable[Item], device: torch.device) -> Iterator[Result]:
    """``function(item)`` for every item, in order, on all cores where ``device`` is the CPU.

    Only a few chunks are under way at a time: memory stays bounded and an interruption is heard soon.
    """
    count = workers()
    if device.type != "cpu" or count == 1:
        yield from map(function, items)
        return
    pool, under_way = _pool(count), deque[Future[Result]]()
    try:
        for item in items:
            under_way.append(pool.submit(_profiled, function, item))
            if len(under_way) > 2 * count:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()
    finally:
        for future in under_way:
            future.cancel()


def _profiled(function: Callable[[Item], Result], item: Item) -> Result:
    with span(OTHER):
        return function(item)


@functools.cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "chunk", initializer=_without_torchs_threads)


def _without_torchs_threads() -> None:
    torch.set_num_threads(1)
    torch.get_num_threads()  # a thread takes over the number set last in any thread when it first asks: ask now
