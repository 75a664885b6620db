"""A trained field as an image shows it: through the colour effects of that image."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.effects import ColourEffect, foreground_radiance
from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays


class AppearanceModel:
    """A RadianceModel that shows another one through colour ``effects`` of a single image. Its colours may exceed 1."""

    def __init__(self, model: RadianceModel, effects: tuple[ColourEffect, ...]) -> None:
        self.model, self.effects = model, effects
        self.chunk_rays = model.chunk_rays

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """The other model's."""
        return self.model.density(points)

    def density_and_colour(
        self, points: Float[Tensor, "*points 3"], directions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points 3"]]:
        """The other model's density, and its colour as shown along ``directions``."""
        density, colour = self.model.density_and_colour(points, directions)
        none = torch.zeros_like(density)
        return density, self._shown(colour, Rays(points, directions, none, none))

    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """The other model's rendering as shown; the background stays as it is."""
        rendering = self.model.render(rays, background)
        radiance = foreground_radiance(rendering.colour, rendering.opacity, background)
        # Not shown(radiance) + the rest: an effect of nothing is to change no bit.
        return rendering._replace(colour=rendering.colour + (self._shown(radiance, rays) - radiance))

    def _shown(self, colour: Float[Tensor, "*rays 3"], rays: Rays) -> Float[Tensor, "*rays 3"]:
        flat, along = colour.reshape(-1, 3), rays.each(lambda part: part.flatten(0, rays.near.ndim - 1))
        view = torch.zeros(len(flat), dtype=torch.int64, device=colour.device)
        for effect in self.effects:
            flat = effect.forward(flat, along, view)
        return flat.view_as(colour)
