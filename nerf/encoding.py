"""The positional encoding gamma (Mildenhall et al. 2020, eq. 4)."""

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(
    x: Float[Tensor, "*batch dims"], frequencies: int
) -> Float[Tensor, "*batch 2*dims*{frequencies}"]:
    """sin(2^k pi x) of every coordinate for k = 0 ... frequencies - 1, then as many cosines, without the identity.

    2^k x is exact in binary, and so is its reduction to [-1, 1] by the period 2; only then is it multiplied by pi.
    That keeps float32 within 1e-6 at every k and stays finite however large x is. A cosine is the sine a quarter
    period on, which makes one pass of both.
    """
    octaves = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    turns = (x[..., None] * octaves).flatten(-2)
    turns = turns - 2 * torch.round(turns / 2)
    quarter = torch.tensor([[0.0], [0.5]], dtype=x.dtype, device=x.device)
    return torch.sin(torch.pi * (turns[..., None, :] + quarter)).flatten(-2)
