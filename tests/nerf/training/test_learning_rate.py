import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.training.learning_rate import learning_rate, lr_multiplier


def test_the_rate_warms_up_stays_and_falls() -> None:
    assert lr_multiplier(0, 0.0) == pytest.approx(0.05)
    assert lr_multiplier(19, 0.1) == lr_multiplier(500, 0.75) == 1
    assert lr_multiplier(500, 0.875) == pytest.approx(0.05**0.5)
    assert lr_multiplier(500, 1.0) == pytest.approx(0.05)


@given(st.floats(0.0, 1.0), st.floats(0.0, 0.5))
def test_equal_shares_lower_the_rate_by_equal_factors(progress: float, more: float) -> None:
    ratio = learning_rate(progress + more, 5e-4, 5e-5) / learning_rate(progress, 5e-4, 5e-5)
    assert ratio == pytest.approx(0.1**more, rel=1e-9)


def test_the_rate_starts_and_ends_as_published() -> None:
    assert learning_rate(0.0, 5e-4, 5e-5) == 5e-4
    assert learning_rate(1.0, 5e-4, 5e-5) == pytest.approx(5e-5)
