"""The transfer curve of sRGB on tensors, bounded, with gradients; srgb_arrays.py has it on arrays."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.rendering.srgb_arrays import LINEAR_THRESHOLD, OFFSET, POWER, SLOPE

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
