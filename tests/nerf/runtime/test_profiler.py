"""Laws of the profiler: nothing counts twice, nothing is lost, and without one nothing happens."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import OTHER, UNTIMED, Profiler, SpanTotal, WorkCounts, profiling, span

CPU = torch.device("cpu")


def compute(seconds: float) -> None:
    """Keep this thread's core busy for so long."""
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_without_a_stopwatch_a_part_is_nothing() -> None:
    assert span("mlp", WorkCounts(matmul_flops=1)) is UNTIMED


def test_a_part_within_another_counts_for_itself_alone() -> None:
    profiler = Profiler(CPU)
    with profiling(profiler), span("outer"):
        compute(0.02)
        with span("inner"):
            compute(0.05)
        compute(0.02)
    spent = {name: found.seconds for name, found in profiler.spans.items()}
    assert 0.04 <= spent["outer"] < 0.049
    assert 0.05 <= spent["inner"] < 0.059
    assert 0 <= spent[OTHER] < 0.01


def test_the_parts_are_all_that_the_threads_computed() -> None:
    def work(_: int) -> float:
        started = time.thread_time()
        with span("mlp"):
            compute(0.01)
        compute(0.005)
        return time.thread_time() - started

    profiler = Profiler(CPU)
    torch.set_num_threads(3)
    started = time.thread_time()
    try:
        with profiling(profiler):
            of_chunks = sum(in_order(work, range(6), CPU))
    finally:
        torch.set_num_threads(1)
    of_main = time.thread_time() - started
    spent = {name: found.seconds for name, found in profiler.spans.items()}
    assert set(spent) == {"mlp", OTHER}
    assert 0.06 <= spent["mlp"] < 0.07
    assert of_chunks <= sum(spent.values()) <= of_chunks + of_main + 0.005


def test_waiting_is_in_no_part() -> None:
    profiler = Profiler(CPU)
    with profiling(profiler), span("mlp"):
        time.sleep(0.05)
    assert sum(found.seconds for found in profiler.spans.values()) < 0.02


def test_work_adds_up_over_threads() -> None:
    def work(count: int) -> None:
        with span("gather", WorkCounts(gathered_rows=count, streamed_bytes=2)):
            pass

    profiler = Profiler(CPU)
    with profiling(profiler), ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(100)))
    assert profiler.spans["gather"].work == WorkCounts(0, 4950, 200)
    assert profiler.spans[OTHER].work == WorkCounts()


def test_a_fault_ends_the_stopwatch_and_its_parts() -> None:
    profiler = Profiler(CPU)
    with pytest.raises(ZeroDivisionError), profiling(profiler), span("mlp"), span("encode"):
        raise ZeroDivisionError
    assert span("mlp") is UNTIMED
    assert set(profiler.spans) == {"mlp", "encode", OTHER}


def test_two_at_once_are_refused() -> None:
    with profiling(Profiler(CPU)):
        second = profiling(Profiler(CPU))
        with pytest.raises(RuntimeError, match="a profiler runs already"):
            second.__enter__()


def test_spent_adds_both() -> None:
    assert SpanTotal(1.0, WorkCounts(1, 2, 3)).plus(0.5, WorkCounts(4, 5, 6)) == SpanTotal(1.5, WorkCounts(5, 7, 9))
