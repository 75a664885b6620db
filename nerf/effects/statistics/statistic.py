"""A statistic beside its noise and its threshold, and what follows from the three.

How large an effect has to be is the same question everywhere: what does a field lose that does not model it? A field at
30 dB has a mean squared error of 1e-3; it falls to 29.7 dB where an effect adds 7.2 % to that, a root mean square error
of ``MIN_EFFECT`` = 0.0085 in sRGB values. That is where the grey zone begins, and at twice that size, 1.1 dB, an effect
is called for.
"""

from typing import NamedTuple

MIN_EFFECT = 0.0085  # rms error in sRGB values that costs 0.3 dB at 30 dB: sqrt(1e-3 (10^0.03 - 1))
# Root mean square, over the colours of usual photos (mean 0.5, deviation 0.25), of what a step in the natural logarithm
# of linear light changes in the sRGB value s: ds / d ln(light) = (s + 0.055) / 2.4.
VALUE_PER_LOG_LIGHT = 0.25
MIN_SIGNAL_TO_NOISE = 5.0  # times its noise: what is called for is not noise in any of many scenes, photos and channels
GREY_ZONE = 2.0  # the grey zone: from the threshold down to this part of it
HUBER = 1.345  # deviations, beyond which what is left pulls no harder: 95 % of the efficiency of plain means
OF_GAUSSIAN = 1.4826  # the deviation of Gaussian noise by its median absolute value


class Statistic(NamedTuple):
    """The ``value`` that was measured and its ``noise``, infinite where nothing is known, both in ``unit``. From the
    ``threshold`` on the effect is called for; the grey zone begins at half of it. ``called_for`` None: a pilot should
    decide, where there is one. ``words``: one clause with its number."""

    value: float
    unit: str
    threshold: float
    noise: float
    called_for: bool | None
    words: str


def decide(statistic: float, noise: float, threshold: float) -> bool | None:
    """True: it reaches the threshold, and its noise MIN_SIGNAL_TO_NOISE times. False: even two noises more would leave
    it below the grey zone. None: between, or nothing is known (infinite noise)."""
    if statistic >= threshold and statistic >= MIN_SIGNAL_TO_NOISE * noise:
        return True
    return False if statistic + 2 * noise < threshold / GREY_ZONE else None


def classify(statistic: float, noise: float, threshold: float, unit: str, words: str) -> Statistic:
    """A Statistic that follows the rule of :func:`decide`."""
    return Statistic(statistic, unit, threshold, noise, decide(statistic, noise, threshold), words)


def unknown(unit: str, threshold: float, why: str, called_for: bool | None) -> Statistic:
    """Nothing can be measured; ``called_for`` is what to do without knowing."""
    return Statistic(0.0, unit, threshold, float("inf"), called_for, f"not measured: {why}")
