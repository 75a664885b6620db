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
from nerf.training.psnr import mean_squared_error, psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import composite_over


class EvaluationPixels(NamedTuple):
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

    def to(self, device: torch.device | str) -> "EvaluationPixels":
        """The same on another device."""
        rays, *others = self
        return EvaluationPixels(rays.each(lambda part: part.to(device)), *(part.to(device) for part in others))


class PixelEvaluation(NamedTuple):
    """PSNR in dB and mean opacity of a field on evaluation pixels."""

    psnr: float
    opacity: float


class EvaluationPatches(NamedTuple):
    """Squares of photos: ``pixels`` has their pixels one patch after the other, row by row; ``used`` says which of them
    count."""

    pixels: EvaluationPixels
    used: Bool[Tensor, "patches side side"]

    def to(self, device: torch.device | str) -> "EvaluationPatches":
        """The same on another device."""
        return EvaluationPatches(self.pixels.to(device), self.used.to(device))


def sample_evaluation_pixels(
    dataset: RayDataset, count: int, background: Float[Tensor, "3"], seed: int
) -> EvaluationPixels:
    """Draw ``count`` pixels of ``dataset``, always the same for the same seed."""
    return _probe_of(dataset, dataset.sample_pixels(count, generator(dataset.device, seed)), background)


def sample_evaluation_patches(
    dataset: RayDataset, count: int, side: int, background: Float[Tensor, "3"], seed: int
) -> EvaluationPatches:
    """``count`` squares around random pixels of ``dataset``, moved to lie inside their photos; the same for the same
    seed. Their side is ``side`` pixels, less where a photo is smaller."""
    first, width = dataset.view_layout[:2]
    height = dataset.first_pixel.diff() // width
    side = min(side, int(width.min()), int(height.min()))
    pixel = dataset.sample_pixels(count, generator(dataset.device, seed, 1))
    view = torch.searchsorted(dataset.first_pixel, pixel, right=True) - 1
    first, width, height = (table.index_select(0, view) for table in (first, width, height))
    within = pixel - first
    top = (within // width - side // 2).clamp(min=0).minimum(height - side)
    left = (within % width - side // 2).clamp(min=0).minimum(width - side)
    steps = torch.arange(side, device=dataset.device)
    corner = first + top * width + left
    pixels = corner[:, None, None] + steps[:, None] * width[:, None, None] + steps
    return EvaluationPatches(_probe_of(dataset, pixels.flatten(), background), dataset.is_unmasked(pixels))


def _probe_of(dataset: RayDataset, pixels: Int[Tensor, "rays"], background: Float[Tensor, "3"]) -> EvaluationPixels:
    rays, colour, alpha, view = dataset.lookup(pixels)
    return EvaluationPixels(rays, composite_over(colour, alpha, background), background, view)


@torch.no_grad()
def evaluate(model: RadianceModel, pixels: EvaluationPixels, effects: ImageEffects = NO_EFFECTS) -> PixelEvaluation:
    """Render the probe through ``effects`` and compare it with the photos.

    Raises ValueError where what it shows is no finite number.
    """
    shown, opacity = _shown(model, pixels, effects)
    return PixelEvaluation(psnr(mean_squared_error(shown, pixels.colours)), float(opacity.mean()))


@torch.no_grad()
def render_patches(
    model: RadianceModel, patches: EvaluationPatches, effects: ImageEffects = NO_EFFECTS
) -> tuple[Float[Tensor, "patches side side 3"], Float[Tensor, "patches side side 3"]]:
    """What the field shows of the patches, in [0, 1], and what the photos show."""
    shown, _ = _shown(model, patches.pixels, effects)
    shape = (*patches.used.shape, 3)
    return shown.view(shape), patches.pixels.colours.view(shape)


def _shown(
    model: RadianceModel, pixels: EvaluationPixels, effects: ImageEffects
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """What the field shows in the photos' place, in [0, 1] as they are, and its opacity. What is no finite number stays
    that."""
    one_row = effects.forward_rays(pixels.rays, pixels.view).each(lambda part: part[None])
    seen = Rendering(*(part[0] for part in render_image(model, one_row, pixels.background)))
    rendered = RenderedRays(seen, pixels.background, pixels.rays, pixels.view)
    shown = pixels.colours + effects.residual(rendered, pixels.colours)
    return torch.where(shown.isfinite(), shown.clamp(0, 1), shown), seen.opacity
