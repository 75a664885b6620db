"""The transfer curve of sRGB (IEC 61966-2-1): straight up to a knee, a power above it."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

SLOPE, OFFSET, POWER = 12.92, 0.055, 2.4
KNEE = 0.04045  # of sRGB; in linear light KNEE / SLOPE
BRIGHTEST = 1e12  # sRGB; its light is 5e28, and far brighter colours have one that float32 cannot hold


def srgb_to_linear(c: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Light of sRGB colours, s⁻¹; 0 below 0, and no more than that of BRIGHTEST. Inverse: :func:`linear_to_srgb`."""
    c = c.clamp(0, BRIGHTEST)
    power = ((c.clamp(min=KNEE) + OFFSET) / (1 + OFFSET)) ** POWER
    return torch.where(c > KNEE, power, c / SLOPE)


def linear_to_srgb(l: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:  # noqa: E741
    """sRGB colours of light, s; 0 below 0. Inverse: :func:`srgb_to_linear`."""
    light = l.clamp(min=0)
    power = (1 + OFFSET) * light.clamp(min=KNEE / SLOPE) ** (1 / POWER) - OFFSET  # no power of 0: its slope is infinite
    return torch.where(light > KNEE / SLOPE, power, light * SLOPE)


def linear_light(colour: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """As :func:`srgb_to_linear`, of arrays and without bounds. Inverse: :func:`srgb_values`."""
    power = ((np.maximum(colour, KNEE) + OFFSET) / (1 + OFFSET)) ** POWER
    return np.where(colour <= KNEE, colour / SLOPE, power)


def srgb_values(light: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """As :func:`linear_to_srgb`, of arrays and without bounds; NaN stays. Inverse: :func:`linear_light`."""
    power = (1 + OFFSET) * np.maximum(light, KNEE / SLOPE) ** (1 / POWER) - OFFSET
    return np.where(light <= KNEE / SLOPE, SLOPE * light, power)
