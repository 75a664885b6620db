"""Launches Warp kernels on torch tensors, at a few microseconds each.

``wp.launch`` with ``wp.from_torch`` costs 50 to 100 microseconds of Python, as long as many of these kernels run. So a
launch is recorded once per thread, kernel and device; afterwards only pointers, lengths and numbers are set anew. On
the CPU a launch runs on the calling thread, with Python's lock released: the caller's threads are the parallelism.
"""

import threading
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from nerf.runtime.parallel import workers

wp.config.log_level = wp.LOG_ERROR  # a machine without a GPU is no news, nor is each module compiled
# Else every kernel on x86, with tiles or without, notes in one static pointer where its stack is: threads race for it
# (seen to crash in debug mode). None means: on the stack only where a register of the thread holds that pointer.
wp.config.enable_tiles_in_stack_memory = None
wp.init()

Argument = Tensor | int | float
MAX_ENTRIES = 2**31 - 1  # of an array: Warp counts them in 32 bits

TORCH_TYPES = {
    wp.float32: torch.float32,
    wp.float64: torch.float64,
    wp.int32: torch.int32,
    wp.int64: torch.int64,
    wp.uint8: torch.uint8,
}

vec16 = wp.types.vector(length=16, dtype=wp.float32)  # a cache line: rows of 64 numbers are four, and add as vectors do


PACKAGE = "nerf.kernels.warp"


def unavailable_reason(device: str) -> str | None:
    """What keeps Warp's kernels from running on ``device`` ("cpu" or "cuda"); None if nothing does."""
    if device == "cpu" or wp.is_cuda_available():
        return None
    return f"Warp {wp.config.version} finds no CUDA driver that is new enough for it"


def compile_kernels(device: str) -> None:
    """Have all kernels ready on ``device``: seconds the first time, afterwards they come from the user's cache."""
    with _recording:
        wp.load_module(PACKAGE, device, recursive=True, max_workers=workers())


class _Array(NamedTuple):
    """What a kernel asks of an array: torch's type of its numbers, and how many make an entry."""

    dtype: torch.dtype
    numbers: int


class _Recorded(NamedTuple):
    """A launch with its arguments, in place to be changed; ``arrays`` has None where a number is wanted."""

    launch: Any
    arrays: tuple[_Array | None, ...]


_thread_local = threading.local()  # a recorded launch is changed before each run, so no two threads may share one
_recording = threading.Lock()  # recording may compile and load code: twice at once would unload what already runs


def launch(kernel: wp.Kernel, count: int, *arguments: Argument) -> None:
    """Run ``kernel`` for ``wp.tid()`` = 0 ... count - 1, on the device of its first tensor.

    Tensors are read as rows of what the kernel declares: (n, 8) float32 as 2 n entries of ``wp.vec4``. Raises TypeError
    for a tensor that the kernel cannot read: of another type, not contiguous, not a whole number of entries, or in
    another memory than the first; and for a number in place of a tensor or the other way round.
    """
    if count == 0:
        return
    device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
    on_gpu = device.type == "cuda"
    launches: dict[tuple[wp.Kernel, torch.device], _Recorded] = vars(_thread_local).setdefault("launches", {})
    recorded = launches.get((kernel, device))
    if recorded is None:
        with _recording:
            recorded = launches[kernel, device] = _record(kernel, device)
    ready = recorded.launch
    for place, (array, argument) in enumerate(zip(recorded.arrays, arguments, strict=True), 1):
        if isinstance(argument, Tensor):
            elsewhere = argument.device != device
            if array is None or elsewhere or argument.dtype is not array.dtype or not argument.is_contiguous():
                raise TypeError(_unreadable(kernel, place, array, device, argument))
            entries, rest = divmod(argument.numel(), array.numbers)
            if rest:
                raise TypeError(_unreadable(kernel, place, array, device, argument))
            if entries > MAX_ENTRIES:
                name = kernel.adj.args[place - 1].label
                raise TypeError(f"{kernel.key}: {name} has {entries:,} entries; Warp counts to {MAX_ENTRIES:,}")
            entry = ready.params[place]
            entry.data, entry.shape[0] = argument.data_ptr(), entries
        elif array is None:
            ready.params[place].value = argument
        else:
            raise TypeError(_unreadable(kernel, place, array, device, argument))
    # In place, as set_dim would, which takes longer than all the rest of this function.
    ready.bounds.shape[0] = ready.bounds.size = count
    ready.launch(wp.stream_from_torch(device) if on_gpu else None)


def _record(kernel: wp.Kernel, device: torch.device) -> _Recorded:
    """With zeros and null pointers, all of which are set before it runs."""
    types, where = [declared.type for declared in kernel.adj.args], wp.device_from_torch(device)
    arrays = tuple(_array(declared.dtype) if hasattr(declared, "dtype") else None for declared in types)
    inputs = [
        0 if array is None else wp.array(ptr=0, dtype=declared.dtype, shape=1, device=where)
        for declared, array in zip(types, arrays, strict=True)
    ]
    return _Recorded(wp.launch(kernel, dim=1, inputs=inputs, device=where, record_cmd=True), arrays)


def _array(entry: Any) -> _Array:
    number = getattr(entry, "_wp_scalar_type_", entry)
    return _Array(TORCH_TYPES[number], wp.types.type_size_in_bytes(entry) // wp.types.type_size_in_bytes(number))


def _unreadable(kernel: wp.Kernel, place: int, array: _Array | None, device: torch.device, argument: Argument) -> str:
    name = kernel.adj.args[place - 1].label
    wanted = "a number" if array is None else f"contiguous {array.dtype} in entries of {array.numbers} on {device}"
    found = str(argument)
    if isinstance(argument, Tensor):
        layout = "contiguous" if argument.is_contiguous() else "not contiguous"
        found = f"{tuple(argument.shape)} {argument.dtype}, {layout}, on {argument.device}"
    return f"{kernel.key}: {name} must be {wanted}; it is {found}"
