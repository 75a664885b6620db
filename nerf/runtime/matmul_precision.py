"""Float32 matrix products at torch's precision "medium", where that is measured to be faster and about as exact.

What "medium" means depends on processor and torch: the same arithmetic by another library, bfloat16 or TF32 inside (on
a Xeon with tiles twice as fast and off by 2e-3; docs/experiments/reduced_precision.md), or nothing at all. So it is
tried and never assumed.
"""

import functools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.runtime.machine_rates import MATMUL_ROWS, MIN_RUNS

Precision = Literal["highest", "medium"]

REFERENCE_WIDTH = 64  # of the networks; of wider ones fewer rows make as much work
MIN_ROWS = 256
TRIAL_SECONDS = 0.06  # for both precisions together
MIN_SPEEDUP, MAX_MATMUL_ERROR = 1.3, 1e-4


class MediumPrecision(NamedTuple):
    """Products at "medium": how many times faster than at "highest" they are, and how far off
    (:func:`matmul_error`)."""

    speedup: float
    error: float

    @property
    def is_exact(self) -> bool:
        """Whether nobody would see the difference in training."""
        return self.error <= MAX_MATMUL_ERROR

    @property
    def is_worthwhile(self) -> bool:
        """Whether training should use it: clearly faster, and about as exact."""
        return self.is_exact and self.speedup >= MIN_SPEEDUP


@contextmanager
def use_matmul_precision(precision: Precision | None) -> Iterator[None]:
    """Compute the whole process's float32 products at ``precision``, afterwards as before. None changes nothing."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision or before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@functools.cache
def measure_medium_matmul(device: torch.device, width: int) -> MediumPrecision:
    """Of products (n, width) x (width, width), the fastest of several at each precision in turn; once in a process, in
    a tenth of a second. Changes no random state."""
    random = torch.Generator(device).manual_seed(0)
    rows = max(MIN_ROWS, min(MATMUL_ROWS, MATMUL_ROWS * REFERENCE_WIDTH**2 // width**2))
    a, b = (torch.randn(count, width, generator=random, device=device) for count in (rows, width))
    with use_matmul_precision("medium"):
        error = matmul_error(a @ b, a, b)
    seconds = _fastest(a, b)
    return MediumPrecision(seconds["highest"] / seconds["medium"], error)


def matmul_error(found: Float[Tensor, "rows n"], a: Float[Tensor, "rows m"], b: Float[Tensor, "m n"]) -> float:
    """‖found - a b‖ / ‖a b‖, the product in float64."""
    exact = a.double() @ b.double()
    return float((found - exact).norm() / exact.norm())


def _fastest(a: Tensor, b: Tensor) -> dict[Precision, float]:
    """Seconds of the fastest product at each precision."""
    seconds: dict[Precision, float] = {"highest": float("inf"), "medium": float("inf")}
    until, runs = time.perf_counter() + TRIAL_SECONDS, 0
    while runs < MIN_RUNS or time.perf_counter() < until:
        runs += 1
        for precision, least in seconds.items():
            with use_matmul_precision(precision):
                seconds[precision] = min(least, matmul_seconds(a, b))
    return seconds


def matmul_seconds(a: Tensor, b: Tensor) -> float:
    """What one takes at the precision that torch is set to."""
    _wait_for(a.device)
    started = time.perf_counter()
    torch.mm(a, b)
    _wait_for(a.device)
    return time.perf_counter() - started


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
