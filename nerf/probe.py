"""A fixed handful of pixels on which a field in training is measured now and then."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import AS_GIVEN, AS_RENDERED, PhotoColours, PhotoRays, Seen
from nerf.metrics import mean_squared_error, psnr
from nerf.model import RadianceModel, Rendering
from nerf.randomness import generator
from nerf.ray_bank import RayBank
from nerf.rays import Rays
from nerf.rendering import render_image
from nerf.training import over


class Probe(NamedTuple):
    """Rays, what they should see, the background both are shown over, and the views that the rays belong to."""

    rays: Rays
    colours: Float[Tensor, "rays 3"]
    background: Float[Tensor, "3"]
    view: Int[Tensor, "rays"]

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
    rays, colour, alpha, view = bank.sample(count, generator(bank.device, seed))
    return Probe(rays, over(colour, alpha, background), background, view)


@torch.no_grad()
def measure(
    model: RadianceModel,
    probe: Probe,
    photo_colours: PhotoColours = AS_RENDERED,
    photo_rays: PhotoRays = AS_GIVEN,
) -> ProbeResult:
    """Render the probe and compare it with the photos, as ``photo_rays`` and ``photo_colours`` have them."""
    one_row = Rays(*(part[None] for part in photo_rays.forward(probe.rays, probe.view)))
    seen = Rendering(*(part[0] for part in render_image(model, one_row, probe.background)))
    residual = photo_colours.residual(Seen(seen, probe.background, probe.view), probe.colours)
    return ProbeResult(psnr(float(residual.square().mean())), float(seen.opacity.mean()))
