"""Independent pieces of work given to the machines of a Ray cluster (--cluster); without one they are done here.

A stage gives :func:`fan_out` a function and the items to call it with. Both must pickle: a function of a module, or a
partial of one. What the function is bound to travels once to each process, an item with every call, results back: so
photos and large results stay in files, in folders that all machines see, and what many items need goes through
:func:`share`. A result may depend on nothing but function and item, so that a piece may be done again where its process
dies, and by any machine.

Only this module knows Ray, and loads it only where a cluster was asked for. One remote function runs every work; few
pieces are under way at a time.
"""

import importlib.metadata
import itertools
import logging
import math
import os
import secrets
import signal
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from stages.contract import StageError, listed
from stages.hardware.child_process import child_environment
from stages.io.amounts import counted

Item = TypeVar("Item")
Result = TypeVar("Result")
Place = Literal["core", "machine"]
"""What a piece of work takes: one core, or all cores of a machine, with a GPU where the cluster has any."""

INSTALL = 'pip install -c constraints.txt ".[cluster]" in the clone'
MAX_RETRIES = 5  # of a piece whose process died; what ends a process each time is given up then
MAX_WAITING = 16  # results that wait for an earlier one, for each piece under way
POLL_SECONDS, REACH_SECONDS, LOST_SECONDS, PROBE_SECONDS = 1.0, 10.0, 15.0, 300.0
COMPARED = ("pipeline-nerf", "numpy", "opencv-contrib-python-headless", "pycolmap", "ray", "torch")
RESUME_HINT = "Finished work is kept: `pipeline resume WORKSPACE` continues, with --cluster or without."


class Machine(NamedTuple):
    """A machine that takes work."""

    id: str
    host: str
    cores: int
    gpus: int


