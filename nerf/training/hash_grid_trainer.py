"""One optimisation step of a hash-grid field (:class:`nerf.training.trainer.FieldTrainer`)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

from nerf.effects import NO_EFFECTS, Effect, ImageEffects, RayGradients, RenderedRays, parameters_of
from nerf.fields import mlp
from nerf.fields.background import BACKGROUND_LR_SCALE, BACKGROUND_PRIOR
from nerf.fields.hash_grid import CORNERS, HashGridField, HashGridPass, SampleCapacities
from nerf.fields.interface import Rendering
from nerf.fields.mlp import Weights
from nerf.fields.occupancy_grid import OccupancyGrid
from nerf.geometry.rays import Rays
from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import WorkCounts, span
from nerf.runtime.randomness import generator
from nerf.training.colour_loss import huber_loss, shows_backdrop
from nerf.training.frustum_mask import compute_frustum_mask
from nerf.training.learning_rate import lr_multiplier
from nerf.training.pixel_sampler import PixelSampler
from nerf.training.psnr import psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import RAY_GEOMETRY, NonFinite, StepResult, all_finite

# The distortion loss begins weak: it concentrates floaters wherever they are, and distant surfaces of smooth colour
# (the sky) would be pulled close behind the scene before their depth is known (docs/experiments/learning_rate.md).
INITIAL_DISTORTION_FRACTION = 0.25  # of its weight
FULL_DISTORTION_PROGRESS = 0.3  # of the run
DEPTH_RAY_INTERVAL = 8  # one ray in so many goes through the pixel of a sparse point, where some are known
INITIAL_SAMPLES_PER_RAY = 128.0
# A ray is not free, even if no colour is evaluated on it: this limits the rays of a step.
MIN_SAMPLES_PER_RAY = 2.0
# Of the table's entries, how many have a gradient in a step: of 5 grids of 2^18 rows with 33 to 49 k colours 0.29 to
# 0.36 (docs/experiments/step_time.md); larger steps reach more.
TOUCHED_FRACTION = 0.33
# Of an entry: its gradient read; if there is one, that cleared, the entry itself and its moments read and written.
ADAM_BYTES = 4 * (1 + 7 * TOUCHED_FRACTION)
# How many times as long as the field's own steps along rays are while they are long (docs/experiments/ray_samples.md).
LONG_STEP_FACTOR = 2.0
SAMPLES_PER_RAY_EMA_DECAY = 0.9  # how much of the mean of samples per ray remains after each step


@dataclass(frozen=True)
class HashGridTrainerSettings:
    """How to train.

    ``target_samples``: colour evaluations per step; the number of rays follows from it. ``micro_batches``: equal parts
    of a step, each computed on a core; results depend on their number, not on that of the cores. ``background``: the
    colour behind a scene without a background model, or another random one for each ray (only for photos with alpha,
    where it shows the field which space is empty). ``distortion_weight``: full weight of the distortion loss, for
    scenes without a known background. ``depth_weight``: initial weight of the depth loss, at sparse points and where
    depth maps know the distance. ``backdrop_tolerance``: of the one colour that photos show where nothing is, in [0,
    1]; 0: they show other things (nerf/training/colour_loss.py). ``min_photos``: how many photos must see a cell of
    unbounded space before their foregrounds for it to hold density (nerf/training/frustum_mask.py), or all but one
    where they are few. Up to a progress of ``long_steps_until``, steps along rays are LONG_STEP_FACTOR times as long,
    so that a ray has fewer samples while surfaces are still thick; a CUDA graph holds one length for all steps.
    """

    seed: int
    background: tuple[float, float, float] | Literal["random"]
    target_samples: int = 1 << 14
    micro_batches: int = 1
    learning_rate: float = 2e-2
    distortion_weight: float = 0.0
    depth_weight: float = 0.0
    backdrop_tolerance: float = 0.0
    min_photos: int = 1
    long_steps_until: float = 0.0


class HashGridBatch(NamedTuple):
    """Rays with their target colours, which are composited over ``background``. ``jitter`` places the samples in their
    intervals, ``thinning_offset`` decides which thin samples are kept (both in [0, 1)). ``view`` is the image of a ray,
    ``known_depth`` the distance of what it meets, by a sparse point or a depth map; 0: that is not known."""

    rays: Rays
    target: Float[Tensor, "rays 3"]
    background: Float[Tensor, "rays 3"]
    jitter: Float[Tensor, "rays"]
    thinning_offset: Float[Tensor, "rays"]
    view: Int[Tensor, "rays"]
    known_depth: Float[Tensor, "rays"]


class LossWeights(NamedTuple):
    """What a ray's distortion loss, depth loss and opacity are multiplied by in the loss of a step; None: they are off.
    Opacity counts where a photo shows the backdrop."""

    distortion: Float[Tensor, ""] | None
    depth: Float[Tensor, ""] | None
    opacity: Float[Tensor, ""] | None


class MicroBatch(NamedTuple):
    """What one micro-batch contributes: loss, gradients and their norm, the optical thickness of its samples, and the
    numbers of colour and density evaluations. ``batch`` is None of one that another process computed. Points, their
    gradients and optical thickness may have padding at their end (nerf/kernels); ``capacities`` and ``fits`` are those
    of the HashGridPass."""

    batch: HashGridBatch | None
    loss: Tensor
    squared_error: Tensor
    grad_networks: Weights
    grad_features: Float[Tensor, "samples width"]
    points: Float[Tensor, "samples 3"]
    grad_background: dict[str, Tensor]
    grad_effects: dict[str, Tensor]
    grad_norm: Tensor
    optical_thickness: Float[Tensor, "samples"]
    colour_evaluations: Int32[Tensor, ""]
    density_evaluations: Int32[Tensor, ""]
    capacities: SampleCapacities
    fits: Bool[Tensor, ""]


class Loss(NamedTuple):
    """A micro-batch's share of the loss and of its mean squared error, and the gradients of rendering, weights and
    colour effects' parameters."""

    value: Tensor
    squared_error: Tensor
    grad: Rendering
    grad_weights: Float[Tensor, "samples"]
    grad_effects: dict[str, Tensor]


