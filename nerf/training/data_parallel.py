"""Data-parallel training of a hash-grid field: ranks share the micro-batches of every step.

Micro-batches are those of a training by one process: their number, their rays and their random numbers do not depend on
how many ranks there are. Each rank computes its share of them, all ranks exchange what came of it, and each takes the
same update, so that all have the same field without ever sending it.

Gradients of networks, background and effects travel micro-batch by micro-batch and are added in their order: the sums
have the bits of one process. The gradient of the table, by far the largest, is reduced in one of two ways:

* **sparse**: every rank gets the gradients of all samples' features and scatters them itself, in the order of the
  micro-batches. On the CPU the sum has the bits of one process.
* **dense**: every rank scatters its own, and the tables are added up (all-reduce): one process's sum but for rounding.

The one that moves fewer bytes is taken at each step. On a GPU it is always the dense one: a GPU scatters in any order,
so ranks that scattered for themselves would drift apart.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nerf.fields.hash_grid import HashGridField
from nerf.fields.mlp import Weights
from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import span
from nerf.runtime.ranks import Ranks, packed, packed_bytes, unpacker
from nerf.training.hash_grid_trainer import HashGridTrainer, MicroBatch
from nerf.training.trainer import RAY_GEOMETRY, NonFinite, StepResult

STEP, STATE, END = 0.0, 1.0, 2.0  # what rank 0 may ask for
COMMAND_LENGTH = 4

MakeTrainer = Callable[[int], HashGridTrainer]


class _Sizes(NamedTuple):
    """Of a micro-batch."""

    samples: int
    density_evaluations: int


class RankExchange:
    """What a trainer of one of several ranks has of the others (:class:`nerf.training.hash_grid_trainer.Exchange`).

    ``steps`` counts exchanges."""

    def __init__(self, ranks: Ranks, field: HashGridField) -> None:
        self.ranks, self.field, self.steps = ranks, field, 0
        self.is_dense = False

    def all_micro_batches(self, step: int, compute: Callable[[int], MicroBatch], count: int) -> list[MicroBatch]:
        """All micro-batches of a step, of which this rank computes its share. Raises NonFinite on every rank if one of
        them does."""
        own, failure = list[MicroBatch](), None
        try:
            own = list(in_order(compute, self.ranks.share(count), self.ranks.device))
        except NonFinite as error:
            failure = error
        with span("exchange"):
            sizes = self._gather_sizes(own, count, failed=failure is not None)
            if sizes is None:
                raise failure or NonFinite(RAY_GEOMETRY, step, {})
            self.is_dense = self._prefers_dense(sizes)
            self.steps += 1
            return self._gather(own, sizes)

    def add_up(self, grad_table: Tensor) -> None:
        """In place: the sum over the ranks."""
        with span("exchange"):
            self.ranks.add_up(grad_table)

    def _gather_sizes(self, own: Sequence[MicroBatch], count: int, failed: bool) -> list[list[_Sizes]] | None:
        """By rank, of all its micro-batches; None if a rank has failed."""
        most = -(-count // self.ranks.size)
        counts = [int(failed), len(own)] + [0] * (2 * most)
        for index, each in enumerate(own):
            counts[2 + 2 * index : 4 + 2 * index] = len(each.points), int(each.density_evaluations)
        gathered = self.ranks.gather_counts(counts)
        if any(row[0] for row in gathered):
            return None
        return [[_Sizes(row[2 + 2 * i], row[3 + 2 * i]) for i in range(row[1])] for row in gathered]

    def _prefers_dense(self, sizes: list[list[_Sizes]]) -> bool:
        if self.ranks.device.type == "cuda":
            return True
        table, most = self.field.table, max(sum(each.samples for each in of_rank) for of_rank in sizes)
        sparse = (self.ranks.size - 1) * most * self.field.layout.width * table.element_size()
        return self.ranks.add_up_bytes(table) < sparse

    def _gather(self, own: Sequence[MicroBatch], sizes: list[list[_Sizes]]) -> list[MicroBatch]:
        mine = packed([tensor for each in own for tensor in self._tensors(each)])
        small, width = self._small(own[0]), self.field.layout.width
        most = max(sum(self._bytes(small, each.samples, width) for each in of_rank) for of_rank in sizes)
        gathered = list[MicroBatch]()
        for rank, data in enumerate(self.ranks.gather_bytes(mine, most)):
            if rank == self.ranks.rank:
                gathered += own
            else:
                take = unpacker(data)
                gathered += [self._unpacked(take, own[0], of_batch) for of_batch in sizes[rank]]
        return gathered

    @staticmethod
    def _small(of: MicroBatch) -> list[Tensor]:
        """What has the same shape in all micro-batches."""
        gradients = (*of.grad_networks, *of.grad_background.values(), *of.grad_effects.values())
        return [of.loss, of.squared_error, of.grad_norm, *gradients]

    def _tensors(self, of: MicroBatch) -> list[Tensor]:
        of_samples = [of.points, of.optical_thickness]
        return self._small(of) + of_samples + ([] if self.is_dense else [of.grad_features])

    def _bytes(self, small: Sequence[Tensor], samples: int, width: int) -> int:
        point = small[0].new_empty(1).expand(samples, 1)
        features = [] if self.is_dense else [point.expand(samples, width)]
        return packed_bytes([*small, point.expand(samples, 3), point, *features])

    def _unpacked(
        self, take: Callable[[torch.dtype, Sequence[int]], Tensor], like: MicroBatch, sizes: _Sizes
    ) -> MicroBatch:
        """A micro-batch of another rank, without its rays and, where the reduction is dense, without the gradients of
        its features."""

        def next_like(tensor: Tensor) -> Tensor:
            return take(tensor.dtype, tensor.shape)

        def of_samples(tensor: Tensor) -> Tensor:
            return take(tensor.dtype, (sizes.samples, *tensor.shape[1:]))

        loss, squared_error, grad_norm = (next_like(each) for each in (like.loss, like.squared_error, like.grad_norm))
        return MicroBatch(
            batch=None,
            loss=loss,
            squared_error=squared_error,
            grad_norm=grad_norm,
            grad_networks=Weights(*map(next_like, like.grad_networks)),
            grad_background={name: next_like(each) for name, each in like.grad_background.items()},
            grad_effects={name: next_like(each) for name, each in like.grad_effects.items()},
            points=of_samples(like.points),
            optical_thickness=of_samples(like.optical_thickness),
            grad_features=like.grad_features[:0] if self.is_dense else of_samples(like.grad_features),
            colour_evaluations=torch.tensor(sizes.samples, dtype=torch.int32),
            density_evaluations=torch.tensor(sizes.density_evaluations, dtype=torch.int32),
            capacities=like.capacities,
            fits=like.fits,
        )


class LeadingTrainer:
    """The trainer of rank 0 (:class:`nerf.training.trainer.FieldTrainer`): the other ranks take each step with it.

    ``attempt`` is what they make their trainers with. They are sent the state before the first step, and after it was
    loaded anew. ``seconds`` are those of all steps but these, for which the others also read the photos;
    ``waited_seconds`` are those of them in which this rank sent, received or waited.
    """

    def __init__(self, trainer: HashGridTrainer, attempt: int, ranks: Ranks) -> None:
        self.trainer, self.attempt, self.ranks = trainer, attempt, ranks
        self.model, self.effects = trainer.model, trainer.effects
        self.exchange = trainer.exchange = RankExchange(ranks, trainer.model)
        self.others_know, self.seconds, self.waited_seconds = False, 0.0, 0.0

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """Take a step, all ranks together. Raises NonFinite and changes nothing, or RankLost."""
        if not self.others_know:
            self.ranks.command([STATE, float(self.attempt), 0.0, 0.0], COMMAND_LENGTH)
            self.ranks.copy_from_first(self.trainer.state())
            self.others_know = True
            return self._with_others(step, progress, lr_scale)
        started, waited = time.perf_counter(), self.ranks.waited_seconds
        result = self._with_others(step, progress, lr_scale)
        self.seconds += time.perf_counter() - started
        self.waited_seconds += self.ranks.waited_seconds - waited
        return result

    def _with_others(self, step: int, progress: float, lr_scale: float) -> StepResult:
        self.ranks.command([STEP, float(step), progress, lr_scale], COMMAND_LENGTH)
        return _take_step(self.trainer, self.ranks, step, progress, lr_scale)

    def state(self) -> dict[str, Tensor]:
        """That of the trainer: all ranks have the same."""
        return self.trainer.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore a saved state, of a training by any number of ranks."""
        self.trainer.load_state(state)
        self.others_know = False


