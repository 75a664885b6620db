import time

import pytest
import torch

from nerf.runtime import machine_rates
from nerf.runtime.machine_rates import Rates, measure_rates
from nerf.runtime.profiler import Profiler, WorkCounts

CPU = torch.device("cpu")


def test_rates_are_plausible_and_keep_random_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_rates, "STREAMED_FLOATS", 1 << 18)
    monkeypatch.setattr(machine_rates, "MIN_STREAMED_FLOATS", 1 << 16)
    monkeypatch.setattr(machine_rates, "GATHERED_ROWS", 1 << 12)
    before = torch.get_rng_state()
    rates = measure_rates(CPU, width=16, rows=1 << 10, seconds=0.05)
    assert torch.equal(before, torch.get_rng_state())
    for rate in rates:
        assert 1e6 < rate < 1e14


def test_a_clock_that_moves_in_long_steps_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_rates, "GATHERED_ROWS", 1 << 12)
    rate = machine_rates.measure_gather(CPU, 1 << 10, 0.2)
    monkeypatch.setattr(Profiler, "now", lambda _: time.thread_time() // 0.016 * 0.016)  # as on Windows
    assert 1 / 4 < machine_rates.measure_gather(CPU, 1 << 10, 0.2) / rate < 4


@pytest.mark.parametrize("cores", [1, 2, 16, 256])
def test_what_is_copied_fits_into_no_cache(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_rates, "workers", lambda: cores)
    each = 2 * machine_rates.copied_bytes(CPU)
    assert each * cores > 2 * 105e6 and each > 16e6
    assert each * cores < 2e9 or each < 64e6, "nor is it a burden to a machine of many cores"


def test_the_same_again_is_about_as_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (measure_rates(CPU, width=64, rows=1 << 12, seconds=0.3).matmul_flops for _ in range(2))
    assert 1 / 3 < first / second < 3


def test_seconds_of_work_are_a_sum_of_shares() -> None:
    rates = Rates(matmul_flops=10.0, gathered_rows=4.0, streamed_bytes=2.0)
    assert rates.seconds(WorkCounts()) == 0
    assert rates.seconds(WorkCounts(matmul_flops=20, gathered_rows=4, streamed_bytes=1)) == 2 + 1 + 0.5
