"""The transfer curve of sRGB (IEC 61966-2-1) on arrays, without torch: linear up to a threshold, a power law above."""

import numpy as np
from jaxtyping import Float

SLOPE, OFFSET, POWER = 12.92, 0.055, 2.4
LINEAR_THRESHOLD = 0.04045  # of sRGB; in linear light LINEAR_THRESHOLD / SLOPE


def linear_light(colour: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear light of sRGB colours, without bounds. Inverse: :func:`srgb_values`."""
    power = ((np.maximum(colour, LINEAR_THRESHOLD) + OFFSET) / (1 + OFFSET)) ** POWER
    return np.where(colour <= LINEAR_THRESHOLD, colour / SLOPE, power)


def srgb_values(light: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """sRGB colours of linear light, without bounds; NaN stays. Inverse: :func:`linear_light`."""
    power = (1 + OFFSET) * np.maximum(light, LINEAR_THRESHOLD / SLOPE) ** (1 / POWER) - OFFSET
    return np.where(light <= LINEAR_THRESHOLD / SLOPE, SLOPE * light, power)
