"""Packed samples with padding (nerf/kernels)."""

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from nerf.kernels import Samples


def padded_samples(samples: Samples, capacity: int) -> Samples:
    """With padding, or without those that find no place, so that there are ``capacity`` (nerf/kernels)."""
    starts, *arrays = samples
    return Samples(starts.clamp(max=capacity), *(padded(each, capacity) for each in arrays))


def padded(array: Shaped[Tensor, "samples"], capacity: int) -> Shaped[Tensor, "{capacity}"]:
    """An array of packed samples with zeros behind it, or cut."""
    return torch.nn.functional.pad(array, (0, capacity - len(array)))


def no_padding(samples: Samples) -> Bool[Tensor, "samples"]:
    """Which entries belong to a ray."""
    return torch.arange(len(samples.t), device=samples.t.device) < samples.starts[-1]
