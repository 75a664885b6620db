"""What a curve says in words."""

import pytest

from nerf.training.learning_curve import PredictedGain
from stages.train.curve import doubling_message, predicted_gain_message, ssim_message

POINTS = [{"seconds": 10.0 * 2**k, "probe_psnr": 20.0 + k} for k in range(5)]


def test_doublings_are_of_training_time() -> None:
    last = "the last doubling of training time, to 2 min 40 s, gained +1.0 dB on test pixels"
    assert doubling_message(POINTS, None) == last
    less = "(a separate run of half the time would end higher, so the gain over it is smaller)"
    told = doubling_message(POINTS, PredictedGain(0.71, 0.37)) or ""
    assert told.startswith(f"{last} {less}; ") and "--more 160s" in told and "+0.7 dB (± 0.4)" in told
    assert doubling_message(POINTS[-1:], None) is None


def test_in_a_line_it_is_said_of_what() -> None:
    told = predicted_gain_message(POINTS, PredictedGain(0.71, 0.37)) or ""
    assert "--more 160s" in told and "+0.7 ± 0.4 dB" in told
    assert predicted_gain_message(POINTS, None) is None


def test_what_gained_nothing_has_no_minus() -> None:
    points = [{"seconds": 10.0 * 2**k, "probe_psnr": 20.0 - 0.01 * k} for k in range(5)]
    assert "gained +0.0 dB" in (doubling_message(points, None) or "")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [(0.5, 0.61, "rose from 0.50 to 0.61"), (0.61, 0.5, "fell from 0.61 to 0.50"), (0.846, 0.853, "stayed at 0.85")],
)
def test_ssim_rises_falls_or_stays(before: float, after: float, words: str):
    points = [{"seconds": 10.0 * (k + 1), "probe_ssim": ssim} for k, ssim in enumerate((before, after))]
    assert ssim_message(points) == f"SSIM {words} in that doubling"
