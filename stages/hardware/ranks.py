"""Starting the processes of a training on several devices (ranks), or meeting those that torchrun started.

Rank 0 is the program that the user talks to; it alone reads options, writes and speaks. The others wait at a store
(torch's TCPStore, which torchrun or rank 0 keeps) for a task: what to train, as JSON. They read the same folders, so on
several machines the workspace lies where all can read it.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from stages.contract import StageError
from stages.hardware.child_process import child_environment
from stages.hardware.device import compute_device, processors

if TYPE_CHECKING:
    from torch.distributed.distributed_c10d import Store

    from nerf.runtime.ranks import Ranks

OF_LAUNCHER = ("TORCHELASTIC_RUN_ID", "RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # of each of its processes
FOLLOW = ["-P", "-c", "from stages.train.training import follow; follow()"]
POLL_SECONDS, STARTING_SECONDS, ENDING_SECONDS = 0.05, 300.0, 5.0
NO_TASK = "null"
RESUME_HINT = "`pipeline resume WORKSPACE` continues from the last checkpoint, with any number of devices."


class Place(NamedTuple):
    """Which process of how many this is."""

    rank: int
    size: int


def launched() -> Place:
    """This process among those of torchrun; alone where another program started it."""
    if any(name not in os.environ for name in OF_LAUNCHER):
        return Place(0, 1)
    return Place(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))


def rank_count(devices: int) -> int:
    """How many processes train together where ``--train.devices`` is ``devices``: as many as torchrun started, if it
    did."""
    size = launched().size
    return devices if size == 1 else size


def check_ranks(devices: int, micro_batches: int) -> None:
    """Raise StageError where so many processes cannot share so many micro-batches, or lack GPUs."""
    size, launcher = rank_count(devices), launched().size
    if devices not in (1, size):
        raise StageError(
            "hardware.two-launchers",
            "torchrun and --train.devices ask for different numbers of devices",
            f"torchrun started {launcher} processes, --train.devices asks for {devices}",
            "Leave out --train.devices, or torchrun.",
        )
    if size > micro_batches:
        raise StageError(
            "hardware.too-many-devices",
            "more devices than micro-batches",
            f"a step has {micro_batches} micro-batches, each computed by one of {size} devices",
            f"Give --train.grid.micro-batches {size}, or at most {micro_batches} devices.",
        )
    if launcher > 1 or compute_device() == "cpu":
        return
    import torch

    if size > (found := torch.cuda.device_count()):
        raise StageError(
            "hardware.too-few-devices",
            "not enough GPUs",
            f"this machine has {found} of {size} GPUs",
            f"Give --train.devices {found}.",
        )


def lost_rank(why: str) -> StageError:
    """The error where a rank is gone, as far as is known for the reason ``why``."""
    return StageError("hardware.rank-lost", "one of the processes that train together is gone", why, RESUME_HINT)


Child = tuple[subprocess.Popen[bytes], IO[bytes]]
"""A rank that this process started, and the file of its complaints."""

_tasks = 0  # that this process, rank 0, has given to ranks of torchrun


@contextmanager
def leading(devices: int, task: dict[str, Any]) -> "Iterator[Ranks]":
    """Have ``task`` done by all ranks; on leaving, the others do it no longer. Raises StageError where one of them does
    not come, or is gone."""
    from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]
    from torch.distributed.distributed_c10d import PrefixStore

    from nerf.runtime.ranks import RankLost, leave

    size, children = rank_count(devices), dict[int, Child]()
    if launched().size > 1:
        store = _numbered(_store_of_launcher(), _next_task())
    else:
        kept = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
        store = _numbered(kept, 0)
        children = {rank: _child(rank, size, kept.port) for rank in range(1, size)}
    try:
        store.set("task", json.dumps(task | {"device": compute_device()}))
        _await_others(store, size, children)
        yield _joined(PrefixStore("group", store), Place(0, size))
    except RankLost as error:
        raise lost_rank(_ended(children, wait=ENDING_SECONDS) or str(error)) from error
    finally:
        leave()
        for child, complaints in children.values():
            _end(child)
            complaints.close()


def end_launched() -> None:
    """Rank 0 of torchrun has done all that it was asked: the others, which wait for a task, may end."""
    if launched().size > 1:
        with suppress(RuntimeError):  # whoever kept the store has ended already, and with it the others
            _numbered(_store_of_launcher(), _next_task()).set("task", NO_TASK)


def tasks_of_first_rank() -> "Iterator[tuple[dict[str, Any], Ranks]]":
    """On any other rank: the tasks that rank 0 gives, one after another, each with the ranks that do it; ends with rank
    0."""
    from torch.distributed.distributed_c10d import PrefixStore

    from nerf.runtime.ranks import leave

    _take_device()
    number, store = 0, _store_of_launcher()
    while True:
        numbered = _numbered(store, number)
        while not numbered.check(["task"]):
            time.sleep(POLL_SECONDS)
        if (task := json.loads(numbered.get("task"))) is None:
            return
        if (own := compute_device()) != task["device"]:  # they could not understand each other
            sys.exit(f"rank {launched().rank} computes on {own}, rank 0 on {task['device']}")
        numbered.set(f"ready {launched().rank}", "")
        try:
            yield task, _joined(PrefixStore("group", numbered), launched())
        finally:
            leave()
        number += 1


def _joined(store: "Store", place: Place) -> "Ranks":
    import torch

    from nerf.runtime.ranks import Ranks

    return Ranks.join(store, place.rank, place.size, torch.device(compute_device()))


def _next_task() -> int:
    """The number of the next task for ranks of torchrun."""
    global _tasks
    _tasks += 1
    return _tasks - 1


def _numbered(store: "Store", number: int) -> "Store":
    """Where a task lies; another one after torchrun has restarted its processes."""
    from torch.distributed.distributed_c10d import PrefixStore

    return PrefixStore(f"pipeline/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}/{number}", store)


def _store_of_launcher() -> "Store":
    from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]

    keeps = launched().rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    return TCPStore(address, port, is_master=keeps, wait_for_workers=False, timeout=timedelta(seconds=STARTING_SECONDS))


def _take_device() -> None:
    """Before the first use of a GPU: this process sees its own alone, the first one as everywhere in this program."""
    local = int(os.environ.get("LOCAL_RANK", "0"))
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(local)] * (local + 1) if visible is None else visible.split(",")
    os.environ["CUDA_VISIBLE_DEVICES"] = names[local] if local < len(names) else ""


def _child(rank: int, size: int, port: int) -> Child:
    """A rank on this machine, and where it complains. Ctrl-C is this process's to hear."""
    place = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    threads = max(1, processors() // size)
    own = {name: str(value) for name, value in (place | {"OMP_NUM_THREADS": threads}).items()}
    complaints = tempfile.TemporaryFile()  # noqa: SIM115, closed with the process
    child = subprocess.Popen(
        [sys.executable, *FOLLOW],
        stdin=subprocess.DEVNULL,
        stdout=complaints,
        stderr=complaints,
        env=child_environment() | own | {"TORCHELASTIC_RUN_ID": "own", "TORCHELASTIC_USE_AGENT_STORE": "True"},
        start_new_session=True,
    )
    return child, complaints


def _await_others(store: "Store", size: int, children: dict[int, Child]) -> None:
    """Until all have the task. Raises StageError if one of the children ends, or not all come in time."""
    missing, until = [f"ready {rank}" for rank in range(1, size)], time.monotonic() + STARTING_SECONDS
    while not store.check(missing):
        if why := _ended(children):
            raise lost_rank(why)
        if time.monotonic() > until:
            raise lost_rank(f"not all ranks have started within {STARTING_SECONDS:.0f} s")
        time.sleep(POLL_SECONDS)


def _ended(children: dict[int, Child], wait: float = 0.0) -> str | None:
    """Which child has ended, one that was killed before those that ended of it; None if none does within ``wait``
    seconds."""
    until = time.monotonic() + wait
    while True:
        ended = {rank: status for rank, (child, _) in children.items() if (status := child.poll()) is not None}
        if ended:
            rank, status = min(ended.items(), key=lambda each: each[1])
            return f"rank {rank} ended with {_ending(status)}{_last_words(children[rank][1])}"
        if time.monotonic() >= until:
            return None
        time.sleep(POLL_SECONDS)


def _ending(status: int) -> str:
    return f"signal {-status}" if status < 0 else f"exit code {status}"


def _last_words(complaints: IO[bytes]) -> str:
    complaints.seek(0)
    lines = complaints.read().decode(errors="replace").split("\n")
    said = [line.strip() for line in lines if line.strip()]
    return f" ({said[-1]})" if said else ""


def _end(child: subprocess.Popen[bytes]) -> None:
    """It ends by itself where it was told so, or sees that this process is gone; not all can wait for that."""
    try:
        child.wait(ENDING_SECONDS if child.poll() is None else 0)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
