"""The hierarchical NeRF as published (Mildenhall et al. 2020): two MLPs, the coarse one placing the fine one's samples.

Named deviations, each with its reason:

* density through a shifted softplus unless ``density_activation="relu"``: ReLU has no gradient wherever the network
  answers below zero, and now and then a whole network starts, and stays, there;
* each second-stage sample is drawn from its own share of the probability (nerf/rendering/sampling.py) and the last
  interval ends at far: no sample is wasted, no length is made up;
* ``space`` says how the scene is encoded (nerf/geometry/space_maps); what is not contracted is cut to the cube of
  half size ``BOX``, because the encoding has period 2 and would repeat the scene beyond it; directions are scaled by
  ``DIRECTION_SCALE`` before they are encoded, for the same reason.
"""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf.fields.interface import Rendering
from nerf.fields.positional_encoding import positional_encoding
from nerf.geometry.rays import Rays, clip_to_box, points_on
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.mapped_rays import MappedRays
from nerf.geometry.space_maps.ndc import Ndc
from nerf.rendering.sampling import Spacing, midpoint_edges, sample_pdf, stratified
from nerf.rendering.volume_rendering import composite, volume_weights
from nerf.runtime.profiler import WorkCounts, span
from nerf.runtime.randomness import generator

BOX = 0.95  # between the region of interest, 0.9, and half the encoding's period, 1
CONTRACTED_SCALE = 0.45  # takes the contracted cube of half size 2 to 0.9
DIRECTION_SCALE = 0.9  # keeps +z and -z apart, which are one and the same to the encoding

# A fresh network answers about 0, and this density stops half the light over sqrt(2 · 10) scene units: rays inside the
# region of interest (length 2) start at opacity 0.27, long ones (10) at 0.79, so that both see gradients.
INITIAL_DENSITY = math.log(2) / math.sqrt(2 * 10)
SOFTPLUS_SHIFT = math.log(math.expm1(INITIAL_DENSITY))


def shifted_softplus(raw: Float[Tensor, "*points"]) -> Float[Tensor, "*points"]:
    """log(1 + exp(raw + SOFTPLUS_SHIFT)): INITIAL_DENSITY at 0, with a gradient everywhere."""
    # Beyond the threshold torch returns its argument; at 40 the difference is below float64's resolution.
    return functional.softplus(raw + SOFTPLUS_SHIFT, threshold=40)


MAX_SIZE = 10_000  # of any size of these networks: far beyond any use, and no loop over it is endless


@dataclass(frozen=True)
class VanillaSettings:
    """Sizes and variants; the defaults are the published model. Raises ValueError on impossible values.

    ``skip``: index from 0 of the layer after which gamma(x) is concatenated (the published fifth layer has index 4);
    where no layer follows it there is no skip connection. ``positional_encoding=False`` feeds the bare position and
    direction. ``hierarchical=False`` is a single network with as many queries per ray as the two have together.
    """

    depth: int = 8
    width: int = 256
    skip: int = 4
    position_frequencies: int = 10
    direction_frequencies: int = 4
    samples_coarse: int = 64
    samples_fine: int = 128
    view_dependence: bool = True
    positional_encoding: bool = True
    hierarchical: bool = True
    space: SpaceMap = field(default_factory=Box)
    spacing: Spacing = "linear"
    density_activation: Literal["softplus", "relu"] = "softplus"

    def __post_init__(self) -> None:
        at_least = {"depth": 1, "width": 2, "skip": 0, "position_frequencies": 1, "direction_frequencies": 1}
        for name, minimum in (at_least | {"samples_coarse": 2, "samples_fine": 1}).items():
            if getattr(self, name) < minimum:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {minimum}")
            if getattr(self, name) > MAX_SIZE:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at most {MAX_SIZE}")
        if self.spacing not in get_args(Spacing):
            raise ValueError(f"spacing is {self.spacing!r}; it must be 'linear' or 'log'")
        if self.spacing == "log" and isinstance(self.space, Ndc):
            raise ValueError("spacing is 'log'; in normalised device coordinates it must be 'linear'")
        if self.density_activation not in ("softplus", "relu"):
            raise ValueError(f"density_activation is {self.density_activation!r}; it must be 'softplus' or 'relu'")

    @property
    def queries_per_ray(self) -> int:
        """Evaluations of a network per ray: the coarse samples, and their union with the fine ones."""
        return self.samples_coarse + (self.samples_coarse + self.samples_fine)


