"""What a curve of quality against training time tells: the gain of its last doubling, the predicted gain of the next
one, and from when on returns diminish.

A curve is a sequence of (seconds, dB) of one run, rising in seconds. Between its points quality is linear in the
logarithm of time.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

Curve = Sequence[tuple[float, float]]

MIN_DOUBLING_GAIN_DB = 0.5
"""Returns have diminished once a doubling of the time gains less: about the least that people see side by side."""


class PredictedGain(NamedTuple):
    """Decibels, and half the width of the 80 % prediction interval."""

    db: float
    half_width: float


def quality_at(curve: Curve, seconds: float) -> float:
    """dB after so many seconds. Raises ValueError outside of the curve."""
    if not curve or not curve[0][0] <= seconds <= curve[-1][0]:
        raise ValueError(f"the curve has no point on both sides of {seconds:g} s")
    after = next(index for index, (time, _) in enumerate(curve) if time >= seconds)
    if curve[after][0] == seconds:
        return curve[after][1]
    (early, low), (late, high) = curve[after - 1], curve[after]
    return low + (high - low) * math.log(seconds / early) / math.log(late / early)


def last_doubling_gain(curve: Curve) -> float | None:
    """The gain over the second half of the time, in dB; None where the curve does not reach back that far."""
    if len(curve) < 2 or curve[0][0] > curve[-1][0] / 2:
        return None
    return curve[-1][1] - quality_at(curve, curve[-1][0] / 2)


def diminishing_returns_seconds(curve: Curve) -> float | None:
    """The seconds from which on every doubling of the time bought less than MIN_DOUBLING_GAIN_DB; None while doublings
    buy more, or where the curve does not reach back far enough to tell."""
    if last_doubling_gain(curve) is None:
        return None
    half, found = curve[-1][0] / 2, None
    for seconds in [half, *(time for time, _ in reversed(curve) if time < half)]:
        if quality_at(curve, 2 * seconds) - quality_at(curve, seconds) >= MIN_DOUBLING_GAIN_DB:
            break
        found = seconds
    return found


# Least squares over 32 pairs of runs of T and 2 T steps of the hash-grid field, eight sets
# (docs/experiments/learning_curve.md): the gain of a run from half of its time to its end, decay phase included,
# against how much higher a run of twice the time ends. 30 pairs on ten sets gave the same later.
MIN_STEPS = 500  # a shorter run is still all floaters, and tells nothing of a longer one
PREDICTED_GAIN_RATIO = 0.71
PREDICTED_GAIN_HALF_WIDTH = 0.37  # dB: it covers four of five sets, each predicted from the others


def predicted_doubling_gain(curve: Curve, steps: int) -> PredictedGain | None:
    """How much higher a run of twice the time is predicted to end than this one of ``steps``; None below MIN_STEPS, and
    as :func:`last_doubling_gain`."""
    last = last_doubling_gain(curve)
    if last is None or steps < MIN_STEPS:
        return None
    return PredictedGain(PREDICTED_GAIN_RATIO * last, PREDICTED_GAIN_HALF_WIDTH)
