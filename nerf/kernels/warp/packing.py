"""Memory for packed samples."""

import torch
from jaxtyping import Int32
from torch import Tensor


def new_packed(
    counts: Int32[Tensor, "rays_and_end"], integers: int, floats: int, capacity: int | None = None
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Where each ray's samples start, and arrays for so many ``integers`` and ``floats`` of each sample.

    ``counts`` has a 0, then the number of each ray's samples. Without a ``capacity`` (nerf/kernels) a GPU is waited
    for.
    """
    starts, device = counts.cumsum(0, dtype=torch.int32), counts.device
    if capacity is None:
        length, new = int(starts[-1]), torch.empty
    else:
        length, new = capacity, torch.zeros
        starts.clamp_(max=capacity)
    return (
        starts,
        [new(length, dtype=torch.int32, device=device) for _ in range(integers)],
        [new(length, device=device) for _ in range(floats)],
    )
