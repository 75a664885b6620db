"""Where the time of a step goes: seconds of the cores by part, beside the work that each part cannot do without.

Code names its parts where it does them, ``with part("gather", Work(rows=...)):``. While no stopwatch runs that costs
less than a microsecond, and nothing else happens; with one running, the same work is done in the same order.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import NamedTuple

import torch

REST = "rest"


class Work(NamedTuple):
    """What a part has to do however it is written: multiplications and additions of matrix products, rows of a table
    read or added to at random places, bytes that stream through memory."""

    products: float = 0.0
    rows: float = 0.0
    bytes: float = 0.0


class Spent(NamedTuple):
    """Seconds of cores, and the work done in them."""

    seconds: float = 0.0
    work: Work = Work()

    def plus(self, seconds: float, work: Work) -> "Spent":
        """With more of both."""
        return Spent(self.seconds + seconds, Work(*(a + b for a, b in zip(self.work, work, strict=True))))


NO_WORK, UNTIMED = Work(), nullcontext()


class Profiler:
    """Sums up parts over all threads; a part within another counts for itself alone, so nothing counts twice.

    On the CPU these are seconds that a thread has computed: what it waited for others, or for other programs, is in no
    part. A GPU is waited for at both ends of a part, in seconds of the clock.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.parts = device, dict[str, Spent]()
        self._lock, self._of_thread = threading.Lock(), threading.local()

    def now(self) -> float:
        """Seconds, from an arbitrary beginning."""
        if self.device.type == "cpu":
            return time.thread_time()
        torch.cuda.synchronize(self.device)
        return time.perf_counter()

    @contextmanager
    def part(self, name: str, work: Work) -> Iterator[None]:
        """The time of the block, less that of parts within it."""
        within = vars(self._of_thread).setdefault("within", [])
        within.append(0.0)
        started = self.now()
        try:
            yield
        finally:
            whole = self.now() - started
            inner = within.pop()
            if within:
                within[-1] += whole
            with self._lock:
                self.parts[name] = self.parts.get(name, Spent()).plus(whole - inner, work)


_running: Profiler | None = None


@contextmanager
def running(stopwatch: Profiler) -> Iterator[None]:
    """Every part met in the block counts, in all threads; what is in no part of its own is the rest. Raises
    RuntimeError where another stopwatch runs already."""
    global _running
    if _running is not None:
        raise RuntimeError("a stopwatch runs already")
    _running = stopwatch
    try:
        with part(REST):
            yield
    finally:
        _running = None


def part(name: str, work: Work = NO_WORK) -> AbstractContextManager[None]:
    """For the running stopwatch, if there is one: what the block does is the part ``name``."""
    return UNTIMED if _running is None else _running.part(name, work)
