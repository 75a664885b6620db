"""A fixed handful of pixels on which a field in training is measured now and then."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from nerf.metrics import mean_squared_error, psnr
from nerf.model import RadianceModel
from nerf.randomness import generator
from nerf.ray_bank import RayBank
from nerf.rays import Rays
from nerf.rendering import render_image
from nerf.training import over


class Probe(NamedTuple):
    """Rays, what they should see, and the background both are shown over."""

    rays: Rays
    colours: Float[Tensor, "rays 3"]
    background: Float[Tensor, "3"]

    @property
    def flat_psnr(self) -> float:
        """What the best single colour scores (dB): a field that is no better has learned nothing of the scene."""
        mean = self.colours.mean(0).expand_as(self.colours)
        return psnr(mean_squared_error(mean, self.colours))


class ProbeResult(NamedTuple):
    """PSNR in dB and mean opacity of a field on a probe."""

    psnr: float
    opacity: float


def make_probe(bank: RayBank, count: int, background: Float[Tensor, "3"], seed: int) -> Probe:
    """Draw ``count`` pixels of ``bank``, always the same for the same seed."""
    rays, colour, alpha = bank.sample(count, generator(bank.device, seed))
    return Probe(rays, over(colour, alpha, background), background)


def measure(model: RadianceModel, probe: Probe) -> ProbeResult:
    """Render the probe and compare."""
    one_row = Rays(*(part[None] for part in probe.rays))
    seen = render_image(model, one_row, probe.background)
    return ProbeResult(psnr(mean_squared_error(seen.colour[0], probe.colours)), float(seen.opacity.mean()))
