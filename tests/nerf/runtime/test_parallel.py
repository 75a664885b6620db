"""Chunks on all cores: in order, bounded, interruptible."""

import threading

import pytest
import torch

from nerf.runtime.parallel import in_order, take_over_cores, workers

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_results_keep_the_order_of_the_items():
    assert list(in_order(lambda n: n * n, range(50), CPU)) == [n * n for n in range(50)]


def test_nothing_in_nothing_out():
    assert list(in_order(lambda n: n, [], CPU)) == []


def test_workers_run_beside_each_other_with_torchs_own_threads_off():
    meeting = threading.Barrier(2, timeout=20)

    def work(_: int) -> int:
        meeting.wait()  # breaks unless two workers are here at once
        return torch.get_num_threads()

    assert list(in_order(work, range(4), CPU)) == [1, 1, 1, 1]
    assert torch.get_num_threads() == 2


def test_an_error_comes_out_and_later_chunks_are_not_begun():
    begun = []

    def work(n: int) -> int:
        begun.append(n)
        if n == 3:
            raise ValueError("chunk 3")
        return n

    with pytest.raises(ValueError, match="chunk 3"):
        list(in_order(work, range(1000), CPU))
    assert len(begun) < 20


def test_one_thread_works_in_the_caller():
    torch.set_num_threads(1)
    assert list(in_order(lambda _: threading.current_thread(), [0], CPU)) == [threading.current_thread()]


def test_cores_taken_over_stay_with_the_chunks():
    take_over_cores()
    assert torch.get_num_threads() == 1
    take_over_cores()  # a second time changes nothing
    assert workers() == 2
    assert list(in_order(lambda _: torch.get_num_threads(), range(3), CPU)) == [1, 1, 1]
