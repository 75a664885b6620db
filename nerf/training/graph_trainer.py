"""Training steps of a GPU that never wait for the host, nor the host for them.

A step's gradients are some 200 operations, which take the host longer to launch than a GPU to compute, and after each
count of samples, which the host needs to know how long tensors are, the GPU has nothing to do
(docs/experiments/gpu.md). So tensors get a length beforehand, with some room to spare, and what is launched for one
batch is kept as a CUDA graph, which is launched as a whole for each later one. Loss and counts of a step are read while
the GPU computes the next.

The graph is made anew when the number of rays a step drifts away from its own. A step whose samples find no room, or
whose gradients are not finite, changes nothing: on the device its gradients become zero, which Adam passes over.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from nerf.effects import ImageEffects
from nerf.fields.hash_grid import HashGridField, SamplePlan
from nerf.fields.mlp import Weights
from nerf.rendering.early_termination import RoundSize
from nerf.runtime.profiler import is_profiling
from nerf.training.hash_grid_trainer import HashGridBatch, HashGridTrainer, LossWeights, MicroBatch, joined
from nerf.training.metrics import psnr
from nerf.training.trainer import RAY_GEOMETRY, NonFinite, StepResult

# A graph serves until the number of rays that steps should have is so far from its own; it has room for the samples of
# as many more rays, and of chance. Room costs as much time as samples do.
MAX_RAY_DRIFT, ROOM = 0.1, 1.15
MIN_SPARE_ROOM = 1 << 13  # where few rays are long, chance is larger
# How much the number of rays may change in a step for a graph to be made: at first it changes all the time.
STEADY_CHANGE = 0.02
LONGER_LAST_ROUND = 2  # so many times as long as the last round had to be

Compute = Callable[[HashGridBatch, LossWeights], tuple[MicroBatch, Float64[Tensor, "report"]]]


class StepGraph:
    """What ``compute`` launches for ``batch``, to be launched again for batches of as many rays.

    The results of a launch stay what they are until the next. ``before`` is the graph that this one follows, whose
    memory it takes over."""

    def __init__(
        self, compute: Compute, batch: HashGridBatch, weights: LossWeights, before: "StepGraph | None" = None
    ) -> None:
        self.batch = HashGridBatch(batch.rays.each(Tensor.clone), *(part.clone() for part in batch[1:]))
        self.weights = LossWeights(*(each if each is None else each.clone() for each in weights))
        self.graph, pool = torch.cuda.CUDAGraph(), None if before is None else before.graph.pool()
        self.stream = torch.cuda.Stream() if before is None else before.stream
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            self.graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                self.result = compute(self.batch, self.weights)
            finally:
                self.graph.capture_end()
        torch.cuda.current_stream().wait_stream(self.stream)

    @property
    def rays(self) -> int:
        """Of a batch."""
        return len(self.batch.jitter)

    def suits(self, rays: int, has_depth_loss: bool) -> bool:
        """Whether it is to be used for steps that should have so many rays, with a depth loss or without."""
        return (self.weights.depth is not None) == has_depth_loss and abs(rays / self.rays - 1) <= MAX_RAY_DRIFT

    def launch(self, batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Float64[Tensor, "report"]]:
        """The results for another batch."""
        given, own = ((*one.rays, *one[1:], *other) for one, other in ((batch, weights), (self.batch, self.weights)))
        for place, value in zip(own, given, strict=True):
            if place is not None and value is not None:
                place.copy_(value)
        self.graph.replay()
        return self.result


class _Report(NamedTuple):
    """What a step will have been, once its ``numbers`` are ``ready``."""

    step: int
    batch: HashGridBatch
    numbers: Float64[Tensor, "report"]
    ready: torch.cuda.Event

    @classmethod
    def of(cls, step: int, batch: HashGridBatch, on_device: Float64[Tensor, "report"]) -> "_Report":
        numbers, ready = torch.empty_like(on_device, device="cpu", pin_memory=True), torch.cuda.Event()
        numbers.copy_(on_device, non_blocking=True)
        ready.record()
        return cls(step, batch, numbers, ready)


class GraphTrainer:
    """Steps of a hash-grid trainer on a GPU (:class:`nerf.training.trainer.FieldTrainer`), with a backend whose kernels
    a graph may hold. The result of a step is that of the step before, and NonFinite comes one step late: what was not
    finite has changed nothing.

    Steps of several micro-batches, and those that are profiled, are taken as the ``trainer`` takes them."""

    def __init__(self, trainer: HashGridTrainer) -> None:
        self.trainer = trainer
        self.graph: StepGraph | None = None
        self.has_room = True  # the graph, for the samples of the last step that is known
        self.unread: _Report | None = None
        self.last = StepResult(0.0, 0.0, 0, 0, 0)

    @property
    def model(self) -> HashGridField:
        """The field in training."""
        return self.trainer.model

    @property
    def effects(self) -> ImageEffects:
        """The effects between the field and the images."""
        return self.trainer.effects

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """One batch, one update."""
        trainer = self.trainer
        rays = trainer.rays_per_micro_batch()
        single = trainer.settings.micro_batches == 1 and not is_profiling()
        graph = self.graph if single and self.has_room else None
        if graph is not None and graph.suits(rays, trainer.has_depth_loss(progress)):
            return self._step_by(graph, step, progress, lr_scale)
        self._read()
        steady = abs(rays / max(1, self.last.rays) - 1) <= STEADY_CHANGE
        self.last, (micro_batch, *_) = trainer.take_step(step, progress, lr_scale)
        if single and steady and micro_batch.batch is not None:
            weights = trainer.loss_weights(rays, progress)
            self.graph, self.has_room = self._new_graph(micro_batch.room, micro_batch.batch, weights), True
        return self.last

    def state(self) -> dict[str, Tensor]:
        """The trainer's."""
        return self.trainer.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` gave."""
        self.trainer.load_state(state)
        self.unread = None

    def _step_by(self, graph: StepGraph, step: int, progress: float, lr_scale: float) -> StepResult:
        batch = self.trainer.draw_batch(step, progress, 0, graph.rays)
        micro_batch, numbers = graph.launch(batch, self.trainer.loss_weights(graph.rays, progress))
        report = _Report.of(step, batch, numbers)
        self.trainer.finish_step([micro_batch], step, progress, lr_scale, graph.rays)
        self._read()
        self.unread = report
        return self.last

    def _new_graph(self, room: SamplePlan, batch: HashGridBatch, weights: LossWeights) -> StepGraph:
        """For steps like the one that had ``room`` for its samples."""
        rays, plan = len(batch.jitter), with_spare_room(room, self.model.stepping.max_samples)

        def compute(batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Float64[Tensor, "report"]]:
            effect_rays = self.effects.forward_rays(batch.rays, batch.view)
            found = self.trainer.differentiate(batch, effect_rays, rays, weights, plan)
            geometry = torch.stack([each.sum() for each in effect_rays]).isfinite().all()
            usable = geometry & found.fits & (found.loss + found.grad_norm).isfinite()
            counts = found.colour_evaluations, found.density_evaluations
            numbers = found.loss, found.squared_error, found.grad_norm, geometry, found.fits, *counts
            return _only_if(usable, found), torch.stack([each.double() for each in numbers])

        return StepGraph(compute, batch, weights, self.graph)

    def _read(self) -> None:
        """What the step before was, once the GPU has computed it. Raises NonFinite."""
        report, self.unread = self.unread, None
        if report is None:
            return
        report.ready.synchronize()
        loss, squared_error, grad_norm, geometry, fits, colours, densities = report.numbers.tolist()
        finite = {RAY_GEOMETRY: bool(geometry), "loss": math.isfinite(loss), "gradient": math.isfinite(grad_norm)}
        for quantity, is_finite in finite.items():
            if not is_finite:
                raise NonFinite(quantity, report.step, joined([report.batch]))
        rays = len(report.batch.jitter)
        self.has_room = bool(fits)
        if fits:
            self.trainer.count_samples(int(colours), rays)
        self.last = StepResult(loss, psnr(squared_error), rays, int(colours), int(densities))


def with_spare_room(room: SamplePlan, max_samples: int) -> SamplePlan:
    """For steps like one that had just this ``room``; ``max_samples``: of a ray."""

    def spare(count: int) -> int:
        return math.ceil(ROOM * count) + MIN_SPARE_ROOM

    *first, last = room.rounds
    longest = min(LONGER_LAST_ROUND * last.per_ray, max_samples - sum(each.per_ray for each in first))
    rounds = [*first, last._replace(per_ray=longest)]
    return SamplePlan(tuple(RoundSize(each.per_ray, spare(each.capacity)) for each in rounds), spare(room.visible))


def _only_if(usable: Bool[Tensor, ""], found: MicroBatch) -> MicroBatch:
    """What a micro-batch contributes, or nothing: then its points are zeros as well, for a gradient of zero at a point
    that is not finite is none."""

    def kept(tensor: Tensor) -> Tensor:
        return torch.where(usable, tensor, 0)

    return found._replace(
        grad_networks=Weights(*map(kept, found.grad_networks)),
        points=kept(found.points),
        grad_features=kept(found.grad_features),
        grad_background={name: kept(each) for name, each in found.grad_background.items()},
        grad_effects={name: kept(each) for name, each in found.grad_effects.items()},
        optical_thickness=kept(found.optical_thickness),
    )
