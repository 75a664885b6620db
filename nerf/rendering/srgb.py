"""The transfer curve of sRGB (IEC 61966-2-1): linear up to a threshold, a power law above it."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

SLOPE, OFFSET, POWER = 12.92, 0.055, 2.4
LINEAR_THRESHOLD = 0.04045  # of sRGB; in linear light LINEAR_THRESHOLD / SLOPE
MAX_SRGB = 1e12  # its linear light is 5e28; that of much brighter colours overflows float32


def srgb_to_linear(c: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear light of sRGB colours, clamped to [0, MAX_SRGB]. Inverse: :func:`linear_to_srgb`."""
    c = c.clamp(0, MAX_SRGB)
    power = ((c.clamp(min=LINEAR_THRESHOLD) + OFFSET) / (1 + OFFSET)) ** POWER
    return torch.where(c > LINEAR_THRESHOLD, power, c / SLOPE)


def linear_to_srgb(l: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:  # noqa: E741
    """sRGB colours of linear light; 0 below 0. Inverse: :func:`srgb_to_linear`."""
    light = l.clamp(min=0)
    power = (1 + OFFSET) * light.clamp(min=LINEAR_THRESHOLD / SLOPE) ** (
        1 / POWER
    ) - OFFSET  # no power of 0: its slope is infinite
    return torch.where(light > LINEAR_THRESHOLD / SLOPE, power, light * SLOPE)


def linear_light(colour: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """As :func:`srgb_to_linear`, of arrays and without bounds. Inverse: :func:`srgb_values`."""
    power = ((np.maximum(colour, LINEAR_THRESHOLD) + OFFSET) / (1 + OFFSET)) ** POWER
    return np.where(colour <= LINEAR_THRESHOLD, colour / SLOPE, power)


def srgb_values(light: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """As :func:`linear_to_srgb`, of arrays and without bounds; NaN stays. Inverse: :func:`linear_light`."""
    power = (1 + OFFSET) * np.maximum(light, LINEAR_THRESHOLD / SLOPE) ** (1 / POWER) - OFFSET
    return np.where(light <= LINEAR_THRESHOLD / SLOPE, SLOPE * light, power)