def end_others(ranks: Ranks) -> None:
    """Rank 0 needs the others no longer."""
    ranks.command([END, 0.0, 0.0, 0.0], COMMAND_LENGTH)


def follow_first_rank(ranks: Ranks, make_trainer: MakeTrainer) -> None:
    """Take the steps that rank 0 asks for until it needs no more. Raises RankLost if it is gone."""
    trainer: HashGridTrainer | None = None
    while True:
        kind, number, progress, lr_scale = ranks.command(None, COMMAND_LENGTH)
        if kind == END:
            return
        if kind == STATE:
            trainer = make_trainer(int(number))
            trainer.exchange = RankExchange(ranks, trainer.model)
            trainer.load_state(ranks.copy_from_first(trainer.state()))
            continue
        assert trainer is not None, "rank 0 sends its state first"
        try:
            _take_step(trainer, ranks, int(number), progress, lr_scale)
        except NonFinite:  # rank 0 has it, too, and says what to do
            continue


def _take_step(trainer: HashGridTrainer, ranks: Ranks, step: int, progress: float, lr_scale: float) -> StepResult:
    try:
        return trainer.step(step, progress, lr_scale)
    except NonFinite as failure:
        # Every rank has it at the same place; each knows its own rays alone.
        batches = [batch for batch in ranks.gather_objects(_on_cpu(failure.batch)) if batch]
        names = batches[0] if batches else ()
        failure.batch = {name: torch.cat([batch[name] for batch in batches]) for name in names}
        raise


def _on_cpu(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.cpu() for name, tensor in batch.items()}
