"""Adam for gradients that are zero almost everywhere."""

from jaxtyping import Float
from torch import Tensor

BETA1, BETA2 = 0.9, 0.99
EPSILON = 1e-15  # far below any gradient that counts: rarely visited entries move as fast as busy ones
BLOCK_ENTRIES = 1 << 15  # entries updated at once: what lies between the lines stays in a core's cache


def adam(
    parameter: Float[Tensor, "*shape"],
    gradient: Float[Tensor, "*shape"],
    exp_avg: Float[Tensor, "*shape"],
    exp_avg_sq: Float[Tensor, "*shape"],
    learning_rate: float,
    step: int,
) -> None:
    """Update ``parameter``, ``exp_avg`` and ``exp_avg_sq`` in place where the gradient is not exactly zero; where it
    is, nothing changes, momentum included: an entry that no sample touched stays put. ``gradient`` is zero afterwards.

    Kingma and Ba 2015, algorithm 1, but for epsilon: m ← 0.9 m + 0.1 g, v ← 0.99 v + 0.01 g²,
    p ← p - learning_rate · m / (1 - 0.9^step) / max(EPSILON, √(v / (1 - 0.99^step))). ``step`` is the number of this
    update, from 1; all entries share its bias correction.
    """
    bias_correction1, bias_correction2 = 1 - BETA1**step, 1 - BETA2**step
    whole = (parameter, gradient, exp_avg, exp_avg_sq)
    for p, g, m, v in zip(*(tensor.view(-1).split(BLOCK_ENTRIES) for tensor in whole), strict=True):
        live = (g != 0).to(g.dtype)
        m.addcmul_(live, g - m, value=1 - BETA1)
        v.addcmul_(live, g * g - v, value=1 - BETA2)
        # Not sqrt: torch's is many times slower on zeros, of which most of a table consists.
        slope = (v / bias_correction2).clamp_(min=EPSILON**2).rsqrt_()
        p.addcmul_(live.mul_(m), slope, value=-learning_rate / bias_correction1)
        g.zero_()
