"""Adam for gradients that are zero almost everywhere."""

from jaxtyping import Float
from torch import Tensor

MEAN_DECAY, SQUARE_DECAY = 0.9, 0.99
LEAST_ROOT = 1e-15  # far below any gradient that counts: rarely visited entries move as fast as busy ones
BLOCK = 1 << 15  # entries updated at once: what lies between the lines stays in a core's cache


def adam(
    parameter: Float[Tensor, "*shape"],
    gradient: Float[Tensor, "*shape"],
    mean: Float[Tensor, "*shape"],
    square: Float[Tensor, "*shape"],
    rate: float,
    count: int,
) -> None:
    """Update ``parameter``, ``mean`` and ``square`` in place where the gradient is not exactly zero; where it is,
    nothing changes, momentum included: an entry that no sample touched stays put. ``gradient`` is zero afterwards.

    Kingma and Ba 2015, algorithm 1, but for epsilon: m ← 0.9 m + 0.1 g, v ← 0.99 v + 0.01 g²,
    p ← p - rate · m / (1 - 0.9^count) / max(LEAST_ROOT, √(v / (1 - 0.99^count))). ``count`` is the number of this
    update, from 1; all entries share its bias correction.
    """
    mean_share, square_share = 1 - MEAN_DECAY**count, 1 - SQUARE_DECAY**count
    whole = (parameter, gradient, mean, square)
    for p, g, m, v in zip(*(tensor.view(-1).split(BLOCK) for tensor in whole), strict=True):
        live = (g != 0).to(g.dtype)
        m.addcmul_(live, g - m, value=1 - MEAN_DECAY)
        v.addcmul_(live, g * g - v, value=1 - SQUARE_DECAY)
        # Not sqrt: torch's is many times slower on zeros, of which most of a table consists.
        slope = (v / square_share).clamp_(min=LEAST_ROOT**2).rsqrt_()
        p.addcmul_(live.mul_(m), slope, value=-rate / mean_share)
        g.zero_()
