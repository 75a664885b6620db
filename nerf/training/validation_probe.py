"""Fixed pixels on which a field in training is measured now and then: single ones, which tell PSNR, and small whole
patches of the photos, which can be compared in structure."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.effects import NO_EFFECTS, ImageEffects, RenderedRays
from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.rendering.images import render_image
from nerf.runtime.randomness import generator
from nerf.training.metrics import mean_squared_error, psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import over


class Probe(NamedTuple):
    """Rays, what they should see, the background both are shown over, and the views that the rays belong to."""

    rays: Rays
    colours: Float[Tensor, "rays 3"]
    background: Float[Tensor, "3"]
    view: Int[Tensor, "rays"]

    @property
    def mean_colour_psnr(self) -> float:
        """What the best single colour scores (dB): a field that is no better has learned nothing of the scene."""
        mean = self.colours.mean(0).expand_as(self.colours)
        return psnr(mean_squared_error(mean, self.colours))

    def to(self, device: torch.device | str) -> "Probe":
        """The same on another device."""
        rays, *others = self
        return Probe(rays.each(lambda part: part.to(device)), *(part.to(device) for part in others))


class ProbeResult(NamedTuple):
    """PSNR in dB and mean opacity of a field on a probe."""

    psnr: float
    opacity: float


class Patches(NamedTuple):
    """Squares of photos: ``probe`` has their pixels one patch after the other, row by row; ``used`` says which of them
    count."""

    probe: Probe
    used: Bool[Tensor, "patches side side"]

    def to(self, device: torch.device | str) -> "Patches":
        """The same on another device."""
        return Patches(self.probe.to(device), self.used.to(device))


def make_probe(dataset: RayDataset, count: int, background: Float[Tensor, "3"], seed: int) -> Probe:
    """Draw ``count`` pixels of ``dataset``, always the same for the same seed."""
    return _probe_of(dataset, dataset.draw(count, generator(dataset.device, seed)), background)


def make_patches(dataset: RayDataset, count: int, side: int, background: Float[Tensor, "3"], seed: int) -> Patches:
    """``count`` squares around random pixels of ``dataset``, moved to lie inside their photos; the same for the same
    seed. Their side is ``side`` pixels, less where a photo is smaller."""
    first, width = dataset.layout[:2]
    height = dataset.first_pixel.diff() // width
    side = min(side, int(width.min()), int(height.min()))
    pixel = dataset.draw(count, generator(dataset.device, seed, 1))
    view = torch.searchsorted(dataset.first_pixel, pixel, right=True) - 1
    first, width, height = (table.index_select(0, view) for table in (first, width, height))
    within = pixel - first
    top = (within // width - side // 2).clamp(min=0).minimum(height - side)
    left = (within % width - side // 2).clamp(min=0).minimum(width - side)
    steps = torch.arange(side, device=dataset.device)
    corner = first + top * width + left
    pixels = corner[:, None, None] + steps[:, None] * width[:, None, None] + steps
    return Patches(_probe_of(dataset, pixels.flatten(), background), dataset.is_unmasked(pixels))


def _probe_of(dataset: RayDataset, pixels: Int[Tensor, "rays"], background: Float[Tensor, "3"]) -> Probe:
    rays, colour, alpha, view = dataset.lookup(pixels)
    return Probe(rays, over(colour, alpha, background), background, view)


@torch.no_grad()
def measure(model: RadianceModel, probe: Probe, effects: ImageEffects = NO_EFFECTS) -> ProbeResult:
    """Render the probe through ``effects`` and compare it with the photos.

    Raises ValueError where what it shows is no finite number.
    """
    shown, opacity = _shown(model, probe, effects)
    return ProbeResult(psnr(mean_squared_error(shown, probe.colours)), float(opacity.mean()))


@torch.no_grad()
def pictures(
    model: RadianceModel, patches: Patches, effects: ImageEffects = NO_EFFECTS
) -> tuple[Float[Tensor, "patches side side 3"], Float[Tensor, "patches side side 3"]]:
    """What the field shows of the patches, in [0, 1], and what the photos show."""
    shown, _ = _shown(model, patches.probe, effects)
    shape = (*patches.used.shape, 3)
    return shown.view(shape), patches.probe.colours.view(shape)


def _shown(
    model: RadianceModel, probe: Probe, effects: ImageEffects
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """What the field shows in the photos' place, in [0, 1] as they are, and its opacity. What is no finite number stays
    that."""
    one_row = effects.forward_rays(probe.rays, probe.view).each(lambda part: part[None])
    seen = Rendering(*(part[0] for part in render_image(model, one_row, probe.background)))
    rendered = RenderedRays(seen, probe.background, probe.rays, probe.view)
    shown = probe.colours + effects.residual(rendered, probe.colours)
    return torch.where(shown.isfinite(), shown.clamp(0, 1), shown), seen.opacity
