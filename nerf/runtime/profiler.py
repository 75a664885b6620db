"""A profiler of training steps: seconds of the cores by span, beside the work that each span cannot do without.

Code names its spans where it does the work, ``with span("gather", WorkCounts(gathered_rows=...)):``. Without a running
profiler that costs less than a microsecond; with one, the same work is done in the same order.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import NamedTuple

import torch

OTHER = "rest"


class WorkCounts(NamedTuple):
    """What a span has to do however it is written: multiplications and additions of matrix products, table rows read or
    added to at random places, bytes that stream through memory."""

    matmul_flops: float = 0.0
    gathered_rows: float = 0.0
    streamed_bytes: float = 0.0


class SpanTotal(NamedTuple):
    """Seconds of cores, and the work done in them."""

    seconds: float = 0.0
    work: WorkCounts = WorkCounts()

    def plus(self, seconds: float, work: WorkCounts) -> "SpanTotal":
        """With more of both."""
        return SpanTotal(self.seconds + seconds, WorkCounts(*(a + b for a, b in zip(self.work, work, strict=True))))


NO_WORK, UNTIMED = WorkCounts(), nullcontext()


class Profiler:
    """Sums up spans over all threads; a span within another counts for itself alone, so nothing counts twice.

    On the CPU these are seconds that a thread has computed: what it waited for others, or for other programs, is in no
    span. A GPU is waited for at both ends of a span, in seconds of the clock.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.spans = device, dict[str, SpanTotal]()
        self._lock, self._of_thread = threading.Lock(), threading.local()

    def now(self) -> float:
        """Seconds, from an arbitrary beginning."""
        if self.device.type == "cpu":
            return time.thread_time()
        torch.cuda.synchronize(self.device)
        return time.perf_counter()

    @contextmanager
    def span(self, name: str, work: WorkCounts) -> Iterator[None]:
        """The time of the block, less that of spans within it."""
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
                self.spans[name] = self.spans.get(name, SpanTotal()).plus(whole - inner, work)


_running: Profiler | None = None


@contextmanager
def profiling(profiler: Profiler) -> Iterator[None]:
    """Every part met in the block counts, in all threads; what is in no part of its own is the rest. Raises
    RuntimeError where another profiler runs already."""
    global _running
    if _running is not None:
        raise RuntimeError("a profiler runs already")
    _running = profiler
    try:
        with span(OTHER):
            yield
    finally:
        _running = None


def is_profiling() -> bool:
    """Whether a profiler runs."""
    return _running is not None


def span(name: str, work: WorkCounts = NO_WORK) -> AbstractContextManager[None]:
    """For the running profiler, if there is one: what the block does is the span ``name``."""
    return UNTIMED if _running is None else _running.span(name, work)