class VanillaMlp(nn.Module):
    """F_theta: (position, direction) -> (density, colour), density independent of direction (figure 7)."""

    def __init__(self, settings: VanillaSettings, init: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        width = settings.width
        position = 6 * settings.position_frequencies if settings.positional_encoding else 3
        direction = 6 * settings.direction_frequencies if settings.positional_encoding else 3
        inputs = [position] + [width] * (settings.depth - 1)
        if settings.skip + 1 < settings.depth:
            inputs[settings.skip + 1] += position
        self.trunk = nn.ModuleList(_linear(size, width, init) for size in inputs)
        self.density_head = _linear(width, 1, init)
        self.feature = _linear(width, width, init)
        self.colour_hidden = _linear(width + direction * settings.view_dependence, width // 2, init)
        self.colour_head = _linear(width // 2, 3, init)
        once_per_ray = (width // 2) * direction * settings.view_dependence
        of_encoding = position * width * (2 if settings.skip + 1 < settings.depth else 1)
        # Multiplications and additions per point, forward and back. On the way back each weight has its own gradient,
        # and passes on that of its input unless that is an encoding.
        self.matmul_flops = 2 * (sum(each.numel() for each in self.parameters() if each.ndim == 2) - once_per_ray)
        self.matmul_flops_backward = 2 * self.matmul_flops - 2 * of_encoding

    def forward(
        self, points: Float[Tensor, "*rays n 3"], directions: Float[Tensor, "*rays 3"]
    ) -> tuple[Float[Tensor, "*rays n"], Float[Tensor, "*rays n 3"]]:
        """Density and colour of n points on each ray; points lie in (-1, 1)^3."""
        with span("mlp", WorkCounts(matmul_flops=self.matmul_flops * points[..., 0].numel())):
            hidden = self._hidden(points)
            feature = self.feature(hidden)
            if self.settings.view_dependence:
                encoded = self._encode(DIRECTION_SCALE * directions, self.settings.direction_frequencies)
                colour = _linear_of_parts(self.colour_hidden, feature, encoded[..., None, :])
            else:
                colour = self.colour_hidden(feature)
            return self._sigma(hidden), torch.sigmoid(self.colour_head(torch.relu(colour)))

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Density alone, without the work for colour."""
        return self._sigma(self._hidden(points))

    def _hidden(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points width"]:
        # Flat, because relu_ on a layer's output of more dimensions, a view, costs two copies on the way back.
        encoded = self._encode(points.reshape(-1, 3), self.settings.position_frequencies)
        hidden = encoded
        for index, layer in enumerate(self.trunk):
            assert isinstance(layer, nn.Linear)  # a ModuleList forgets its element type
            after_skip = index == self.settings.skip + 1
            hidden = torch.relu_(_linear_of_parts(layer, hidden, encoded) if after_skip else layer(hidden))
        return hidden.reshape(*points.shape[:-1], self.settings.width)

    def _sigma(self, hidden: Float[Tensor, "*points width"]) -> Float[Tensor, "*points"]:
        raw = self.density_head(hidden)[..., 0]
        if self.settings.density_activation == "relu":
            return torch.relu(raw)
        return shifted_softplus(raw)

    def _encode(self, x: Float[Tensor, "*batch 3"], frequencies: int) -> Float[Tensor, "*batch encoded"]:
        dtype = self.density_head.weight.dtype
        with span("encode"):
            return positional_encoding(x, frequencies, dtype) if self.settings.positional_encoding else x.to(dtype)


class VanillaNerf(nn.Module):
    """A RadianceModel in the scene frame; weights are a function of ``settings`` and ``seed``."""

    chunk_rays = 512

    def __init__(self, settings: VanillaSettings, seed: int) -> None:
        super().__init__()
        self.settings, self.space = settings, settings.space
        self.coarse = VanillaMlp(settings, generator("cpu", seed, 0)) if settings.hierarchical else None
        self.fine = VanillaMlp(settings, generator("cpu", seed, 1))

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Density per scene unit; zero outside the cube to which an uncontracted field is cut."""
        mapped = self.space.forward(points)
        return self._cut(mapped, self.fine.density(self._encoded(mapped)))

    def density_and_colour(
        self, points: Float[Tensor, "*points 3"], directions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points 3"]]:
        """What :meth:`density` says, and the colour seen by viewing rays of unit ``directions``."""
        mapped = self.space.forward(points)
        sigma, colour = self.fine(self._encoded(mapped)[..., None, :], directions)
        return self._cut(mapped, sigma[..., 0]), colour[..., 0, :]

    @torch.no_grad()
    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """Render without randomness and without gradient; the coarse network answers for density only."""
        mapped = self._in_field(rays)
        t = self._first_samples(mapped.rays, None)
        if self.coarse is not None:
            sigma = self.coarse.density(self._on_rays(mapped.rays, t[..., :-1]))
            t = self._refined(mapped.rays, t, volume_weights(sigma, mapped.to_scene(t))[0], None)
        return self._seen(self.fine, rays, mapped, t, background)[0]

    def render_training(
        self, rays: Rays, background: Float[Tensor, "*#rays 3"], generator: torch.Generator | None
    ) -> tuple[Rendering, Rendering]:
        """The coarse and the fine rendering, both differentiable; one and the same if not ``hierarchical``."""
        mapped = self._in_field(rays)
        t = self._first_samples(mapped.rays, generator)
        if self.coarse is None:
            only, _ = self._seen(self.fine, rays, mapped, t, background)
            return only, only
        coarse, weights = self._seen(self.coarse, rays, mapped, t, background)
        t = self._refined(mapped.rays, t, weights, generator)
        fine, _ = self._seen(self.fine, rays, mapped, t, background)
        return coarse, fine

    def _in_field(self, rays: Rays) -> MappedRays:
        """In float64, as are the points and sums on the rays: 2⁹π, the highest frequency, takes the rounding of a
        float32 point to 1e-4. The networks compute in the type of their weights."""
        with span("sampling"):
            mapped = self.space.map_rays(rays.each(Tensor.double))
            return mapped if self.space.bends_rays else mapped._replace(rays=clip_to_box(mapped.rays, -BOX, BOX))

    def _cut(self, mapped: Float[Tensor, "*points 3"], sigma: Float[Tensor, "*points"]) -> Float[Tensor, "*points"]:
        return sigma if self.space.bends_rays else torch.where((mapped.abs() <= BOX).all(-1), sigma, 0)

    def _encoded(self, mapped: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """What is encoded of mapped points: within (-1, 1)."""
        return CONTRACTED_SCALE * mapped if self.space.bends_rays else mapped

    def _on_rays(self, rays: Rays, t: Float[Tensor, "*rays n"]) -> Float[Tensor, "*rays n 3"]:
        """What is encoded of points on mapped rays."""
        points = points_on(rays, t)
        return self._encoded(self.space.forward(points) if self.space.bends_rays else points)

    def _first_samples(self, rays: Rays, generator: torch.Generator | None) -> Float[Tensor, "*rays ends"]:
        settings = self.settings
        count = settings.samples_coarse if settings.hierarchical else settings.queries_per_ray
        with span("sampling"):
            return stratified(rays.near, rays.far, count, generator, settings.spacing)

    def _refined(
        self,
        rays: Rays,
        t: Float[Tensor, "*rays ends"],
        weights: Float[Tensor, "*rays ends-1"],
        generator: torch.Generator | None,
    ) -> Float[Tensor, "*rays more"]:
        """The sorted union of the samples and those drawn from their weights (section 5.2); far stays last."""
        with span("sampling"):
            drawn = sample_pdf(midpoint_edges(t, rays.near), weights, self.settings.samples_fine, generator)
            return torch.sort(torch.cat([t, drawn], -1)).values

    def _seen(
        self,
        mlp: VanillaMlp,
        rays: Rays,
        mapped: MappedRays,
        t: Float[Tensor, "*rays ends"],
        background: Float[Tensor, "*#rays 3"],
    ) -> tuple[Rendering, Float[Tensor, "*rays ends-1"]]:
        with span("sampling"):
            points = self._on_rays(mapped.rays, t[..., :-1])
        sigma, colour = mlp(points, rays.directions.double())
        with span("composite"):
            rendering, weights = composite(sigma, colour, mapped.to_scene(t), background)
            return Rendering(*(each.to(background.dtype) for each in rendering)), weights


def _linear(inputs: int, outputs: int, init: torch.Generator) -> nn.Linear:
    """A layer with Glorot-uniform weights and zero bias, as in the published code, drawn from ``init`` alone."""
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
    nn.init.xavier_uniform_(layer.weight, generator=init)
    nn.init.zeros_(layer.bias)
    return layer


def _linear_of_parts(
    layer: nn.Linear, first: Float[Tensor, "*#points a"], second: Float[Tensor, "*#points b"]
) -> Float[Tensor, "*points c"]:
    """layer(cat([first, second], -1)) without the copy; ``second`` may be one per ray where ``first`` is per point."""
    split = first.shape[-1]
    weight = layer.weight
    return functional.linear(first, weight[:, :split], layer.bias) + functional.linear(second, weight[:, split:])
