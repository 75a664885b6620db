"""The hash-grid field: a multiresolution hash grid and two tiny MLPs (Müller et al. 2022), with empty space skipped.

The occupancy grid plays the coarse network's part in the hierarchical NeRF: it places the samples. Rays are sampled in
its occupied cells alone, and the density found there decides how far along a ray colours are evaluated at all.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor, nn

from nerf.fields import mlp
from nerf.fields.background import background_backward, background_colour, directions_backward, initial_background
from nerf.fields.interface import Rendering
from nerf.fields.mlp import ColourPass, DensityPass, Weights
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.mapped_rays import MappedRays
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels import Backend, BinaryOccupancy, GridLayout, RayStepping, Samples, grid_layout
from nerf.kernels.torch.occupancy import binary_occupancy, cell_numbers, is_occupied
from nerf.rendering.early_termination import (
    EARLY_STOP_TRANSMITTANCE,
    MarchingRound,
    RoundSize,
    march_with_early_termination,
)
from nerf.runtime.profiler import WorkCounts, span
from nerf.runtime.randomness import generator

INITIAL_FEATURE = 1e-4
# Far beyond any use: no loop over them is endless, and indices stay within 32 bits.
MAX_SIZES = {
    "num_levels": 64,
    "features_per_level": 256,
    "log2_hashmap_size": 30,
    "max_res": 2**20,
    "occupancy_resolution": 1024,
    "diagonal_steps": 10**6,
    "max_samples_per_ray": 10**6,
}
RENDER_SAMPLE_RATIO = 1.5  # samples of a rendered ray for one in training (docs/experiments/ray_samples.md)
# Optical thickness below which training keeps a sample with a probability only (docs/experiments/ray_samples.md).
THINNING_THRESHOLD = 1e-2
# Opacity that takes the colour of a neighbouring sample when an image is rendered (docs/experiments/colour_samples.md)
OPACITY_STEP = 1 / 512
CORNERS = 8  # of a cell: rows that a point reads of each grid


@dataclass(frozen=True)
class HashGridSettings:
    """Sizes of a hash-grid field. Raises ValueError on impossible ones.

    ``space``: how the scene fills the cube of the grids. ``diagonal_steps``: steps along that cube's diagonal.
    ``min_step_size`` (scene units) and ``cone_angle`` (step per distance) replace it where space is contracted. Without
    ``view_dependence`` a point has one colour. ``background_model``: a colour for each direction lies behind everything
    (nerf/fields/background.py), whatever else is given as a background.
    """

    num_levels: int = 5
    features_per_level: int = 4
    log2_hashmap_size: int = 18
    base_res: int = 16
    max_res: int = 384
    space: SpaceMap = field(default_factory=Box)
    diagonal_steps: int = 384
    min_step_size: float = 0.002
    cone_angle: float = 0.008
    max_samples_per_ray: int = 1024
    occupancy_resolution: int = 128
    view_dependence: bool = True
    background_model: bool = False

    def __post_init__(self) -> None:
        at_least = {
            "num_levels": 1,
            "features_per_level": 1,
            "log2_hashmap_size": 1,
            "base_res": 1,
            "diagonal_steps": 1,
            "max_samples_per_ray": 1,
        }
        for name, minimum in (at_least | {"max_res": self.base_res, "occupancy_resolution": 4}).items():
            if getattr(self, name) < minimum:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {minimum}")
        for name, maximum in MAX_SIZES.items():
            if getattr(self, name) > maximum:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at most {maximum}")
        if self.occupancy_resolution % 4:
            raise ValueError(f"occupancy_resolution is {self.occupancy_resolution}; it must be a multiple of 4")
        if not (0 < self.min_step_size < math.inf and 0 < self.cone_angle < math.inf):
            raise ValueError(
                f"min_step_size ({self.min_step_size}) and cone_angle ({self.cone_angle}) must be positive numbers"
            )

    @property
    def layout(self) -> GridLayout:
        """Of the feature table."""
        return grid_layout(
            self.num_levels, self.base_res, self.max_res, self.log2_hashmap_size, self.features_per_level
        )

    @property
    def stepping(self) -> RayStepping:
        """Of the samples."""
        if self.space.bends_rays:
            return RayStepping(
                self.min_step_size, self.cone_angle, True, self.occupancy_resolution, self.max_samples_per_ray
            )
        step = 2 * self.space.half * math.sqrt(3) / self.diagonal_steps
        return RayStepping(step, 0.0, False, self.occupancy_resolution, self.max_samples_per_ray)

    @property
    def render_stepping(self) -> RayStepping:
        """Of the samples of rays that are rendered without training: RENDER_SAMPLE_RATIO times as many if unbounded.

        Training jitters samples that stand a few finest cells apart, so that over many steps it meets what lies between
        them; a rendering samples fixed places, once, and would show the gaps as shells. In a box samples are closer.
        """
        stepping, closer = self.stepping, RENDER_SAMPLE_RATIO if self.space.unbounded else 1
        return stepping._replace(
            step_size=stepping.step_size / closer,
            cone_angle=stepping.cone_angle / closer,
            max_samples=math.ceil(closer * stepping.max_samples),
        )


class SampleCapacities(NamedTuple):
    """Of each round of marching, and of the visible samples (a ``capacity`` of nerf/kernels): given these, the host
    need not wait for a GPU to count samples."""

    rounds: tuple[RoundSize, ...]
    visible: int


class HashGridPass(NamedTuple):
    """What a rendering computed on its way, for :meth:`HashGridField.backward`. ``capacities`` are those that it was
    given, or just needed; ``fits``: whether they sufficed. ``density_evaluations``: how many points the density was
    evaluated at. ``optical_thickness`` is that of the samples' own intervals, before thinning. ``samples`` stand at
    distances along the ``mapped`` rays, for lengths in the scene, and ``in_scene`` at their distances there."""

    rays: Rays
    mapped: MappedRays
    background: Float[Tensor, "rays 3"]
    capacities: SampleCapacities
    density_evaluations: Int32[Tensor, ""]
    fits: Bool[Tensor, ""]
    samples: Samples
    in_scene: Samples
    points: Float[Tensor, "samples 3"]
    optical_thickness: Float[Tensor, "samples"]
    density: DensityPass
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
    occupancy_bits: Tensor
    empty_distance: Tensor
    density_hidden: Tensor
    density_out: Tensor
    colour_hidden: Tensor
    colour_out: Tensor
    background_table: Tensor

    def __init__(self, settings: HashGridSettings, seed: int, backend: Backend) -> None:
        super().__init__()
        self.settings, self.space, self.backend = settings, settings.space, backend
        self.layout, self.stepping, self.render_stepping = settings.layout, settings.stepping, settings.render_stepping
        random = generator("cpu", seed, 0)
        shape = (self.layout.rows, settings.features_per_level)
        self.register_buffer("table", (2 * torch.rand(shape, generator=random) - 1) * INITIAL_FEATURE)
        self.encode_directions, self.encode_directions_backward = (
            (backend.spherical_harmonics, backend.spherical_harmonics_backward)
            if settings.view_dependence
            else (mlp.no_directions, mlp.no_directions_backward)
        )
        direction = mlp.DIRECTION_FEATURES if settings.view_dependence else 0
        for name, weight in mlp.initial_weights(self.layout.width, direction, random)._asdict().items():
            self.register_buffer(name, weight)
        if settings.background_model:
            self.register_buffer("background_table", initial_background())
        self.register_buffer(
            "occupancy_bits", torch.full((settings.occupancy_resolution**3 // 64,), -1)
        )  # every cell may hold something
        self.register_buffer("empty_distance", torch.zeros(settings.occupancy_resolution**3 // 64, dtype=torch.uint8))

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

    def set_occupancy(self, bits: Int64[Tensor, "bricks"]) -> None:
        """From now on sample these cells alone; a bit each (``nerf.kernels.torch.occupancy``)."""
        self.occupancy_bits.copy_(bits)
        self.empty_distance.copy_(binary_occupancy(bits).empty_distance)

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Density per scene unit; zero in cells that are not sampled, and outside the cube."""
        unit, sampled = self._to_unit(points)
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
        unit, sampled = self._to_unit(points)
        density = self._density_pass(unit.clamp(0, 1))
        ray_hidden = mlp.direction_hidden(self.weights, self.encode_directions(directions.reshape(-1, 3).contiguous()))
        each = torch.arange(len(unit), dtype=torch.int32, device=unit.device)  # a ray of its own for every point
        colour = mlp.colour_forward(self.weights, self.backend, each, density.geometry_features, ray_hidden)
        return torch.where(sampled, density.sigma, 0).view(points.shape[:-1]), colour.view(points.shape)

    def _to_unit(self, points: Float[Tensor, "*points 3"]) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """Unit coordinates of points, and which of them lie in cells that are sampled."""
        mapped, half = self.space.forward(points).reshape(-1, 3), self.space.half
        unit = (mapped + half) / (2 * half)
        sampled = is_occupied(self.occupancy_bits, cell_numbers(self.settings.occupancy_resolution, unit))
        return unit, sampled & (mapped.abs() <= half).all(-1)

    @torch.no_grad()
    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """Render without randomness: samples stand in the middle of their intervals.

        Rays are marched in rounds of a few samples, so that little is computed behind opaque surfaces. Of each round
        only selected samples have their colour evaluated (``nerf.kernels.torch.colour_sampling``); the opacity behind
        the last of them on a ray, less than OPACITY_STEP, takes the colour of the rest.
        """
        rays, backend = rays.each(Tensor.contiguous), self.backend
        rendered, accumulated = rays.far.new_zeros(len(rays.far), 4), torch.zeros_like(rays.far)
        depth = torch.zeros_like(rays.far, dtype=torch.float64)
        ray_hidden = mlp.direction_hidden(self.weights, self.encode_directions(rays.directions))
        mapped = self.space.map_rays(rays)
        for _, samples, _, density in self._march(mapped, torch.full_like(rays.near, 0.5), self.render_stepping):
            with span("composite"):
                samples = _in_scene(mapped, samples)
                selected = backend.select_colour_samples(samples, density.sigma, OPACITY_STEP, depth, accumulated)
                geometry_features = backend.gather_rows(density.geometry_features, selected.rows)
            colour = mlp.colour_forward(self.weights, backend, selected.samples.ray, geometry_features, ray_hidden)
            with span("composite"):
                backend.accumulate_colours(selected, colour, rendered)
        transmittance, opacity = (each.to(rendered.dtype) for each in (torch.exp(-depth), -torch.expm1(-depth)))
        rendered *= torch.where(accumulated == 0, 1, opacity / accumulated)[:, None]
        colour = rendered[:, :3] + transmittance[:, None] * self._background_of(rays, background)
        return Rendering(colour, rendered[:, 3] + transmittance * rays.far, opacity)

    def forward(
        self,
        rays: Rays,
        jitter: Float[Tensor, "rays"],
        thinning_offset: Float[Tensor, "rays"],
        background: Float[Tensor, "rays 3"],
        capacities: SampleCapacities | None = None,
    ) -> HashGridPass:
        """Density of all samples in occupied cells; colour of the visible ones, thinned by ``thinning_offset``
        (``Backend.visible_samples``). With ``capacities`` arrays of samples have these lengths, with padding at their
        end (nerf/kernels)."""
        backend, rays = self.backend, rays.each(Tensor.contiguous)
        background, mapped = self._background_of(rays, background), self.space.map_rays(rays)
        rounds = list(self._march(mapped, jitter, self.stepping, capacities and capacities.rounds))
        with span("march"):
            marched, order = backend.pack_rounds([each.samples for each in rounds])
            sigma = torch.cat([each.density.sigma for each in rounds]).index_select(0, order)
            samples, seen = backend.visible_samples(
                marched,
                sigma,
                EARLY_STOP_TRANSMITTANCE,
                THINNING_THRESHOLD,
                thinning_offset,
                capacity=capacities and capacities.visible,
            )
            rows = order.index_select(0, seen)
            points = torch.cat([each.points for each in rounds]).index_select(0, rows)
            features, geometry_features = (
                backend.gather_rows(torch.cat(of_rounds), rows)
                for of_rounds in zip(*(each.density[:2] for each in rounds), strict=True)
            )
            density = DensityPass(features, geometry_features, sigma.index_select(0, seen))
            optical_thickness = density.sigma * marched.dt.index_select(0, seen)
        with span("encode"):
            harmonics = self.encode_directions(rays.directions)
            ray_hidden = mlp.direction_hidden(self.weights, harmonics)
        colour = mlp.colour_forward(self.weights, backend, samples.ray, density.geometry_features, ray_hidden)
        with span("composite"):
            in_scene = _in_scene(mapped, samples)
            rendering, weights = backend.composite(in_scene, density.sigma, colour, background, rays.far)
        needed = SampleCapacities(tuple(RoundSize(each.per_ray, len(each.points)) for each in rounds), len(points))
        fits = jitter.new_ones((), dtype=torch.bool) if capacities is None else self._fits(rounds, samples)
        of_samples = samples, in_scene, points, optical_thickness, density
        counted = needed, marched.starts[-1], fits
        of_colour = ColourPass(harmonics, ray_hidden, colour)
        return HashGridPass(rays, mapped, background, *counted, *of_samples, of_colour, rendering, weights)

    def _fits(self, rounds: Sequence[MarchingRound], visible: Samples) -> Bool[Tensor, ""]:
        """Whether no array of samples is full, and no ray goes on behind the last round."""
        not_full = [each.starts[-1] < len(each.t) for each in (*(one.samples for one in rounds), visible)]
        if sum(each.per_ray for each in rounds) < self.stepping.max_samples:
            not_full.append((rounds[-1].samples.starts.diff() < rounds[-1].per_ray).all())
        return torch.stack(not_full).all()

    def backward(
        self, forward_pass: HashGridPass, grad: Rendering, grad_weights: Float[Tensor, "samples"]
    ) -> HashGridGradients:
        """Gradients of a loss, given those of the rendering and of the samples' weights."""
        backend, density, colour = self.backend, forward_pass.density, forward_pass.colour
        grad_sigma, grad_colour = backend.composite_backward(
            forward_pass.in_scene,
            density.sigma,
            colour.colour,
            forward_pass.background,
            forward_pass.rays.far,
            grad,
            grad_weights,
        )
        of_colour = mlp.colour_backward(
            self.weights, backend, forward_pass.samples, density.geometry_features, colour, grad_colour
        )
        of_density = mlp.density_backward(self.weights, backend, density, grad_sigma, of_colour.geometry_features)
        weights = Weights(of_density.density_hidden, of_density.density_out, *of_colour[:2])
        of_background = (1 - forward_pass.rendering.opacity)[:, None] * grad.colour
        return HashGridGradients(weights, of_density.features, of_colour.harmonics, of_background)

    def rays_backward(
        self, forward_pass: HashGridPass, gradients: HashGridGradients
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Gradients of the rays' origins and directions, for refining poses."""
        backend, rays, samples = self.backend, forward_pass.rays, forward_pass.in_scene
        grad_points = backend.encode_backward_points(self.layout, self.table, forward_pass.points, gradients.features)
        if isinstance(self.space, Ndc):
            points = rays.origins[samples.ray] + samples.t[:, None] * rays.directions[samples.ray]
            grad_points = self.space.pull_back(points, grad_points)
        grad_origins, grad_directions = backend.sample_points_backward(
            rays, samples, self.space.bends_rays, grad_points
        )
        grad_directions = grad_directions + self.encode_directions_backward(rays.directions, gradients.harmonics)
        if self.settings.background_model:
            grad_directions += directions_backward(
                backend, self.background_table, rays.directions, forward_pass.background, gradients.background
            )
        return grad_origins, grad_directions

    def background_backward(self, forward_pass: HashGridPass, gradients: HashGridGradients) -> Float[Tensor, "rows 4"]:
        """Gradient of the background table, for a field that has one."""
        return background_backward(
            self.backend, forward_pass.rays.directions, forward_pass.background, gradients.background
        )

    def _background_of(self, rays: Rays, background: Float[Tensor, "*#rays 3"]) -> Float[Tensor, "*#rays 3"]:
        return (
            background_colour(self.backend, self.background_table, rays.directions)
            if self.settings.background_model
            else background
        )

    def _march(
        self,
        rays: MappedRays,
        jitter: Float[Tensor, "rays"],
        stepping: RayStepping,
        sizes: Sequence[RoundSize] | None = None,
    ) -> Iterator[MarchingRound]:
        return march_with_early_termination(
            self.backend,
            BinaryOccupancy(self.occupancy_bits, self.empty_distance),
            stepping,
            self._density_pass,
            rays,
            jitter,
            sizes,
        )

    def _density_pass(self, unit: Float[Tensor, "points 3"]) -> DensityPass:
        with span("gather", WorkCounts(gathered_rows=CORNERS * len(self.layout.resolutions) * len(unit))):
            features = self.backend.encode(self.layout, self.table, unit)
        return mlp.density_forward(self.weights, self.backend, features)


def _in_scene(mapped: MappedRays, samples: Samples) -> Samples:
    """Marched samples at their distances in the scene."""
    return samples._replace(t=mapped.to_scene(samples.t, samples.ray))
