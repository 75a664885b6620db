"""One optimisation step of a hash-grid field, behind the interface that all fields share (nerf/training/trainer.py)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.effects import NO_EFFECTS, Effect, ImageEffects, RayGradients, RenderedRays, parameters_of
from nerf.fields import mlp
from nerf.fields.background import BACKGROUND_LR_SCALE, BACKGROUND_PRIOR
from nerf.fields.frustum_mask import compute_frustum_mask
from nerf.fields.hash_grid import CORNERS, HashGridField, HashGridPass
from nerf.fields.interface import Rendering
from nerf.fields.mlp import Weights
from nerf.fields.occupancy_grid import OccupancyGrid
from nerf.geometry.rays import Rays
from nerf.kernels import BOX
from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import WorkCounts, span
from nerf.runtime.randomness import generator
from nerf.training.losses import huber_loss
from nerf.training.metrics import psnr
from nerf.training.pixel_sampler import PixelSampler
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import RAYS, NonFinite, StepResult, all_finite

LR_WARMUP_STEPS = 20
# Of the run, before the rate begins to fall. A fall over most of the run costs short runs up to 2 dB and gains long
# ones nothing (docs/experiments/learning_rate.md); and what is measured before it does not depend on how long the run
# will be.
LR_HOLD_FRACTION = 0.75
LR_FINAL_FRACTION = 0.05  # of the rate at first
# The distortion loss begins weak: it draws fog together wherever that stands, and far things that only smooth colours
# tell apart (the sky) would be drawn close behind the scene before their place is known
# (docs/experiments/learning_rate.md).
INITIAL_DISTORTION = 0.25  # of its weight
FULL_DISTORTION_PROGRESS = 0.3  # of the run
DEPTH_RAY_INTERVAL = 8  # one ray in so many runs to a sparse point, where some are known
INITIAL_SAMPLES_PER_RAY = 128.0
# A ray is not free, though it may need no colour: no step has more rays than if each needed so many.
MIN_SAMPLES_PER_RAY = 2.0
# Of the table's entries, how many have a gradient in a step: of 5 grids of 2^18 rows with 33 to 49 k colours 0.29 to
# 0.36 (docs/experiments/step_time.md); larger steps reach more.
TOUCHED_FRACTION = 0.33
# Of an entry: its gradient read; if there is one, that cleared, the entry itself and its moments read and written.
ADAM_BYTES = 4 * (1 + 7 * TOUCHED_FRACTION)
SAMPLES_PER_RAY_EMA_DECAY = 0.9  # how much of the mean of samples per ray remains after each step


@dataclass(frozen=True)
class HashGridTrainerSettings:
    """How to train.

    ``samples``: colours to evaluate in a step; its rays are as many as are expected to need them. ``chunks``: equal
    micro-batches of a step, each computed on a core; results depend on their number, not on that of the cores.
    ``background`` is what lies behind a scene without a background model: a colour, or another random one for each ray
    (only for photos with alpha, where it shows the field which space is empty). ``distortion``: full weight of the
    distortion loss, for scenes without a known background. ``depth_loss``: initial weight of the sparse depth loss, at
    the pixels whose distance the dataset knows. ``least_photos``: that must see a cell of unbounded space for
    something to stand before their foregrounds (nerf/fields/frustum_mask.py), or all but one where they are few.
    """

    seed: int
    background: tuple[float, float, float] | Literal["random"]
    samples: int = 1 << 14
    chunks: int = 1
    rate: float = 2e-2
    distortion: float = 0.0
    depth_loss: float = 0.0
    least_photos: int = 1


class HashGridBatch(NamedTuple):
    """Rays with the colour each should see over its background, where its samples stand in their intervals and which of
    its thin ones are kept (both in [0, 1)), whose view it belongs to, and how far away is the sparse point that it runs
    to; 0: to none."""

    rays: Rays
    target: Float[Tensor, "rays 3"]
    background: Float[Tensor, "rays 3"]
    jitter: Float[Tensor, "rays"]
    offset: Float[Tensor, "rays"]
    view: Int[Tensor, "rays"]
    distance: Float[Tensor, "rays"]


class Loss(NamedTuple):
    """A chunk's share of the loss, of the mean squared error in it, and the gradients of rendering, weights and of
    the colour effects' parameters."""

    value: Tensor
    squared_error: Tensor
    grad: Rendering
    grad_weights: Float[Tensor, "samples"]
    grad_effects: dict[str, Tensor]


