"""A radiance field of feature grids and two tiny networks (Müller et al. 2022), with empty space left out.

The density cache plays the coarse network's part in the hierarchical NeRF: it places the samples. Its bits mark the
cells that may hold something, rays are sampled in these alone, and the density found there decides how far along a
ray colour is asked for at all.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from nerf.fields import mlp as grid_mlp
from nerf.fields.background import background_backward, background_colour, directions_backward, initial_background
from nerf.fields.interface import Rendering
from nerf.fields.mlp import ColourPass, DensityPass, Weights
from nerf.geometry.rays import Rays
from nerf.kernels import BOX, Backend, GridLayout, Lattice, Occupied, Samples, grid_layout
from nerf.kernels.torch.marching import unit_coordinates
from nerf.kernels.torch.occupancy import cell_numbers, is_occupied, occupied
from nerf.rendering.early_termination import EARLY_STOP_TRANSMITTANCE, Wave, march_with_early_termination
from nerf.runtime.profiler import Work, part
from nerf.runtime.randomness import generator

INITIAL_FEATURE = 1e-4
# Far beyond any use: no loop over them is endless, and indices stay within 32 bits.
LARGEST = {"levels": 64, "features": 256, "log2_rows": 30, "finest": 2**20, "occupancy_resolution": 1024} | {
    "steps": 10**6,
    "most_samples": 10**6,
}
DRAWN_CLOSER = 1.5  # samples of a drawn ray for one in training (docs/experiments/ray_samples.md)
# Optical thickness below which a sample of training stands for others like it (docs/experiments/ray_samples.md).
THIN = 1e-2
# Share of a ray's light that a picture may show in a neighbouring sample's colour (docs/experiments/colour_samples.md).
QUANTUM = 1 / 512
CORNERS = 8  # of a cell: rows that a point reads of each grid


@dataclass(frozen=True)
class HashGridSettings:
    """Sizes of a grid field. Raises ValueError on impossible ones.

    ``steps``: lattice steps along the diagonal of a bounded scene's box. ``shortest_step`` (scene units) and ``cone``
    (step per distance) replace it where space is ``contracted``. Without ``view_dependence`` a point has one colour.
    ``sky``: a colour for each direction lies behind everything (nerf/fields/background.py), whatever else is given as a
    background.
    """

    levels: int = 5
    features: int = 4
    log2_rows: int = 18
    coarsest: int = 16
    finest: int = 384
    contracted: bool = False
    steps: int = 384
    shortest_step: float = 0.002
    cone: float = 0.008
    most_samples: int = 1024
    occupancy_resolution: int = 128
    view_dependence: bool = True
    sky: bool = False

    def __post_init__(self) -> None:
        at_least = {"levels": 1, "features": 1, "log2_rows": 1, "coarsest": 1, "steps": 1, "most_samples": 1}
        for name, least in (at_least | {"finest": self.coarsest, "occupancy_resolution": 4}).items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        for name, most in LARGEST.items():
            if getattr(self, name) > most:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at most {most}")
        if self.occupancy_resolution % 4:
            raise ValueError(f"occupancy_resolution is {self.occupancy_resolution}; it must be a multiple of 4")
        if not (0 < self.shortest_step < math.inf and 0 < self.cone < math.inf):
            raise ValueError(f"shortest_step ({self.shortest_step}) and cone ({self.cone}) must be positive numbers")

    @property
    def layout(self) -> GridLayout:
        """Of the feature table."""
        return grid_layout(self.levels, self.coarsest, self.finest, self.log2_rows, self.features)

    @property
    def lattice(self) -> Lattice:
        """Of the samples."""
        if self.contracted:
            return Lattice(self.shortest_step, self.cone, True, self.occupancy_resolution, self.most_samples)
        step = 2 * BOX * math.sqrt(3) / self.steps
        return Lattice(step, 0.0, False, self.occupancy_resolution, self.most_samples)

    @property
    def drawn_lattice(self) -> Lattice:
        """Of the samples of rays that are only drawn: ``DRAWN_CLOSER`` in folded space.

        Training jitters samples that stand a few finest cells apart, so that over many steps it meets what lies between
        them; a drawing stands at fixed places, once, and would show the gaps as shells. In a box they are closer.
        """
        lattice, closer = self.lattice, DRAWN_CLOSER if self.contracted else 1
        step, cone, most = lattice.step / closer, lattice.cone / closer, math.ceil(closer * lattice.most_samples)
        return lattice._replace(step=step, cone=cone, most_samples=most)


class HashGridPass(NamedTuple):
    """What a rendering computed on its way, for :meth:`HashGridField.backward`; ``marched`` counts all densities asked,
    ``thickness`` is of the samples' own intervals, not of what they stand for."""

    rays: Rays
    background: Float[Tensor, "rays 3"]
    marched: int
    samples: Samples
    points: Float[Tensor, "samples 3"]
    thickness: Float[Tensor, "samples"]
    density: DensityPass
    harmonics: Float[Tensor, "rays direction"]
    colour: ColourPass
    rendering: Rendering
    weights: Float[Tensor, "samples"]


