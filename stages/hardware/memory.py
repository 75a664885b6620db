"""How much memory there is to take, and saying beforehand where work would need more.

What the machine has free is not what this program may take: a container is held to the limit of its control group, a
shell to that of ``ulimit``. Whoever goes beyond is killed without a word, after hours perhaps.
"""

from collections.abc import Iterator
from pathlib import Path

import psutil

from stages.contract import StageError
from stages.io.amounts import bytes_in_words

try:
    import resource
except ImportError:  # Windows
    resource = None

GROUPS = Path("/sys/fs/cgroup")
OF_PROCESS = Path("/proc/self/cgroup")
# The limit, what is taken, and under which name how much of that is files kept for speed alone: version 2, version 1.
NAMES = {
    "": ("memory.max", "memory.current", "inactive_file"),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def available_bytes() -> int:
    """Memory that this process may still take: the least that the machine, its groups and its limits leave."""
    rooms = [psutil.virtual_memory().available, *rooms_in_groups(OF_PROCESS, GROUPS), *_rooms_in_limits()]
    return max(0, min(rooms))


def available_on(device: str) -> int:
    """Memory that tensors on ``device`` ("cpu" or "cuda") may still take; what torch holds in reserve on a GPU is
    free, too."""
    if device == "cpu":
        return available_bytes()
    import torch

    return torch.cuda.mem_get_info()[0] + torch.cuda.memory_reserved() - torch.cuda.memory_allocated()


def check_memory(needed: float, what: str, why: str, hint: str) -> None:
    """Raises StageError where ``what`` needs more than there is; ``why`` says what takes that much."""
    free = available_bytes()
    if needed > free:
        raise StageError(
            "hardware.not-enough-memory",
            f"not enough memory for {what}",
            f"{why} {bytes_in_words(needed)}, and only {bytes_in_words(free)} are free",
            hint,
        )


def at_once(count: int, each: float) -> int:
    """How many of ``count`` pieces of work that take ``each`` bytes fit into memory together, at least one."""
    return max(1, min(count, int(available_bytes() / each)))


def rooms_in_groups(of_process: Path, mounted: Path) -> Iterator[int]:
    """What the control groups of Linux leave, of the process's own up to the root; nothing elsewhere or without limits.

    In a container the path may be that of the host, of which only the root can be seen: it is the container's own then.
    """
    try:
        lines = of_process.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        for controller in {"", "memory"} & set(controllers.split(",")):
            folder = mounted / controller / path.lstrip("/")
            while folder.is_relative_to(mounted / controller):
                if (room := _room(folder, *NAMES[controller])) is not None:
                    yield room
                folder = folder.parent


def _room(folder: Path, limit: str, taken: str, cached: str) -> int | None:
    try:
        most = (folder / limit).read_text().strip()
        if most == "max":
            return None
        statistics = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return int(most) - int((folder / taken).read_text()) + int(statistics.get(cached, 0))
    except OSError:  # the group lies outside of the container, or the root, which has no limit
        return None


def _rooms_in_limits() -> Iterator[int]:
    """What ``ulimit -v`` and ``ulimit -d`` leave, where the system has them."""
    if resource is None:
        return
    taken = psutil.Process().memory_info()
    for limit, used in ((resource.RLIMIT_AS, taken.vms), (resource.RLIMIT_DATA, getattr(taken, "data", 0))):
        most = resource.getrlimit(limit)[0]
        if most != resource.RLIM_INFINITY:
            yield most - used
