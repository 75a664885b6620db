"""Several processes that compute one training (*ranks*, by torch.distributed): what they tell each other.

Rank 0 leads: it alone decides what is done next, and the others listen. A training by one process makes no
:class:`Ranks` and initialises nothing here.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import UInt8
from torch import Tensor
from torch.distributed.distributed_c10d import Store

# Between two steps rank 0 may evaluate, and write a checkpoint; a rank that dies closes its connections and is noticed
# at once.
TIMEOUT = timedelta(minutes=30)
ALIGNMENT = 64  # bytes: a cache line, and more than any kernel asks for


class RankLost(Exception):
    """Another rank is gone, or does not answer: this one cannot go on."""


class Ranks:
    """This process as number ``rank`` of ``size``, whose tensors are on ``device``.

    Tensors go by NCCL from GPU to GPU where ``nccl``, else by gloo through the CPU's memory. ``received_bytes`` counts
    what the other ranks' tensors brought here, messages of a few bytes left out; ``waited_seconds`` what all of that
    took, and for how long other ranks were not ready.
    """

    def __init__(self, rank: int, size: int, device: torch.device, nccl: bool) -> None:
        self.rank, self.size, self.device = rank, size, device
        self.backend = "nccl" if nccl else "gloo"
        self.transport = device if nccl else torch.device("cpu")
        self.received_bytes, self.waited_seconds = 0, 0.0

    @classmethod
    def join(cls, store: Store, rank: int, size: int, device: torch.device) -> "Ranks":
        """Meet the others at ``store``; returns when all ``size`` ranks are there. Raises RankLost if they are not."""
        nccl = device.type == "cuda" and dist.is_nccl_available()
        backend, ranks = "cpu:gloo,cuda:nccl" if nccl else "gloo", cls(rank, size, device, nccl)
        with ranks._waiting():
            dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=TIMEOUT)
        ranks.waited_seconds = 0.0
        return ranks

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        """torch.distributed raises RuntimeError, or something derived from it, where another rank is gone."""
        started = time.perf_counter()
        try:
            yield
        except RuntimeError as error:
            raise RankLost(" ".join(str(error).split())) from error
        self.waited_seconds += time.perf_counter() - started

    def share(self, count: int) -> range:
        """Which of ``count`` pieces of work are this rank's: neighbours, as many as others have, or one more."""
        return range(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def command(self, numbers: Sequence[float] | None, length: int) -> list[float]:
        """The ``length`` numbers that rank 0 gives; other ranks give None and wait for them."""
        told = torch.zeros(length, dtype=torch.float64)
        if numbers is not None:
            told.copy_(torch.tensor(numbers, dtype=torch.float64))
        with self._waiting():
            dist.broadcast(told, 0)
        return told.tolist()

    def copy_from_first(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Rank 0's tensors of these names and shapes; of other ranks only names and shapes count."""
        copies = {name: tensors[name].to(self.transport, copy=True).contiguous() for name in sorted(tensors)}
        with self._waiting():
            for each in copies.values():
                dist.broadcast(each, 0)
        return {name: each.to(tensors[name].device) for name, each in copies.items()}

    def gather_counts(self, counts: Sequence[int]) -> list[list[int]]:
        """As many whole numbers of every rank, in the order of ranks."""
        own = torch.tensor(counts, dtype=torch.int64)
        gathered = [torch.empty_like(own) for _ in range(self.size)]
        with self._waiting():
            dist.all_gather(gathered, own)
        return [each.tolist() for each in gathered]

    def gather_bytes(self, own: UInt8[Tensor, "own_bytes"], most: int) -> list[UInt8[Tensor, "most_bytes"]]:
        """The bytes of every rank, in the order of ranks, each with anything behind it up to ``most`` bytes, which all
        ranks name alike."""
        padded = own.new_empty(most, device=self.transport)
        padded[: len(own)].copy_(own)
        gathered = [torch.empty_like(padded) for _ in range(self.size)]
        with self._waiting():
            dist.all_gather(gathered, padded)
            self.received_bytes += (self.size - 1) * most
            return [each.to(self.device) for each in gathered]

    def add_up(self, tensor: Tensor) -> None:
        """In place: the sum of all ranks' tensors, the same bits on every rank."""
        travelling = tensor.to(self.transport)
        with self._waiting():
            dist.all_reduce(travelling)
            tensor.copy_(travelling)
        self.received_bytes += self.add_up_bytes(tensor)

    def add_up_bytes(self, tensor: Tensor) -> int:
        """What :meth:`add_up` brings to each rank: parts of sums in one round, sums in another."""
        return 2 * (self.size - 1) * tensor.numel() * tensor.element_size() // self.size

    def gather_objects(self, own: Any) -> list[Any]:
        """Any small object of every rank, in the order of ranks."""
        gathered: list[Any] = [None] * self.size
        with self._waiting():
            dist.all_gather_object(gathered, own)
        return gathered


def leave() -> None:
    """Take part no longer, as far as this process does: joining may have failed. The others notice when they next wait
    for this rank."""
    if dist.is_initialized():
        dist.destroy_process_group()


def packed(tensors: Sequence[Tensor]) -> UInt8[Tensor, "bytes"]:
    """Tensors on one device as bytes, each from a multiple of ALIGNMENT on."""
    pieces = []
    for tensor in tensors:
        raw = tensor.contiguous().view(-1).view(torch.uint8)
        pieces += [raw, raw.new_zeros(-len(raw) % ALIGNMENT)]
    return torch.cat(pieces)


def packed_bytes(like: Sequence[Tensor]) -> int:
    """How many bytes :func:`packed` makes of tensors like these."""
    sizes = (tensor.numel() * tensor.element_size() for tensor in like)
    return sum(size + -size % ALIGNMENT for size in sizes)


def unpacker(data: UInt8[Tensor, "bytes"]) -> Callable[[torch.dtype, Sequence[int]], Tensor]:
    """The inverse of :func:`packed`: each call gives the next tensor, of this type and shape, without a copy."""
    offset = 0

    def take(dtype: torch.dtype, shape: Sequence[int]) -> Tensor:
        nonlocal offset
        size = dtype.itemsize * torch.Size(shape).numel()
        raw = data[offset : offset + size]
        offset += size + -size % ALIGNMENT
        return raw.view(dtype).view(shape)

    return take