class _Part(NamedTuple):
    """What one micro-batch contributes: loss, gradients and their norm, the optical thickness of its samples, and how
    many densities it evaluated."""

    batch: HashGridBatch
    loss: Tensor
    squared_error: Tensor
    weights: Weights
    features: Float[Tensor, "samples width"]
    points: Float[Tensor, "samples 3"]
    background: dict[str, Tensor]
    effects: dict[str, Tensor]
    norm: Tensor
    thickness: Float[Tensor, "samples"]
    densities: int


def lr_multiplier(step: int, progress: float) -> float:
    """The learning rate over its base: a linear warm-up, then constant, then falling exponentially."""
    fallen = max(0.0, progress - LR_HOLD_FRACTION) / (1 - LR_HOLD_FRACTION)
    return min(1.0, (step + 1) / LR_WARMUP_STEPS) * LR_FINAL_FRACTION**fallen


def distortion_multiplier(progress: float) -> float:
    """The weight of the distortion loss over its full one: from a quarter it grows with the progress of the run."""
    return min(1.0, max(INITIAL_DISTORTION, progress / FULL_DISTORTION_PROGRESS))


def depth_loss_multiplier(progress: float) -> float:
    """The weight of the depth loss over its first one: it falls to nothing over the run. Shape is decided early, and
    once it is about right photos know it better than points do."""
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
        self.model, self.settings, self.effects = model, settings, effects
        # Nothing beyond the box of a bounded scene is drawn: a point there would pull the light to its walls.
        self.dataset = dataset if model.space.unbounded else dataset.with_sparse_depths_within(BOX)
        self.occupancy_grid = OccupancyGrid(model, self._usable())
        of_networks = model.weights._asdict()
        self.background = {"background_table": model.background_table} if model.settings.background_model else {}
        self.parameters = {"table": model.table, **of_networks, **self.background, **effects.parameters}
        self.exp_avg = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(tensor) for name, tensor in self.parameters.items()}
        self.grad_table = torch.zeros_like(model.table)
        tables = model.table, self.grad_table, self.exp_avg["table"], self.exp_avg_sq["table"]
        self.levels = [
            tuple(tensor[first:end] for tensor in tables) for first, end in pairwise(model.layout.first_rows)
        ]
        self.samples_per_ray = torch.tensor(INITIAL_SAMPLES_PER_RAY, dtype=torch.float64)
        self.order = PixelSampler(self.dataset.unmasked_count, settings.seed, dataset.device)
        self.drawn = torch.tensor(0)  # pixels of that order so far; steps differ in how many they take

    def _usable(self) -> Bool[Tensor, "cells"] | None:
        """Known only where points tell where foregrounds begin, in unbounded space: a box is carved beforehand."""
        least, space = min(self.settings.least_photos, len(self.dataset.near) - 1), self.model.space
        if least <= 1 or self.dataset.known is None or not space.unbounded:
            return None
        return compute_frustum_mask(self.dataset, space, least, self.model.stepping.occupancy_resolution)

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """One batch, one update. Raises NonFinite before the update, leaving model and optimiser as they were."""
        device, rays = self.dataset.device, self._rays_per_chunk()
        parts = list(in_order(partial(self._part, step, progress, rays), range(self.settings.chunks), device))
        loss, error = self._finite(step, parts)
        self._update(parts, lr_scale * lr_multiplier(step, progress), step + 1)
        with span("cache"):
            self.occupancy_grid.update(step, generator(device, self.settings.seed, step, self.settings.chunks))
        samples = sum(len(each.points) for each in parts)
        rays *= self.settings.chunks
        self.drawn += self._of_photos(rays, progress)
        self.samples_per_ray.mul_(SAMPLES_PER_RAY_EMA_DECAY).add_((1 - SAMPLES_PER_RAY_EMA_DECAY) * samples / rays)
        return StepResult(loss, psnr(error), rays, samples, sum(each.densities for each in parts))

    def state(self) -> dict[str, Tensor]:
        """Weights and occupancy bits as ``model.<name>``, per-image parameters as ``image.<effect>.<name>``, Adam's
        moments as ``exp_avg.<name>`` and ``exp_avg_sq.<name>``, the optical thickness of the occupancy grid's cells,
        the mean number of samples per ray, how many pixels were sampled, and the field's settings, to know it by."""
        return (
            {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
            | {f"image.{name}": tensor for name, tensor in self.effects.parameters.items()}
            | {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
            | {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}
            | {"optical_thickness": self.occupancy_grid.optical_thickness}
            | {"samples_per_ray": self.samples_per_ray, "drawn": self.drawn}
            | {"settings": torch.frombuffer(bytearray(repr(self.model.settings).encode()), dtype=torch.uint8)}
        )

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go back to what :meth:`state` gave. Raises RuntimeError for the state of another field, also where its
        tables have the same shapes."""
        mine = self.state()
        different = [name for name in sorted(mine.keys() | state.keys()) if _shape(mine, name) != _shape(state, name)]
        if not different and not torch.equal(mine["settings"], state["settings"].to(mine["settings"].device)):
            different = ["settings"]
        if different:
            raise RuntimeError(f"this state belongs to another field: {', '.join(different)} differ")
        for name, tensor in mine.items():
            tensor.copy_(state[name])

    def _rays_per_chunk(self) -> int:
        wanted = int(self.settings.samples / max(MIN_SAMPLES_PER_RAY, float(self.samples_per_ray)))
        return max(1, wanted // self.settings.chunks)

    def _batch(self, step: int, progress: float, chunk: int, count: int) -> HashGridBatch:
        device = self.dataset.device
        random = generator(device, self.settings.seed, step, chunk)
        # Shared out over the chunks, which are small where cores are many and the field is young.
        first, end = self._of_photos(chunk * count, progress), self._of_photos((chunk + 1) * count, progress)
        pixel = self.dataset.nth(self.order.take(int(self.drawn) + first, end - first))
        to_points, distance = count - len(pixel), torch.zeros(count, device=device)
        if to_points:
            of_points, distance[-to_points:] = self.dataset.sample_sparse_depths(to_points, random)
            pixel = torch.cat([pixel, of_points])
        rays, colour, alpha, view = self.dataset.lookup(pixel)
        if self.settings.background == "random":
            background = torch.rand(count, 3, generator=random, device=device)
        else:
            background = torch.tensor(self.settings.background, device=device).repeat(count, 1)
        target = colour if alpha is None else torch.lerp(background, colour, alpha[:, None])
        jitter, offset = torch.rand(2, count, generator=random, device=device)
        return HashGridBatch(rays, target, background, jitter, offset, view, distance)

    def _of_photos(self, rays: int, progress: float) -> int:
        """How many of so many rays run through pixels of all the photos; the others run to sparse points."""
        return rays - rays // DEPTH_RAY_INTERVAL if self._has_depth_loss(progress) else rays

    def _has_depth_loss(self, progress: float) -> bool:
        return self.dataset.known is not None and self.settings.depth_loss * depth_loss_multiplier(progress) > 0

    def _part(self, step: int, progress: float, rays: int, chunk: int) -> _Part:
        """What a chunk of so many rays adds to loss and gradients."""
        with span("batch"):
            batch = self._batch(step, progress, chunk, rays)
            seen_along = self.effects.forward_rays(batch.rays, batch.view)
            if not all_finite(seen_along):
                raise NonFinite(RAYS, step, _whole([batch]))
        done = self.model.forward(seen_along, batch.jitter, batch.offset, batch.background)
        with span("composite"):
            loss = self._loss(rays * self.settings.chunks, progress, done, batch)
        with span("backward", self._backward_work(done)):
            gradients = self.model.backward(done, loss.grad, loss.grad_weights)
            effects = loss.grad_effects | self.effects.backward_rays(
                batch.rays, batch.view, lambda: RayGradients(*self.model.rays_backward(done, gradients))
            )
            background = {name: self.model.background_backward(done, gradients) for name in self.background}
        weights, features, *_ = gradients
        norm = torch.nn.utils.get_total_norm([*weights, features, *background.values(), *effects.values()])
        of_loss = loss.value, loss.squared_error
        return _Part(
            batch, *of_loss, weights, features, done.points, background, effects, norm, done.thickness, done.marched
        )

    def _backward_work(self, done: HashGridPass) -> WorkCounts:
        weights = self.model.weights
        products = 2 * (mlp.density_flops(weights) + mlp.colour_flops(weights)) * len(done.points)
        to_points = CORNERS * len(self.model.layout.resolutions) * len(done.points) if self.effects.rays else 0
        return WorkCounts(products, to_points)

    def _loss(self, rays: int, progress: float, done: HashGridPass, batch: HashGridBatch) -> Loss:
        seen = RenderedRays(done.rendering, batch.background, batch.rays, batch.view)
        error = self.effects.residual(seen, batch.target)
        robust, pull = huber_loss(error)
        grad, effects = self.effects.backward_residual(seen, pull * (2 / (3 * rays)))
        value, grad_weights = robust.sum() / (3 * rays), torch.zeros_like(done.weights)
        backend, stepping = self.model.backend, self.model.stepping
        if self.settings.distortion:
            each = torch.full_like(batch.distance, self.settings.distortion * distortion_multiplier(progress) / rays)
            lengths = done.samples.dt / done.mapped.scene_length(done.samples.t, done.samples.ray)
            marched = done.samples._replace(dt=lengths)
            value = value + (each * backend.distortion(marched, done.weights, stepping)).sum()
            grad_weights = backend.distortion_backward(marched, done.weights, stepping, each)
        if self._has_depth_loss(progress):
            each = torch.full_like(batch.distance, self.settings.depth_loss * depth_loss_multiplier(progress) / rays)
            places = done.mapped.rays.far, done.mapped.from_scene(batch.distance), stepping
            apart = backend.depth_loss(done.samples, done.weights, done.rendering.opacity, *places)
            value = value + (each * apart).sum()
            of_weights, of_opacity = backend.depth_loss_backward(done.samples, *places, each)
            grad_weights, grad = grad_weights + of_weights, grad._replace(opacity=grad.opacity + of_opacity)
        return Loss(value, error.square().sum() / (3 * rays), grad, grad_weights, effects)

    def _finite(self, step: int, parts: Sequence[_Part]) -> tuple[float, float]:
        """Loss and squared error as numbers, once they and all gradients are known to be finite.

        The table's gradient is a sum of the features' gradients with weights up to 1: finite if their norm is.
        """
        each = zip(*((chunk.loss, chunk.squared_error, chunk.norm) for chunk in parts), strict=True)
        # One wait for the GPU, not three.
        loss_now, error_now, norm_now = torch.stack([torch.stack(values).sum() for values in each]).tolist()
        for quantity, value in {"loss": loss_now, "gradient": norm_now}.items():
            if not abs(value) < float("inf"):
                raise NonFinite(quantity, step, _whole([chunk.batch for chunk in parts]))
        return loss_now, error_now

    def _update(self, parts: Sequence[_Part], factor: float, adam_step: int) -> None:
        """Update the table's levels, which progress no rows, the networks, the per-image parameters and the occupancy
        grid, each on a core. ``factor`` scales all learning rates."""
        finest_first = range(len(self.model.layout.resolutions) - 1, -1, -1)  # no core waits long for the last
        learning_rate = self.settings.rate * factor
        work = [partial(self._update_level, level, parts, learning_rate, adam_step) for level in finest_first]
        of_networks = [chunk.weights._asdict() for chunk in parts]
        work.append(partial(self._update_small, Weights._fields, of_networks, learning_rate, adam_step))
        of_background = [*(chunk.background for chunk in parts), self._background_prior(parts)]
        work.append(
            partial(self._update_small, self.background, of_background, BACKGROUND_LR_SCALE * learning_rate, adam_step)
        )
        work.append(partial(self._raise_occupancy, parts))
        for effect in self.effects.all:
            work.append(partial(self._update_effect, effect, parts, effect.learning_rate * factor, adam_step))
        for _ in in_order(lambda update: update(), work, self.dataset.device):
            pass

    def _background_prior(self, parts: Sequence[_Part]) -> dict[str, Tensor]:
        """The prior's gradient of the background where rays of this batch reach it; elsewhere it stays as it is."""
        rays = sum(len(chunk.batch.jitter) for chunk in parts)
        touched = {
            name: torch.stack([chunk.background[name] for chunk in parts]).sum(0) != 0 for name in self.background
        }
        return {name: BACKGROUND_PRIOR / rays * table * touched[name] for name, table in self.background.items()}

    def _update_level(self, level: int, parts: Sequence[_Part], learning_rate: float, adam_step: int) -> None:
        layout, backend = self.model.layout, self.model.backend
        with span("scatter", WorkCounts(gathered_rows=CORNERS * sum(len(each.points) for each in parts))):
            for each in parts:
                backend.encode_backward_table(layout, level, each.points, each.features, self.grad_table)
        table, grad, exp_avg, exp_avg_sq = self.levels[level]
        with span("optimiser", WorkCounts(streamed_bytes=ADAM_BYTES * table.numel())):
            backend.adam(table, grad, exp_avg, exp_avg_sq, learning_rate, adam_step)

    def _update_small(
        self, names: Iterable[str], of_parts: Sequence[dict[str, Tensor]], learning_rate: float, adam_step: int
    ) -> None:
        """Of parameters that are small beside the table."""
        with span("optimiser"):
            for name in names:
                gradient = torch.stack([each[name] for each in of_parts]).sum(0)
                parameter, exp_avg, exp_avg_sq = self.parameters[name], self.exp_avg[name], self.exp_avg_sq[name]
                self.model.backend.adam(parameter, gradient, exp_avg, exp_avg_sq, learning_rate, adam_step)

    def _update_effect(self, effect: Effect, parts: Sequence[_Part], learning_rate: float, adam_step: int) -> None:
        self._update_small(parameters_of(effect), [chunk.effects for chunk in parts], learning_rate, adam_step)
        effect.fix_gauge()

    def _raise_occupancy(self, parts: Sequence[_Part]) -> None:
        with span("cache"):
            for each in parts:
                self.occupancy_grid.raise_to(each.points, each.thickness)


def _whole(batches: Sequence[HashGridBatch]) -> dict[str, Tensor]:
    """A batch by the names of its tensors, its chunks put together again."""
    rays = zip(*(batch.rays for batch in batches), strict=True)
    rest = zip(*(batch[1:] for batch in batches), strict=True)
    names = (*Rays._fields, *HashGridBatch._fields[1:])
    return {name: torch.cat(chunks) for name, chunks in zip(names, (*rays, *rest), strict=True)}


def _shape(state: dict[str, Tensor], name: str) -> torch.Size | None:
    return state[name].shape if name in state else None
