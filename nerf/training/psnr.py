"""PSNR and the mean squared error behind it, as numbers that JSON can hold."""

import math

from jaxtyping import Float
from torch import Tensor

PSNR_LIMIT = 100.0
"""What equal pictures score, in dB. Their true PSNR is infinite, which neither JSON nor a mean can hold; rounding
to 8 bits alone keeps a photo below 59 dB, so no real comparison comes near."""


def mean_squared_error(image: Float[Tensor, "*shape"], truth: Float[Tensor, "*shape"]) -> float:
    """The mean over all pixels and channels of the squared difference."""
    return float((image - truth).square().mean())


def psnr(squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10(MSE) for a peak of 1; PSNR_LIMIT and no more for tiny errors.

    Raises ValueError for a negative or non-finite error: it is a fault to be found, not a quality.
    """
    if not 0 <= squared_error < math.inf:
        raise ValueError(f"a mean squared error cannot be {squared_error}")
    if squared_error <= 10 ** (-PSNR_LIMIT / 10):
        return PSNR_LIMIT
    return -10 * math.log10(squared_error)
