"""Training steps of a GPU as CUDA graphs, which are replayed without the host's counting anything.

A step's gradients are some 200 operations, which take the host longer to launch than a GPU to compute, and after each
count of samples, which the host needs to know how long tensors are, the GPU has nothing to do
(docs/experiments/gpu.md). So arrays of samples have lengths that are known beforehand, with some capacity to spare, and
what is launched for one batch is captured as a CUDA graph, which is replayed for each later one. Loss and counts of a
step are read while the GPU computes the next.

A graph is captured anew when the number of rays a step drifts away from its own. A step whose samples exceed the
capacities, or whose gradients are not finite, is refused: on the device its gradients become zero, which Adam passes
over.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from nerf.fields.hash_grid import SampleCapacities
from nerf.fields.mlp import Weights
from nerf.rendering.early_termination import RoundSize
from nerf.runtime.profiler import is_profiling
from nerf.training.hash_grid_trainer import HashGridBatch, HashGridTrainer, LossWeights, MicroBatch, joined
from nerf.training.psnr import psnr
from nerf.training.trainer import RAY_GEOMETRY, NonFinite, StepResult, all_finite

# A graph serves until the number of rays that steps should have is so far from its own: its rays, whose number stays,
# have as many more samples then, and by chance some more. Capacity costs as much time as samples do.
MAX_RAY_DRIFT, SPARE_CAPACITY = 0.1, 1.15
MIN_SPARE_CAPACITY = 1 << 13  # where few rays are long, chance is larger
MORE_AFTER_REFUSAL = 1.1  # so many times the capacity of the graph that refused a step
# How much the number of rays may change in a step for a graph to be made: at first it changes all the time.
STEADY_CHANGE = 0.02
LONGER_LAST_ROUND = 2  # so many times as long as the last round had to be

Compute = Callable[[HashGridBatch, LossWeights], tuple[MicroBatch, Float64[Tensor, "report"]]]


@runtime_checkable
class ReplayableStep(Protocol):
    """What a step computes, for batches of one size."""

    weights: LossWeights

    @property
    def rays(self) -> int:
        """Of a batch."""
        ...

    def replay(self, batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Float64[Tensor, "report"]]:
        """The results for a batch, which stay what they are until the next."""
        ...


class StepGraph:
    """What ``compute`` launches for ``batch``, captured (:class:`ReplayableStep`). ``previous`` is the graph that this
    one follows, whose memory it takes over. Raises torch.OutOfMemoryError."""

    def __init__(
        self, compute: Compute, batch: HashGridBatch, weights: LossWeights, previous: ReplayableStep | None = None
    ) -> None:
        self.batch = HashGridBatch(batch.rays.each(Tensor.clone), *(part.clone() for part in batch[1:]))
        self.weights = LossWeights(*(each if each is None else each.clone() for each in weights))
        shared = previous if isinstance(previous, StepGraph) else None
        self.graph, pool = torch.cuda.CUDAGraph(), shared and shared.graph.pool()
        self.stream = shared.stream if shared else torch.cuda.Stream()
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

    def replay(self, batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Float64[Tensor, "report"]]:
        """The results for another batch."""
        given, own = ((*one.rays, *one[1:], *other) for one, other in ((batch, weights), (self.batch, self.weights)))
        for place, value in zip(own, given, strict=True):
            assert (place is None) == (value is None), "a graph has the losses it was captured with"
            if place is not None and value is not None:
                place.copy_(value)
        self.graph.replay()
        return self.result


class _Report(NamedTuple):
    """What a step will have been, once its ``numbers`` are ``ready``."""

    step: int
    batch: HashGridBatch
    numbers: Float64[Tensor, "report"]
    ready: torch.cuda.Event | None

    @classmethod
    def of(cls, step: int, batch: HashGridBatch, on_device: Float64[Tensor, "report"]) -> "_Report":
        if not on_device.is_cuda:
            return cls(step, batch, on_device, None)
        numbers, ready = torch.empty_like(on_device, device="cpu", pin_memory=True), torch.cuda.Event()
        numbers.copy_(on_device, non_blocking=True)
        ready.record()
        return cls(step, batch, numbers, ready)


class GraphTrainer:
    """Steps of a hash-grid trainer on a GPU (:class:`nerf.training.trainer.FieldTrainer`), with a backend whose kernels
    a graph may hold. The result of a step is that of the step before, and NonFinite comes one step late.

    Steps of several micro-batches, those that are profiled, and two between a graph and the next are taken as the
    ``trainer`` takes them; all of them where the GPU's memory has no place for a graph (``lacks_memory``). ``refused``
    counts the steps that exceeded capacities."""

    def __init__(self, trainer: HashGridTrainer, capture: Callable[..., ReplayableStep] = StepGraph) -> None:
        self.trainer, self.capture = trainer, capture
        self.model, self.effects = trainer.model, trainer.effects
        self.graph: ReplayableStep | None = None
        self.fits, self.lacks_memory, self.refused = True, False, 0
        self.spare = SPARE_CAPACITY
        self.unread: _Report | None = None
        self.last = StepResult(0.0, 0.0, 0, 0, 0)

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """One batch, one update."""
        trainer = self.trainer
        single = trainer.settings.micro_batches == 1 and not is_profiling() and not self.lacks_memory
        if single and self.graph is not None and self._suits(self.graph, trainer.has_depth_loss(progress)):
            return self._step_by(self.graph, step, progress, lr_scale)
        self._read()
        rays = trainer.rays_per_micro_batch()
        steady = abs(rays / max(1, self.last.rays) - 1) <= STEADY_CHANGE
        self.last, (micro_batch, *_) = trainer.take_step(step, progress, lr_scale)
        if single and steady and micro_batch.batch is not None:
            weights = trainer.loss_weights(rays, progress)
            self._capture(micro_batch.capacities, micro_batch.batch, weights)
        return self.last

    def _suits(self, graph: ReplayableStep, has_depth_loss: bool) -> bool:
        """Whether a graph is to be used for the next step."""
        alike = (graph.weights.depth is not None) == has_depth_loss
        return self.fits and alike and abs(self.trainer.rays_per_micro_batch() / graph.rays - 1) <= MAX_RAY_DRIFT

    def state(self) -> dict[str, Tensor]:
        """The trainer's."""
        return self.trainer.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` gave."""
        self.trainer.load_state(state)
        self.unread = None

    def _step_by(self, graph: ReplayableStep, step: int, progress: float, lr_scale: float) -> StepResult:
        batch = self.trainer.draw_batch(step, progress, 0, graph.rays)
        micro_batch, numbers = graph.replay(batch, self.trainer.loss_weights(graph.rays, progress))
        report = _Report.of(step, batch, numbers)
        self._read()
        self.trainer.finish_step([micro_batch], step, progress, lr_scale, graph.rays)
        self.unread = report
        return self.last

    def _capture(self, needed: SampleCapacities, batch: HashGridBatch, weights: LossWeights) -> None:
        """A graph for steps like the one that ``needed`` these capacities."""
        if not self.fits:
            self.spare *= MORE_AFTER_REFUSAL
        rays, capacities = len(batch.jitter), with_spare(needed, self.spare, self.model.stepping.max_samples)

        def compute(batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Float64[Tensor, "report"]]:
            effect_rays = self.effects.forward_rays(batch.rays, batch.view)
            found = self.trainer.differentiate(batch, effect_rays, rays, weights, capacities)
            geometry = all_finite(effect_rays)
            usable = geometry & found.fits & found.loss.isfinite() & found.grad_norm.isfinite()
            counts = found.colour_evaluations, found.density_evaluations
            numbers = found.loss, found.squared_error, found.grad_norm, geometry, found.fits, *counts
            return _zero_unless(usable, found), torch.stack([each.double() for each in numbers])

        for _ in range(2):
            try:
                self.graph, self.fits = self.capture(compute, batch, weights, self.graph), True
                return
            except torch.OutOfMemoryError:  # a capture gets no memory that steps before it have left cached
                self.graph = None
                torch.cuda.empty_cache()
        self.lacks_memory = True

    def _read(self) -> None:
        """What the step before was, once the GPU has computed it. Raises NonFinite."""
        report, self.unread = self.unread, None
        if report is None:
            return
        if report.ready is not None:
            report.ready.synchronize()
        loss, squared_error, grad_norm, geometry, fits, colours, densities = report.numbers.tolist()
        finite = {RAY_GEOMETRY: bool(geometry), "loss": math.isfinite(loss), "gradient": math.isfinite(grad_norm)}
        for quantity, is_finite in finite.items():
            if not is_finite:
                raise NonFinite(quantity, report.step, joined([report.batch]))
        rays = len(report.batch.jitter)
        if fits:
            self.trainer.count_samples(int(colours), rays)
        else:
            self.fits, self.refused = False, self.refused + 1
        self.last = StepResult(loss, psnr(squared_error), rays, int(colours), int(densities))


def with_spare(needed: SampleCapacities, spare: float, max_samples: int) -> SampleCapacities:
    """For steps like one that ``needed`` just these, ``spare`` times as many; ``max_samples``: of a ray."""

    def more(count: int) -> int:
        return math.ceil(spare * count) + MIN_SPARE_CAPACITY

    *first, last = needed.rounds
    longer = math.ceil(LONGER_LAST_ROUND * spare / SPARE_CAPACITY * last.per_ray)
    longest = min(longer, max_samples - sum(each.per_ray for each in first))
    rounds = [*first, last._replace(per_ray=longest)]
    return SampleCapacities(
        tuple(RoundSize(each.per_ray, more(each.capacity)) for each in rounds), more(needed.visible)
    )


def _zero_unless(usable: Bool[Tensor, ""], found: MicroBatch) -> MicroBatch:
    """What a micro-batch contributes, or zeros, for its points as well: 0 times the weights that a point which is not
    finite has in its cell is NaN."""

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