@dataclass(frozen=True)
class Cluster:
    """A cluster that this process belongs to. ``address`` is the one of its head, ``ray`` the library."""

    ray: Any
    address: str
    machines: tuple[Machine, ...]

    @property
    def machine_share(self) -> dict[str, int]:
        """What "machine" stands for: what the smallest machine has, a GPU with its share of the cores."""
        gpus = [machine for machine in self.machines if machine.gpus]
        if gpus:
            return {"num_cpus": min(max(1, one.cores // one.gpus) for one in gpus), "num_gpus": 1}
        return {"num_cpus": min(machine.cores for machine in self.machines)}

    def at_once(self, place: Place) -> int:
        """How many pieces of work the cluster does at a time."""
        if place == "core":
            return sum(machine.cores for machine in self.machines)
        share = self.machine_share
        if "num_gpus" in share:
            return sum(machine.gpus for machine in self.machines)
        return sum(machine.cores // share["num_cpus"] for machine in self.machines)


_joined: Cluster | None = None


def address() -> str | None:
    """Of the cluster that this process belongs to; None without one."""
    return _joined and _joined.address


def at_once(place: Place) -> int:
    """How many pieces of work the cluster does at a time; 1 without one."""
    return 1 if _joined is None else _joined.at_once(place)


def described() -> list[str]:
    """The cluster in words, for the first line of a run; nothing without one."""
    if _joined is None:
        return []
    cores, gpus = (sum(getattr(one, name) for one in _joined.machines) for name in ("cores", "gpus"))
    counts = [counted(len(_joined.machines), "machine"), counted(cores, "core")]
    return [f"cluster of {', '.join([*counts, *([counted(gpus, 'GPU')] if gpus else [])])}"]


@contextmanager
def joined(address: str | None, seen: Sequence[Path] = ()) -> Iterator[None]:
    """The block, with :func:`fan_out` on the cluster at ``address`` (HOST:PORT, or auto: the one that this machine
    belongs to); None: without one. All machines must see the folders ``seen``, and be able to read what this one writes
    into the first.

    Raises:
        StageError: without Ray, without a cluster there, or where a machine cannot do the work.
    """
    global _joined
    if address is None:
        yield
        return
    cluster = _join(address)
    try:
        _check_machines(cluster, [folder.absolute() for folder in seen])
        _joined = cluster
        yield
    finally:
        _joined = None
        cluster.ray.shutdown()


def fan_out(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    here: Callable[[Callable[[Item], Result], Iterable[Item]], Iterable[Result]] = map,
    place: Place = "core",
) -> Iterator[Result]:
    """``work(item)`` for every item, in order: on the cluster where there is one, else by ``here``.

    An item is taken only when there is room for it, so it may depend on results so far. Raises what ``work`` raises;
    StageError where a piece of it ended its process again and again, or where the cluster is gone.
    """
    if _joined is None:
        yield from here(work, items)
        return
    early, due = dict[int, Result](), 0
    for number, result in _numbered(_joined, work, items, place):
        early[number] = result
        while due in early:
            yield early.pop(due)
            due += 1


def share(value: Result) -> Callable[[], Result]:
    """What gives a value that many items need, here and in work. Each machine fetches it once; its processes have the
    arrays in it, read-only, in common. Raises StageError where the cluster is gone."""
    if _joined is None:
        return lambda: value
    if not _answers(_joined.address, REACH_SECONDS):  # Ray would end this process without a word
        raise _lost(_joined)
    return partial(_fetch, _joined.ray.put(value))


def _numbered(
    cluster: Cluster, work: Callable[[Item], Result], items: Iterable[Item], place: Place
) -> Iterator[tuple[int, Result]]:
    """Every result as soon as it is there, with the place of its item among all."""
    task, shared, limit = _task(cluster, place), share(work), cluster.at_once(place)
    pending, coming, number, left = dict[Any, int](), iter(items), 0, True
    try:
        while left or pending:
            oldest = min(pending.values(), default=number)
            if left and len(pending) < limit and number - oldest < MAX_WAITING * limit:
                for item in itertools.islice(coming, 1):
                    pending[task.remote(shared, item)] = number
                    number += 1
                    break
                else:
                    left = False
                continue
            done = _await_one(cluster, list(pending))
            yield pending.pop(done), _result(cluster, done)
    finally:
        for each in pending if _joined is cluster else ():
            with suppress(cluster.ray.exceptions.RayError):  # a cluster that is gone has forgotten it
                cluster.ray.cancel(each, force=True)


def _await_one(cluster: Cluster, pending: list[Any]) -> Any:
    """The first of the pieces to be done. Raises StageError where the cluster is gone."""
    silent_since = None
    while True:
        done, _ = cluster.ray.wait(pending, num_returns=1, timeout=POLL_SECONDS)
        if done:
            return done[0]
        if _answers(cluster.address, POLL_SECONDS):
            silent_since = None
            continue
        silent_since = silent_since or time.monotonic()
        if time.monotonic() - silent_since > LOST_SECONDS:  # long before Ray ends this process without a word
            raise _lost(cluster)


def _result(cluster: Cluster, reference: Any) -> Any:
    errors = cluster.ray.exceptions
    try:
        return cluster.ray.get(reference)
    except errors.RayTaskError as error:
        if isinstance(error.cause, errors.RayError):  # what it needs has gone with a machine
            raise _lost(cluster) from error
        raise error.cause from None  # as it would have been raised here
    except (errors.WorkerCrashedError, errors.OutOfMemoryError) as error:
        what = "a task on the cluster failed again and again: its process died each time"
        why = f"most likely a machine's memory ran out ({_first_line(error)})"
        raise StageError("hardware.cluster-work-lost", what, why, RESUME_HINT) from error
    except errors.RayError as error:
        raise _lost(cluster) from error


def _lost(cluster: Cluster) -> StageError:
    why = f"nothing answers at {cluster.address} any more, or its machines are gone"
    return StageError("hardware.cluster-lost", "the cluster is gone", why, RESUME_HINT)


# --- on a machine of the cluster

_work: tuple[str, Any] | None = None  # the latest, with what it has cached


def _do(shared: Any, item: Any) -> Any:
    """A piece of work; its function is fetched by each process once."""
    global _work
    name = shared.args[0].hex()
    if _work is None or _work[0] != name:
        _work = name, shared()
    return _work[1](item)


def _fetch(reference: Any) -> Any:
    import ray  # pyright: ignore[reportMissingImports]

    return ray.get(reference)


@lru_cache(maxsize=4)
def _task(cluster: Cluster, place: Place) -> Any:
    share = {"num_cpus": 1} if place == "core" else cluster.machine_share
    threads = str(share["num_cpus"])
    return cluster.ray.remote(max_retries=MAX_RETRIES, runtime_env={"env_vars": _environment(threads)}, **share)(_do)


def _environment(threads: str) -> dict[str, str]:
    """Of a process for work. It finds our modules as other processes of ours do. Threads inside linear algebra are as
    many as its cores, 1 where each core has a piece of its own."""
    return {
        "PYTHONPATH": child_environment()["PYTHONPATH"],
        "OMP_NUM_THREADS": threads,
        "OPENBLAS_NUM_THREADS": threads,
    }


# --- joining


def _join(address: str) -> Cluster:
    ray = _ray()
    if address != "auto" and not _answers(address, REACH_SECONDS):
        raise _unreachable(address, "nothing answers there, or it is no HOST:PORT")
    kept = signal.getsignal(signal.SIGTERM)
    ray._private.worker._worker_logs_enabled = False  # it would print on standard output, of which we make JSON
    try:
        context = ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False)
    except (ConnectionError, RuntimeError, ValueError, OSError, AssertionError, ray.exceptions.RayError) as error:
        raise _unreachable(address, _first_line(error)) from error
    finally:
        signal.signal(signal.SIGTERM, kept)  # Ray has one of its own
    machines = []
    for node in ray.nodes():
        cores = math.floor(node["Resources"].get("CPU", 0))
        if node["Alive"] and cores:
            gpus = math.floor(node["Resources"].get("GPU", 0))
            machines.append(Machine(node["NodeID"], node["NodeManagerHostname"], cores, gpus))
    cluster = Cluster(ray, context.address_info["gcs_address"], tuple(machines))
    if not machines:
        ray.shutdown()
        raise _unreachable(address, "none of its machines has a core for work")
    return cluster


def _ray() -> Any:
    # Before it is loaded. What goes wrong with a piece is raised where its result is wanted, and where the cluster goes
    # while nothing is asked of it, Ray is not to end this process: the stage at work needs no cluster.
    os.environ |= {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_IGNORE_UNHANDLED_ERRORS": "1",
        "RAY_gcs_rpc_server_reconnect_timeout_s": str(10**6),
    }
    try:
        import ray  # pyright: ignore[reportMissingImports] -- not part of what tests install
    except ImportError as error:
        what, why = "--cluster needs Ray", "it is not installed in this environment"
        hint = f"Install it, in the same version as on the cluster: {INSTALL}"
        raise StageError("hardware.no-ray", what, why, hint) from error
    return ray


def _answers(address: str, seconds: float) -> bool:
    """Whether something listens at HOST:PORT."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), seconds).close()
    except (OSError, ValueError, OverflowError):
        return False
    return True


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _unreachable(address: str, why: str) -> StageError:
    hint = "Start one with `ray start --head`, or let this machine join it with `ray start --address=HOST:PORT`."
    what = "no Ray cluster on this machine" if address == "auto" else f"cannot join a Ray cluster at {address}"
    return StageError("hardware.no-cluster", what, why, hint)


# --- what every machine must have


class _Probe(NamedTuple):
    """What a machine says of itself: which folders it does not see, and its versions."""

    missing: list[str]
    versions: dict[str, str]


_Probes = list[tuple[Machine, _Probe]]


def _probe(file: str, token: str, folders: Sequence[str]) -> _Probe:
    missing = [folder for folder in folders if not os.path.exists(folder)]
    try:
        found = Path(file).read_text("utf-8")
    except OSError:
        found = ""
    if found != token and folders[0] not in missing:
        missing.append(folders[0])  # a folder of the same name, not the same folder
    return _Probe(missing, _versions())


def _versions() -> dict[str, str]:
    def version(name: str) -> str:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            return "none"

    return {name: version(name) for name in COMPARED}


def _check_machines(cluster: Cluster, folders: Sequence[Path]) -> None:
    """Raise StageError unless all machines see the ``folders``, read what is written into the first, and have the same
    versions of what computes."""
    if not folders:
        return
    file, token = folders[0] / f".cluster-{secrets.token_hex(4)}", secrets.token_hex(16)
    file.write_text(token, "utf-8")
    try:
        probes = _ask_all(cluster, str(file), token, [str(folder) for folder in folders])
    finally:
        file.unlink(missing_ok=True)
    _check_folders(probes)
    _check_versions(probes)


def _check_folders(probes: _Probes) -> None:
    blind = {machine.host: probe.missing[0] for machine, probe in probes if probe.missing}
    if blind:
        what = f"{listed(sorted(blind), 3)} cannot read {next(iter(blind.values()))} as this machine does"
        why = "all machines work in the same folders, under the same paths"
        hint = "Put photos and workspace (-o) on storage that all machines mount at the same place."
        raise StageError("hardware.not-shared", what, why, hint)


def _check_versions(probes: _Probes) -> None:
    own = _versions()
    for machine, probe in probes:
        if differ := [name for name in COMPARED if probe.versions[name] != own[name]]:
            what = f"{machine.host} has {differ[0]} {probe.versions[differ[0]]}, this machine {own[differ[0]]}"
            why, hint = "results would depend on which machine computes", f"Install the same there: {INSTALL}"
            raise StageError("hardware.cluster-versions", what, why, hint)


def _ask_all(cluster: Cluster, file: str, token: str, folders: list[str]) -> _Probes:
    """What every machine says."""
    from ray.util.scheduling_strategies import (  # pyright: ignore[reportMissingImports]
        NodeAffinitySchedulingStrategy,
    )

    errors = cluster.ray.exceptions
    task = cluster.ray.remote(num_cpus=0, runtime_env={"env_vars": _environment("1")})(_probe)
    asked = []
    for machine in cluster.machines:
        there = NodeAffinitySchedulingStrategy(machine.id, soft=False)
        asked.append(task.options(scheduling_strategy=there).remote(file, token, folders))
    try:
        return list(zip(cluster.machines, cluster.ray.get(asked, timeout=PROBE_SECONDS), strict=True))
    except errors.RayTaskError as error:
        raise StageError(
            "hardware.cluster-cannot-run",
            "a machine of the cluster cannot run this program",
            _first_line(error.cause),
            f"Install it there: {INSTALL}",
        ) from error
    except errors.GetTimeoutError as error:
        raise StageError(
            "hardware.cluster-silent",
            "a machine of the cluster does not answer",
            f"it said nothing within {PROBE_SECONDS:.0f} s",
            "`ray status` says which machines there are. Try again.",
        ) from error
    except errors.RayError as error:
        raise _lost(cluster) from error
