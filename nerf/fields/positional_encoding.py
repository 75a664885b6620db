"""The positional encoding gamma (Mildenhall et al. 2020, eq. 4)."""

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(
    x: Float[Tensor, "*batch dims"], frequencies: int, dtype: torch.dtype | None = None
) -> Float[Tensor, "*batch 2*dims*{frequencies}"]:
    """sin(2^k pi x) of every coordinate for k = 0 ... frequencies - 1, then as many cosines, without the identity.

    Turns of 2 pi are reduced to [-1/2, 1/2] before they become angles: 2^k x/2 and its distance to the nearest whole
    number are exact in binary. That keeps float32 within 1e-6 at every k, and finite as long as 2^k x is.
    With a ``dtype`` the angles are rounded to it, and sines and cosines taken, after they are reduced.
    """
    octaves = 2.0 ** torch.arange(-1, frequencies - 1, dtype=x.dtype, device=x.device)
    turns = (x[..., None] * octaves).flatten(-2)
    angles = (2 * torch.pi * (turns - torch.round(turns))).to(dtype or x.dtype)
    return torch.cat([torch.sin(angles), torch.cos(angles)], -1)
