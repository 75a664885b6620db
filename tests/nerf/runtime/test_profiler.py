"""Laws of the stopwatch: nothing counts twice, nothing is lost, and without one nothing happens."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import REST, UNTIMED, Profiler, Spent, Work, part, running

CPU = torch.device("cpu")


def compute(seconds: float) -> None:
    """Keep this thread's core busy for so long."""
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_without_a_stopwatch_a_part_is_nothing() -> None:
    assert part("mlp", Work(products=1)) is UNTIMED


def test_a_part_within_another_counts_for_itself_alone() -> None:
    stopwatch = Profiler(CPU)
    with running(stopwatch), part("outer"):
        compute(0.02)
        with part("inner"):
            compute(0.05)
        compute(0.02)
    spent = {name: found.seconds for name, found in stopwatch.parts.items()}
    assert 0.04 <= spent["outer"] < 0.049
    assert 0.05 <= spent["inner"] < 0.059
    assert 0 <= spent[REST] < 0.01


def test_the_parts_are_all_that_the_threads_computed() -> None:
    def work(_: int) -> float:
        started = time.thread_time()
        with part("mlp"):
            compute(0.01)
        compute(0.005)
        return time.thread_time() - started

    stopwatch = Profiler(CPU)
    torch.set_num_threads(3)
    started = time.thread_time()
    try:
        with running(stopwatch):
            of_chunks = sum(in_order(work, range(6), CPU))
    finally:
        torch.set_num_threads(1)
    of_main = time.thread_time() - started
    spent = {name: found.seconds for name, found in stopwatch.parts.items()}
    assert set(spent) == {"mlp", REST}
    assert 0.06 <= spent["mlp"] < 0.07
    assert of_chunks <= sum(spent.values()) <= of_chunks + of_main + 0.005


def test_waiting_is_in_no_part() -> None:
    stopwatch = Profiler(CPU)
    with running(stopwatch), part("mlp"):
        time.sleep(0.05)
    assert sum(found.seconds for found in stopwatch.parts.values()) < 0.02


def test_work_adds_up_over_threads() -> None:
    def work(count: int) -> None:
        with part("gather", Work(rows=count, bytes=2)):
            pass

    stopwatch = Profiler(CPU)
    with running(stopwatch), ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(100)))
    assert stopwatch.parts["gather"].work == Work(0, 4950, 200)
    assert stopwatch.parts[REST].work == Work()


def test_a_fault_ends_the_stopwatch_and_its_parts() -> None:
    stopwatch = Profiler(CPU)
    with pytest.raises(ZeroDivisionError), running(stopwatch), part("mlp"), part("encode"):
        raise ZeroDivisionError
    assert part("mlp") is UNTIMED
    assert set(stopwatch.parts) == {"mlp", "encode", REST}


def test_two_at_once_are_refused() -> None:
    with running(Profiler(CPU)):
        second = running(Profiler(CPU))
        with pytest.raises(RuntimeError, match="a stopwatch runs already"):
            second.__enter__()


def test_spent_adds_both() -> None:
    assert Spent(1.0, Work(1, 2, 3)).plus(0.5, Work(4, 5, 6)) == Spent(1.5, Work(5, 7, 9))