@runtime_checkable
class Exchange(Protocol):
    """What the processes that share a training's micro-batches have of each other (nerf/training/data_parallel.py)."""

    @property
    def is_dense(self) -> bool:
        """Whether the table's gradient is to be added up over the processes, each of which has that of its own
        micro-batches alone. Known from :meth:`all_micro_batches` on."""
        ...

    def all_micro_batches(self, step: int, compute: Callable[[int], MicroBatch], count: int) -> list[MicroBatch]:
        """All ``count`` micro-batches of a step, in order, of which this process computes some."""
        ...

    def add_up(self, grad_table: Tensor) -> None:
        """In place: the sum over the processes."""
        ...


def distortion_multiplier(progress: float) -> float:
    """The weight of the distortion loss over its full one: from a quarter it grows with the progress of the run."""
    return min(1.0, max(INITIAL_DISTORTION_FRACTION, progress / FULL_DISTORTION_PROGRESS))


def depth_loss_multiplier(progress: float) -> float:
    """The weight of the depth loss over its initial one: it falls to zero over the run. Geometry is decided
    early, and once it is about right the photos constrain it better than the points do."""
    return 1 - progress


class HashGridTrainer:
    """Trains a hash-grid field on the Huber loss of colours by Adam, and updates its occupancy grid. ``effects`` stand
    between the field and each image (nerf/effects)."""

    def __init__(
        self,
        model: HashGridField,
        dataset: RayDataset,
        settings: HashGridTrainerSettings,
        effects: ImageEffects = NO_EFFECTS,
    ) -> None:
        self.model, self.settings, self.effects, self.stepping = model, settings, effects, model.stepping
        # Nothing beyond the box of a bounded scene is rendered: a point there would pull density to its walls.
        self.dataset = dataset if model.space.unbounded else dataset.with_sparse_depths_within(model.space.half)
        self.occupancy_grid = OccupancyGrid(model, self._frustum_mask())
        networks = model.weights._asdict()
        self.background = {"background_table": model.background_table} if model.settings.background_model else {}
        self.parameters = {"table": model.table, **networks, **self.background, **effects.parameters}
        self.exp_avg = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.grad_table = torch.zeros_like(model.table)
        if settings.background != "random":
            self.fixed_background = torch.tensor(settings.background, device=dataset.device)
        self.samples_per_ray = torch.tensor(INITIAL_SAMPLES_PER_RAY, dtype=torch.float64)
        self.pixel_sampler = PixelSampler(self.dataset.unmasked_count, settings.seed, dataset.device)
        self.pixels_sampled = torch.tensor(0)  # so far; steps differ in how many they take
        self.exchange: Exchange | None = None  # of a training by several processes

    def _frustum_mask(self) -> Bool[Tensor, "cells"] | None:
        """Only in unbounded space and with sparse points, which tell where foregrounds begin; else None."""
        min_photos, space = min(self.settings.min_photos, len(self.dataset.near) - 1), self.model.space
        if min_photos <= 1 or self.dataset.sparse_pixels is None or not space.unbounded:
            return None
        return compute_frustum_mask(self.dataset, space, min_photos, self.model.stepping.occupancy_resolution)

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """One batch, one update. Raises NonFinite before the update, leaving model and optimiser as they were."""
        return self.take_step(step, progress, lr_scale)[0]

    def take_step(self, step: int, progress: float, lr_scale: float) -> tuple[StepResult, Sequence[MicroBatch]]:
        """:meth:`step`, and what its micro-batches were."""
        are_long = progress < self.settings.long_steps_until
        self.model.stepping = self.stepping.longer(LONG_STEP_FACTOR) if are_long else self.stepping
        device, count, rays = self.dataset.device, self.settings.micro_batches, self.rays_per_micro_batch()
        compute = partial(self._compute_micro_batch, step, progress, rays)
        if self.exchange is None:
            micro_batches = list(in_order(compute, range(count), device))
        else:
            micro_batches = self.exchange.all_micro_batches(step, compute, count)
        loss, error, colours, densities = self._check_finite(step, micro_batches)
        self.finish_step(micro_batches, step, progress, lr_scale, rays * count)
        self.count_samples(colours, rays * count)
        return StepResult(loss, psnr(error), rays * count, colours, densities), micro_batches

    def finish_step(
        self, micro_batches: Sequence[MicroBatch], step: int, progress: float, lr_scale: float, rays: int
    ) -> None:
        """Learn from the micro-batches of a step of so many ``rays``."""
        self._update(micro_batches, lr_scale * lr_multiplier(step, progress), step + 1, rays)
        with span("occupancy"):
            random = generator(self.dataset.device, self.settings.seed, step, self.settings.micro_batches)
            self.occupancy_grid.update(step, random)
        self.pixels_sampled += self._photo_ray_count(rays, progress)

    def count_samples(self, colours: int, rays: int) -> None:
        """Of a step: the next ones draw rays accordingly."""
        per_ray = self._long_factor() * colours / rays
        self.samples_per_ray.mul_(SAMPLES_PER_RAY_EMA_DECAY).add_((1 - SAMPLES_PER_RAY_EMA_DECAY) * per_ray)

    def _long_factor(self) -> float:
        """How many times as long as the field's own the steps along rays are now. Samples of a ray are counted as if it
        were 1, so that the step at which it changes has the right number of rays."""
        return self.model.stepping.step_size / self.stepping.step_size

    def state(self) -> dict[str, Tensor]:
        """Weights and occupancy bits as ``model.<name>``, per-image parameters as ``image.<effect>.<name>``, Adam's
        moments as ``exp_avg.<name>`` and ``exp_avg_sq.<name>``, the optical thickness of the occupancy grid's cells,
        the mean number of samples per ray (at steps of the field's own length), how many pixels were sampled, and the
        field's settings, to know it by."""
        return (
            {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
            | {f"image.{name}": tensor for name, tensor in self.effects.parameters.items()}
            | {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
            | {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}
            | {"optical_thickness": self.occupancy_grid.optical_thickness}
            | {"samples_per_ray": self.samples_per_ray, "pixels_sampled": self.pixels_sampled}
            | {"settings": torch.frombuffer(bytearray(repr(self.model.settings).encode()), dtype=torch.uint8)}
        )

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` gave. Raises RuntimeError for the state of another field, also where its
        tables have the same shapes."""
        own = self.state()
        different = [name for name in sorted(own.keys() | state.keys()) if _shape(own, name) != _shape(state, name)]
        if not different and not torch.equal(own["settings"], state["settings"].to(own["settings"].device)):
            different = ["settings"]
        if different:
            raise RuntimeError(f"this state belongs to another field: {', '.join(different)} differ")
        for name, tensor in own.items():
            tensor.copy_(state[name])

    def rays_per_micro_batch(self) -> int:
        """As many as have the colours that a step should compute, by the last steps."""
        per_ray = float(self.samples_per_ray) / self._long_factor()
        rays = int(self.settings.target_samples / max(MIN_SAMPLES_PER_RAY, per_ray))
        return max(1, rays // self.settings.micro_batches)

    def draw_batch(self, step: int, progress: float, index: int, count: int) -> HashGridBatch:
        """The ``count`` rays of micro-batch number ``index``."""
        device = self.dataset.device
        random = generator(device, self.settings.seed, step, index)
        # Counted over the whole step: a micro-batch alone may be too small for a single ray to a sparse point.
        first, end = (self._photo_ray_count(number * count, progress) for number in (index, index + 1))
        pixel = self.dataset.unmasked_pixels(self.pixel_sampler.take(int(self.pixels_sampled) + first, end - first))
        sparse_count, known_depth = count - len(pixel), torch.zeros(count, device=device)
        if sparse_count:
            sparse_pixels, known_depth[-sparse_count:] = self.dataset.sample_sparse_depths(sparse_count, random)
            pixel = torch.cat([pixel, sparse_pixels])
        rays, colour, alpha, view = self.dataset.lookup(pixel)
        if self.dataset.depth_maps is not None and self.has_depth_loss(progress):
            of_maps = self._map_depths(pixel, rays, alpha, view)
            known_depth = torch.where(known_depth > 0, known_depth, of_maps)
        if self.settings.background == "random":
            background = torch.rand(count, 3, generator=random, device=device)
        else:
            background = self.fixed_background.repeat(count, 1)
        target = colour if alpha is None else torch.lerp(background, colour, alpha[:, None])
        jitter, thinning_offset = torch.rand(2, count, generator=random, device=device)
        return HashGridBatch(rays, target, background, jitter, thinning_offset, view, known_depth)

    def _map_depths(
        self,
        pixel: Int[Tensor, "rays"],
        rays: Rays,
        alpha: Float[Tensor, "rays"] | None,
        view: Int[Tensor, "rays"],
    ) -> Float[Tensor, "rays"]:
        """Distances by the depth maps; 0 where pixels are transparent, or what they show lies outside a bounded scene's
        box, where nothing is rendered."""
        distance = self.dataset.depths(pixel, view)
        if alpha is not None:
            distance = distance * (alpha == 1)
        if not self.model.space.unbounded:
            inside = (rays.origins + distance[:, None] * rays.directions).abs() <= self.model.space.half
            distance = distance * inside.all(-1)
        return distance

    def _photo_ray_count(self, rays: int, progress: float) -> int:
        """How many of so many rays go through pixels of the sampler; the others go to sparse points."""
        to_points = self.dataset.sparse_pixels is not None and self.has_depth_loss(progress)
        return rays - rays // DEPTH_RAY_INTERVAL if to_points else rays

    def has_depth_loss(self, progress: float) -> bool:
        """Whether some distances are known, and still count."""
        known = self.dataset.sparse_pixels is not None or self.dataset.depth_maps is not None
        return known and self.settings.depth_weight * depth_loss_multiplier(progress) > 0

    def _compute_micro_batch(self, step: int, progress: float, rays: int, index: int) -> MicroBatch:
        """What micro-batch number ``index``, of so many rays, adds to loss and gradients."""
        with span("batch"):
            batch = self.draw_batch(step, progress, index, rays)
            effect_rays = self.effects.forward_rays(batch.rays, batch.view)
            if not all_finite(effect_rays):
                raise NonFinite(RAY_GEOMETRY, step, joined([batch]))
        rays *= self.settings.micro_batches
        return self.differentiate(batch, effect_rays, rays, self.loss_weights(rays, progress))

    def loss_weights(self, rays: int, progress: float) -> LossWeights:
        """In a step of so many rays."""

        def per_ray(weight: float) -> Float[Tensor, ""]:
            return torch.full((), weight / rays, device=self.dataset.device)

        distortion = self.settings.distortion_weight * distortion_multiplier(progress)
        depth = self.settings.depth_weight * depth_loss_multiplier(progress)
        opacity = self.settings.backdrop_tolerance**2
        return LossWeights(
            per_ray(distortion) if distortion else None,
            per_ray(depth) if self.has_depth_loss(progress) else None,
            per_ray(opacity) if opacity else None,
        )

    def differentiate(
        self,
        batch: HashGridBatch,
        effect_rays: Rays,
        rays: int,
        weights: LossWeights,
        capacities: SampleCapacities | None = None,
    ) -> MicroBatch:
        """What a batch adds to loss and gradients of a step of so many ``rays``; ``effect_rays``: its rays as ray
        effects make them. With ``capacities`` nothing here waits for a GPU."""
        forward_pass = self.model.forward(
            effect_rays, batch.jitter, batch.thinning_offset, batch.background, capacities
        )
        with span("composite"):
            loss = self._loss(rays, weights, forward_pass, batch)
        with span("backward", self._backward_work(forward_pass)):
            gradients = self.model.backward(forward_pass, loss.grad, loss.grad_weights)
            effects = loss.grad_effects | self.effects.backward_rays(
                batch.rays, batch.view, lambda: RayGradients(*self.model.rays_backward(forward_pass, gradients))
            )
            background = {name: self.model.background_backward(forward_pass, gradients) for name in self.background}
        networks, features, *_ = gradients
        return MicroBatch(
            batch,
            loss.value,
            loss.squared_error,
            grad_networks=networks,
            grad_features=features,
            points=forward_pass.points,
            grad_background=background,
            grad_effects=effects,
            grad_norm=torch.nn.utils.get_total_norm([*networks, features, *background.values(), *effects.values()]),
            optical_thickness=forward_pass.optical_thickness,
            colour_evaluations=forward_pass.samples.starts[-1],
            density_evaluations=forward_pass.density_evaluations,
            capacities=forward_pass.capacities,
            fits=forward_pass.fits,
        )

    def _backward_work(self, forward_pass: HashGridPass) -> WorkCounts:
        weights, points = self.model.weights, len(forward_pass.points)
        flops = 2 * (mlp.density_flops(weights) + mlp.colour_flops(weights)) * points
        rows = CORNERS * len(self.model.layout.resolutions) * points if self.effects.rays else 0
        return WorkCounts(flops, rows)

    def _loss(self, rays: int, weights: LossWeights, forward_pass: HashGridPass, batch: HashGridBatch) -> Loss:
        seen = RenderedRays(forward_pass.rendering, batch.background, batch.rays, batch.view)
        error = self.effects.residual(seen, batch.target)
        huber, half_gradient = huber_loss(error)
        grad, effects = self.effects.backward_residual(seen, half_gradient * (2 / (3 * rays)))
        value, grad_weights = huber.sum() / (3 * rays), torch.zeros_like(forward_pass.weights)
        backend, stepping = self.model.backend, self.model.stepping
        mapped, samples = forward_pass.mapped, forward_pass.samples
        if weights.distortion is not None:
            each = weights.distortion.repeat(len(batch.known_depth))
            marched = samples._replace(dt=samples.dt / mapped.scene_length(samples.t, samples.ray))
            value = value + (each * backend.distortion(marched, forward_pass.weights, stepping)).sum()
            grad_weights = backend.distortion_backward(marched, forward_pass.weights, stepping, each)
        if weights.depth is not None:
            each = weights.depth.repeat(len(batch.known_depth))
            arguments = mapped.rays.far, mapped.from_scene(batch.known_depth), stepping
            depth_loss = backend.depth_loss(samples, forward_pass.weights, forward_pass.rendering.opacity, *arguments)
            value = value + (each * depth_loss).sum()
            more_weights, more_opacity = backend.depth_loss_backward(samples, *arguments, each)
            grad_weights, grad = grad_weights + more_weights, grad._replace(opacity=grad.opacity + more_opacity)
        if weights.opacity is not None:
            each = weights.opacity * shows_backdrop(batch.target, batch.background, self.settings.backdrop_tolerance)
            value = value + (each * forward_pass.rendering.opacity).sum()
            grad = grad._replace(opacity=grad.opacity + each)
        return Loss(value, error.square().sum() / (3 * rays), grad, grad_weights, effects)

    def _check_finite(self, step: int, micro_batches: Sequence[MicroBatch]) -> tuple[float, float, int, int]:
        """Loss, squared error, colour and density evaluations as numbers. Raises NonFinite unless all gradients and the
        first two are finite.

        The table's gradient is a sum of the features' gradients with weights up to 1: finite if their norm is.
        """
        each = zip(*((one.loss, one.squared_error, one.grad_norm) for one in micro_batches), strict=True)
        counts = zip(*((one.colour_evaluations, one.density_evaluations) for one in micro_batches), strict=True)
        # One wait for the GPU, not five.
        sums = [torch.stack(values).sum().double() for values in (*each, *counts)]
        loss_now, error_now, norm_now, colours, densities = torch.stack(sums).tolist()
        for quantity, value in {"loss": loss_now, "gradient": norm_now}.items():
            if not abs(value) < float("inf"):
                own = [each.batch for each in micro_batches if each.batch is not None]
                raise NonFinite(quantity, step, joined(own))
        return loss_now, error_now, int(colours), int(densities)

    def _update(self, micro_batches: Sequence[MicroBatch], factor: float, adam_step: int, rays: int) -> None:
        """Update the table's levels, which share no rows, the networks, the per-image parameters and the occupancy
        grid, each on a core; on a GPU all levels at once. ``factor`` scales all learning rates."""
        levels = range(len(self.model.layout.resolutions))
        finest_first = [levels[level : level + 1] for level in reversed(levels)]  # no core waits long for the last
        together = [levels] if self.dataset.device.type == "cuda" else finest_first
        learning_rate = self.settings.learning_rate * factor
        unscattered = micro_batches
        if self.exchange is not None and self.exchange.is_dense:
            self._scatter_and_add_up(self.exchange, together, micro_batches)
            unscattered = ()
        work = [partial(self._update_levels, some, unscattered, learning_rate, adam_step) for some in together]
        networks = [each.grad_networks._asdict() for each in micro_batches]
        work.append(partial(self._update_small, Weights._fields, networks, learning_rate, adam_step))
        background = [*(each.grad_background for each in micro_batches), self._background_prior(micro_batches, rays)]
        background_lr = BACKGROUND_LR_SCALE * learning_rate
        work.append(partial(self._update_small, self.background, background, background_lr, adam_step))
        work.append(partial(self._raise_occupancy, micro_batches))
        for effect in self.effects.all:
            work.append(partial(self._update_effect, effect, micro_batches, effect.learning_rate * factor, adam_step))
        for _ in in_order(lambda update: update(), work, self.dataset.device):
            pass

    def _background_prior(self, micro_batches: Sequence[MicroBatch], rays: int) -> dict[str, Tensor]:
        """The prior's gradient of the background where rays of this batch reach it; elsewhere it stays as it is."""
        touched = {
            name: torch.stack([each.grad_background[name] for each in micro_batches]).sum(0) != 0
            for name in self.background
        }
        return {name: BACKGROUND_PRIOR / rays * table * touched[name] for name, table in self.background.items()}

    def _update_levels(
        self, levels: range, micro_batches: Sequence[MicroBatch], learning_rate: float, adam_step: int
    ) -> None:
        self._scatter(micro_batches, levels)
        layout, backend = self.model.layout, self.model.backend
        tables = self.model.table, self.grad_table, self.exp_avg["table"], self.exp_avg_sq["table"]
        rows = slice(layout.level_offsets[levels.start], layout.level_offsets[levels.stop])
        table, grad, exp_avg, exp_avg_sq = (tensor[rows] for tensor in tables)
        with span("optimiser", WorkCounts(streamed_bytes=ADAM_BYTES * table.numel())):
            backend.adam(table, grad, exp_avg, exp_avg_sq, learning_rate, adam_step)

    def _scatter(self, micro_batches: Sequence[MicroBatch], levels: range) -> None:
        gathered_rows = CORNERS * len(levels) * sum(len(each.points) for each in micro_batches)
        with span("scatter", WorkCounts(gathered_rows=gathered_rows)):
            for each in micro_batches:
                self.model.backend.encode_backward_table(
                    self.model.layout, levels, each.points, each.grad_features, self.grad_table
                )

    def _scatter_and_add_up(
        self, exchange: Exchange, together: Sequence[range], micro_batches: Sequence[MicroBatch]
    ) -> None:
        """The table's gradient: of this process's own micro-batches, then of all."""
        own = [each for each in micro_batches if each.batch is not None]
        for _ in in_order(partial(self._scatter, own), together, self.dataset.device):
            pass
        exchange.add_up(self.grad_table)

    def _update_small(
        self, names: Iterable[str], gradients: Sequence[dict[str, Tensor]], learning_rate: float, adam_step: int
    ) -> None:
        """Of parameters that are small beside the table."""
        with span("optimiser"):
            for name in names:
                gradient = torch.stack([each[name] for each in gradients]).sum(0)
                parameter, exp_avg, exp_avg_sq = self.parameters[name], self.exp_avg[name], self.exp_avg_sq[name]
                self.model.backend.adam(parameter, gradient, exp_avg, exp_avg_sq, learning_rate, adam_step)

    def _update_effect(
        self, effect: Effect, micro_batches: Sequence[MicroBatch], learning_rate: float, adam_step: int
    ) -> None:
        self._update_small(
            parameters_of(effect), [each.grad_effects for each in micro_batches], learning_rate, adam_step
        )
        effect.fix_gauge()

    def _raise_occupancy(self, micro_batches: Sequence[MicroBatch]) -> None:
        with span("occupancy"):
            for each in micro_batches:
                self.occupancy_grid.raise_to(each.points, each.optical_thickness)


def joined(batches: Sequence[HashGridBatch]) -> dict[str, Tensor]:
    """Micro-batches joined to one batch, by the names of its tensors."""
    rays = zip(*(batch.rays for batch in batches), strict=True)
    rest = zip(*(batch[1:] for batch in batches), strict=True)
    names = (*Rays._fields, *HashGridBatch._fields[1:])
    return {name: torch.cat(chunks) for name, chunks in zip(names, (*rays, *rest), strict=True)}


def _shape(state: dict[str, Tensor], name: str) -> torch.Size | None:
    return state[name].shape if name in state else None
