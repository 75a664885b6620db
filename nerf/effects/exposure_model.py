"""Effect ``exposure``, while training: a gain per photo and channel, which begins as the tracks measured it.

The field holds what the darkest photo shows: its colours end at 1, and only the photo with the least gain shows all
that is bright. So gains are kept as they are above the least one of each channel, which stands for one.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf import FULL
from nerf.effects import Seen
from nerf.effects.exposure import expose, expose_backward
from nerf.fields.interface import Rendering

RATE = 2e-3  # of the logarithm of a gain; gains begin within a percent or two of where they end


class Exposures:
    """A :class:`nerf.effects.PhotoColours`. ``log_gain``: natural logarithms of gains in linear light, a row per view.

    The gain is of the scene's own light, not of a background that photos with alpha are laid over.
    """

    rate = RATE

    def __init__(self, log_gain: Float[Tensor, "views 3"]) -> None:
        self.log_gain = log_gain.clone()
        self.mean = self.log_gain.mean(0)

    @classmethod
    def of_tracks(cls, log_gain: Float[Tensor, "views 3"]) -> "Exposures":
        """From gains that are known up to a factor per channel."""
        return cls(log_gain - log_gain.amin(0))

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views 3"]]:
        """The logarithms of the gains."""
        return {"log_gain": self.log_gain}

    def settle(self) -> None:
        """Keep the mean: a field twice as bright under gains half as large shows the same."""
        self.log_gain -= self.log_gain.mean(0) - self.mean

    @property
    def neutral(self) -> Float[Tensor, "3"]:
        """The gain that stands for all: the median over the photos, per channel."""
        return self.log_gain.median(0).values

    def of_unseen(self, weights: Float[Tensor, "unseen views"]) -> "Exposures":
        """Gains like those of the photos taken nearest by: a camera that sets its exposure sees there what they saw."""
        return Exposures(weights.to(self.log_gain) @ self.log_gain)

    def residual(self, seen: Seen, target: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
        """e(C - (1 - o) b) + (1 - o) b less the target, with e of nerf/effects/exposure.py and opacity o; 0 where the
        photo is FULL and would be: a photo ends at 1, and does not tell by how much it was exceeded."""
        own, behind = _parts(seen)
        shown = expose(own, self.log_gain.index_select(0, seen.view)) + behind
        return torch.where((shown > 1) & (target >= FULL / 255), 0.0, shown - target)

    def backward(self, seen: Seen, grad: Float[Tensor, "rays 3"]) -> tuple[Rendering, dict[str, Tensor]]:
        """By the chain rule: the opacity moves both terms. ``grad`` is 0 where the residual was cut to 0."""
        own, _ = _parts(seen)
        of_own, of_gain = expose_backward(own, self.log_gain.index_select(0, seen.view), grad)
        opacity = ((of_own - grad) * seen.background).sum(-1)
        log_gain = torch.zeros_like(self.log_gain).index_add_(0, seen.view, of_gain)
        return Rendering(of_own, torch.zeros_like(opacity), opacity), {"log_gain": log_gain}


def _parts(seen: Seen) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """The scene's own light, and what is seen of the background."""
    behind = (1 - seen.rendering.opacity)[:, None] * seen.background
    return seen.rendering.colour - behind, behind
