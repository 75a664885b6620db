"""Where tensors are computed. Not a setting: it must not enter any key, so that a result is valid on any machine."""

import os


def processors() -> int:
    """How many of the CPU's cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def compute_device() -> str:
    """ "cuda" where torch can use a GPU, else "cpu"; set CUDA_VISIBLE_DEVICES to nothing to stay on the CPU.

    Has a side effect on the CPU: from the first call on torch's own threads are off in this whole program, and its
    cores are shared out among chunks of work instead (nerf/runtime/parallel.py).
    """
    import torch

    from nerf.runtime.parallel import take_over_cores

    if torch.cuda.is_available():
        return "cuda"
    take_over_cores()
    return "cpu"


def cores() -> int:
    """How many chunks of work are computed at once: the CPU's cores, or 1 on a GPU, which divides work itself."""
    from nerf.runtime.parallel import workers

    return workers() if compute_device() == "cpu" else 1