class HashGridGradients(NamedTuple):
    """Of the networks and, by way of the samples' features, the rays' harmonics and the background, of whatever lies
    before them."""

    weights: Weights
    features: Float[Tensor, "samples width"]
    harmonics: Float[Tensor, "rays direction"]
    background: Float[Tensor, "rays 3"]


class HashGridField(nn.Module):
    """A RadianceModel in the scene frame; its parameters are a function of ``settings`` and ``seed``.

    Nothing here needs autograd: parameters are buffers, and gradients are computed by :meth:`backward`.
    """

    chunk_rays = 16384

    table: Tensor
    bits: Tensor
    clearance: Tensor
    density_hidden: Tensor
    density_out: Tensor
    colour_hidden: Tensor
    colour_out: Tensor
    sky: Tensor

    def __init__(self, settings: HashGridSettings, seed: int, backend: Backend) -> None:
        super().__init__()
        self.settings, self.backend = settings, backend
        self.layout, self.lattice, self.drawn_lattice = settings.layout, settings.lattice, settings.drawn_lattice
        random = generator("cpu", seed, 0)
        shape = (self.layout.rows, settings.features)
        self.register_buffer("table", (2 * torch.rand(shape, generator=random) - 1) * INITIAL_FEATURE)
        self.of_directions, self.of_directions_backward = (
            (backend.spherical_harmonics, backend.spherical_harmonics_backward)
            if settings.view_dependence
            else (grid_mlp.no_directions, grid_mlp.no_directions_backward)
        )
        direction = grid_mlp.DIRECTION if settings.view_dependence else 0
        for name, weight in grid_mlp.initial_weights(self.layout.width, direction, random)._asdict().items():
            self.register_buffer(name, weight)
        if settings.sky:
            self.register_buffer("sky", initial_background())
        self.register_buffer(
            "bits", torch.full((settings.occupancy_resolution**3 // 64,), -1)
        )  # every cell may hold something
        self.register_buffer("clearance", torch.zeros(settings.occupancy_resolution**3 // 64, dtype=torch.uint8))

    def on_cpu(self) -> "HashGridField":
        """This field, or on a GPU its like in the CPU's memory."""
        if self.table.device.type == "cpu":
            return self
        like = HashGridField(self.settings, 0, self.backend)
        like.load_state_dict(self.state_dict())
        return like

    @property
    def weights(self) -> Weights:
        """The networks."""
        return Weights(self.density_hidden, self.density_out, self.colour_hidden, self.colour_out)

    def occupy(self, bits: Int64[Tensor, "bricks"]) -> None:
        """From now on sample these cells alone (``nerf.kernels.torch.occupancy``)."""
        self.bits.copy_(bits)
        self.clearance.copy_(occupied(bits).clearance)

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Density per scene unit; zero in cells that are not sampled, and outside the box of a bounded scene."""
        unit, sampled = self._located(points)
        sigma = unit.new_zeros(len(unit))
        sigma[sampled] = self.unit_density(unit[sampled])
        return sigma.view(points.shape[:-1])

    def unit_density(self, unit: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Density per scene unit at unit coordinates."""
        return self._density_pass(unit.clamp(0, 1)).sigma

    def density_and_colour(
        self, points: Float[Tensor, "*points 3"], directions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points 3"]]:
        """What :meth:`density` says, and the colour seen by viewing rays of unit ``directions``."""
        unit, sampled = self._located(points)
        density = self._density_pass(unit.clamp(0, 1))
        of_rays = grid_mlp.ray_hidden(self.weights, self.of_directions(directions.reshape(-1, 3).contiguous()))
        each = torch.arange(len(unit), dtype=torch.int32, device=unit.device)  # a ray of its own for every point
        colour = grid_mlp.colour_of(self.weights, each, density.geometry, of_rays)
        return torch.where(sampled, density.sigma, 0).view(points.shape[:-1]), colour.view(points.shape)

    def _located(self, points: Float[Tensor, "*points 3"]) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """Unit coordinates of points, and which of them lie in cells that are sampled and in a bounded scene's box."""
        unit = unit_coordinates(points, self.settings.contracted).reshape(-1, 3)
        sampled = is_occupied(self.bits, cell_numbers(self.settings.occupancy_resolution, unit))
        if not self.settings.contracted:
            sampled &= (points.reshape(-1, 3).abs() <= BOX).all(-1)
        return unit, sampled

    @torch.no_grad()
    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """Render without randomness: samples stand in the middle of their intervals.

        From front to back in waves of a few samples per ray, so that little is computed behind what stops a ray's
        light, and of each wave only the colours that stand for all (``nerf.kernels.torch.colour_sampling``). What is
        stopped behind the last of them on a ray, less than a quantum, has the colour of the rest.
        """
        rays, backend = rays.each(Tensor.contiguous), self.backend
        seen, shown = rays.far.new_zeros(len(rays.far), 4), torch.zeros_like(rays.far)
        depth = torch.zeros_like(rays.far, dtype=torch.float64)
        of_rays = grid_mlp.ray_hidden(self.weights, self.of_directions(rays.directions))
        for wave in self._waves(rays, torch.full_like(rays.near, 0.5), self.drawn_lattice):
            with part("composite"):
                drawn = backend.select_colour_samples(wave.samples, wave.density.sigma, QUANTUM, depth, shown)
                geometry = wave.density.geometry.index_select(0, drawn.rows)
            colour = grid_mlp.colour_of(self.weights, drawn.samples.ray, geometry, of_rays)
            with part("composite"):
                backend.accumulate_colours(drawn, colour, seen)
        light, opacity = (each.to(seen.dtype) for each in (torch.exp(-depth), -torch.expm1(-depth)))
        seen *= torch.where(shown == 0, 1, opacity / shown)[:, None]
        behind = self._behind(rays, background)
        return Rendering(seen[:, :3] + light[:, None] * behind, seen[:, 3] + light * rays.far, opacity)

    def forward(
        self,
        rays: Rays,
        jitter: Float[Tensor, "rays"],
        offset: Float[Tensor, "rays"],
        background: Float[Tensor, "rays 3"],
    ) -> HashGridPass:
        """Density of all samples in occupied cells; colour of those that can be seen, thin ones standing for others
        like them (``Backend.visible_samples``, which ``offset`` is for)."""
        backend, rays = self.backend, rays.each(Tensor.contiguous)
        background = self._behind(rays, background)
        waves = list(self._waves(rays, jitter, self.lattice))
        with part("march"):
            marched, order = backend.pack_rounds([wave.samples for wave in waves])
            sigma = torch.cat([wave.density.sigma for wave in waves]).index_select(0, order)
            samples, seen = backend.visible_samples(marched, sigma, EARLY_STOP_TRANSMITTANCE, THIN, offset)
            rows = order.index_select(0, seen)
            points = torch.cat([wave.points for wave in waves]).index_select(0, rows)
            of_waves = zip(*(wave.density for wave in waves), strict=True)
            density = DensityPass(*(torch.cat(parts).index_select(0, rows) for parts in of_waves))
            thickness = density.sigma * marched.dt.index_select(0, seen)
        with part("encode"):
            harmonics = self.of_directions(rays.directions)
            of_rays = grid_mlp.ray_hidden(self.weights, harmonics)
        colour = grid_mlp.colour_forward(self.weights, backend, samples, density.geometry, of_rays)
        with part("composite"):
            rendering, weights = backend.composite(samples, density.sigma, colour.colour, background, rays.far)
        of_samples = samples, points, thickness, density
        return HashGridPass(rays, background, len(order), *of_samples, harmonics, colour, rendering, weights)

    def backward(
        self, done: HashGridPass, grad: Rendering, grad_weights: Float[Tensor, "samples"]
    ) -> HashGridGradients:
        """Gradients of a loss, given those of the rendering and of the samples' weights."""
        backend, density, colour = self.backend, done.density, done.colour
        grad_sigma, grad_colour = backend.composite_backward(
            done.samples, density.sigma, colour.colour, done.background, done.rays.far, grad, grad_weights
        )
        of_colour = grid_mlp.colour_backward(self.weights, backend, done.samples, colour, done.harmonics, grad_colour)
        of_density = grid_mlp.density_backward(self.weights, backend, density, grad_sigma, of_colour.geometry)
        weights = Weights(of_density.density_hidden, of_density.density_out, *of_colour[:2])
        of_background = (1 - done.rendering.opacity)[:, None] * grad.colour
        return HashGridGradients(weights, of_density.features, of_colour.harmonics, of_background)

    def rays_backward(
        self, done: HashGridPass, gradients: HashGridGradients
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Gradients of the rays' origins and directions, for refining poses."""
        backend, rays, samples = self.backend, done.rays, done.samples
        grad_points = backend.encode_backward_points(self.layout, self.table, done.points, gradients.features)
        grad_origins, grad_directions = backend.sample_points_backward(
            rays, samples, self.settings.contracted, grad_points
        )
        grad_directions = grad_directions + self.of_directions_backward(rays.directions, gradients.harmonics)
        if self.settings.sky:
            grad_directions += directions_backward(
                backend, self.sky, rays.directions, done.background, gradients.background
            )
        return grad_origins, grad_directions

    def background_backward(self, done: HashGridPass, gradients: HashGridGradients) -> Float[Tensor, "rows 4"]:
        """Gradient of the sky, for a field that has one."""
        return background_backward(self.backend, done.rays.directions, done.background, gradients.background)

    def _behind(self, rays: Rays, background: Float[Tensor, "*#rays 3"]) -> Float[Tensor, "*#rays 3"]:
        return background_colour(self.backend, self.sky, rays.directions) if self.settings.sky else background

    def _waves(self, rays: Rays, jitter: Float[Tensor, "rays"], lattice: Lattice) -> Iterator[Wave]:
        return march_with_early_termination(
            self.backend, Occupied(self.bits, self.clearance), lattice, self._density_pass, rays, jitter
        )

    def _density_pass(self, unit: Float[Tensor, "points 3"]) -> DensityPass:
        with part("gather", Work(rows=CORNERS * len(self.layout.resolutions) * len(unit))):
            features = self.backend.encode(self.layout, self.table, unit)
        return grid_mlp.density_forward(self.weights, features)
