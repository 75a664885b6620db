"""Matrix products at torch's "medium": taken where it is faster and about as exact, and set nowhere else."""

import math

import pytest
import torch

from nerf.runtime import matmul_precision
from nerf.runtime.matmul_precision import (
    MAX_MATMUL_ERROR,
    MediumPrecision,
    matmul_error,
    measure_medium_matmul,
    use_matmul_precision,
)

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def nothing_is_known() -> None:
    measure_medium_matmul.cache_clear()


def rounded(values: torch.Tensor, bits: int) -> torch.Tensor:
    """Float32 with so many bits of mantissa kept, as TF32 has 10 and bfloat16 has 7."""
    unit = 1 << (23 - bits)
    return ((values.view(torch.int32) + unit // 2) & -unit).view(torch.float32)


@pytest.mark.parametrize(
    "speedup, error, is_worthwhile",
    [(1.3, 1e-4, True), (1.29, 0.0, False), (5.0, 1.1e-4, False), (5.0, math.nan, False)],
)
def test_it_pays_where_it_is_faster_and_about_as_exact(speedup: float, error: float, is_worthwhile: bool) -> None:
    assert MediumPrecision(speedup, error).is_worthwhile is is_worthwhile


def test_the_setting_is_put_back_whatever_happens() -> None:
    with pytest.raises(KeyError), use_matmul_precision("medium"):
        assert torch.get_float32_matmul_precision() == "medium"
        with use_matmul_precision("highest"):
            assert torch.get_float32_matmul_precision() == "highest"
        with use_matmul_precision(None):
            assert torch.get_float32_matmul_precision() == "medium"
        raise KeyError
    assert torch.get_float32_matmul_precision() == "highest"


@pytest.mark.parametrize("seconds, speedup", [({"highest": 6.0, "medium": 2.0}, 3.0), ({}, 1.0)])
def test_the_fastest_of_several_counts(seconds: dict[str, float], speedup: float, monkeypatch) -> None:
    asked = []

    def made_up(a: torch.Tensor, b: torch.Tensor) -> float:
        asked.append((torch.get_float32_matmul_precision(), *a.shape, *b.shape))
        return seconds.get(asked[-1][0], 1.0) * (3.0 if len(asked) < 5 else 1.0)

    monkeypatch.setattr(matmul_precision, "TRIAL_SECONDS", 0.0)
    monkeypatch.setattr(matmul_precision, "matmul_seconds", made_up)
    found = measure_medium_matmul(CPU, 64)
    assert found.speedup == speedup and 0 <= found.error < 0.1
    assert asked == [("highest", 8192, 64, 64, 64), ("medium", 8192, 64, 64, 64)] * 3
    assert measure_medium_matmul(CPU, 64) is found and len(asked) == 6, "once is enough"


@pytest.mark.parametrize("width, rows", [(2, 8192), (64, 8192), (128, 2048), (256, 512), (1024, 256)])
def test_networks_of_any_width_are_as_much_work(width: int, rows: int, monkeypatch) -> None:
    tried = []
    monkeypatch.setattr(matmul_precision, "_fastest", lambda a, b: tried.append(a) or {"highest": 1.0, "medium": 1.0})
    measure_medium_matmul(CPU, width)
    assert tried[0].shape == (rows, width)


def test_it_is_measured_here_without_touching_random_state() -> None:
    state = torch.get_rng_state()
    found = measure_medium_matmul(CPU, 64)
    assert 0.01 < found.speedup < 100 and 0 <= found.error < 0.1
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_float32_matmul_precision() == "highest"


def test_float32_is_exact_enough_and_fewer_bits_inside_are_not() -> None:
    random = torch.Generator().manual_seed(1)
    a, b = torch.randn(2048, 64, generator=random), torch.randn(64, 64, generator=random)
    assert 0 < matmul_error(a @ b, a, b) < MAX_MATMUL_ERROR / 100
    tf32, bfloat16 = (matmul_error(rounded(a, bits) @ rounded(b, bits), a, b) for bits in (10, 7))
    assert 2 * MAX_MATMUL_ERROR < tf32 < 1e-3 < bfloat16 < 1e-2
