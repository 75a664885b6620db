"""Losses of what a ray shows.

Of colours, for the hash-grid field: squares of small errors, and no more than linear in those that stand out.

Of opacity, where a photo shows a plain backdrop: the square of the tolerance within which a colour counts as the
backdrop's. Matter of that colour costs nothing there, and a field leaves it wherever no photo sees it before anything
else: black lumps around an object before black. So being opaque costs as much as an error that nobody would see, far
less than what a photo that does see a part of the object knows of it.
"""

from jaxtyping import Bool, Float
from torch import Tensor

HUBER_DELTA = 0.1
"""Of the peak: from this error on colours are pulled no harder, and the loss grows linearly. Of 0.05, 0.1, 0.2 and none
the best on most sets (docs/experiments/colour_loss.md); instant-ngp's, too."""


def huber_loss(
    error: Float[Tensor, "*shape"],
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Twice Huber's loss of each error, and half its derivative: e² and e up to the largest pull d, then 2 d |e| − d²
    and ± d (Huber 1964, "Robust estimation of a location parameter").

    Adam divides by the root mean square of an entry's gradients, so that a few large errors, of an edge that is not
    there yet, of a passer-by or a highlight, would slow all small ones down.
    """
    half_gradient = error.clamp(-HUBER_DELTA, HUBER_DELTA)
    return half_gradient * (2 * error - half_gradient), half_gradient


def shows_backdrop(
    colour: Float[Tensor, "rays 3"], backdrop: Float[Tensor, "*rays 3"], tolerance: float
) -> Bool[Tensor, "rays"]:
    """Which colours are the backdrop's, up to ``tolerance`` in each channel."""
    return (colour - backdrop).abs().amax(1) <= tolerance
