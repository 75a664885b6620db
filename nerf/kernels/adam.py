"""Adam for gradients that are zero almost everywhere."""

from jaxtyping import Float
from torch import Tensor

MEAN_DECAY, SQUARE_DECAY = 0.9, 0.99
TINY = 1e-15  # far below any gradient that counts: rarely visited entries keep the same speed as busy ones


def adam(
    parameter: Float[Tensor, "*shape"],
    gradient: Float[Tensor, "*shape"],
    mean: Float[Tensor, "*shape"],
    square: Float[Tensor, "*shape"],
    rate: float,
    count: int,
) -> None:
    """Update ``parameter``, ``mean`` and ``square`` in place (Kingma and Ba 2015, algorithm 1) where the gradient is
    not exactly zero; where it is, nothing changes, momentum included: an entry that no sample touched stays put.

    ``count`` is the number of this update, from 1; all entries share its bias correction.
    """
    live = (gradient != 0).to(gradient.dtype)
    mean.addcmul_(live, gradient - mean, value=1 - MEAN_DECAY)
    square.addcmul_(live, gradient * gradient - square, value=1 - SQUARE_DECAY)
    slope = (square / (1 - SQUARE_DECAY**count)).sqrt_().add_(TINY)
    parameter.addcdiv_(live.mul_(mean), slope, value=-rate / (1 - MEAN_DECAY**count))
