"""Work given to the machines of a cluster: what comes back, in which order, and every way it can end."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest

from stages.hardware import cluster
from tests.ray_cluster import WITHOUT_RAY
from tests.refusals import refused
from tests.stages.hardware import cluster_work


@pytest.fixture
def joined(ray_cluster: str, tmp_path: Path) -> Iterator[str]:
    with cluster.joined(ray_cluster, [tmp_path]):
        yield ray_cluster


def test_a_local_run_never_loads_ray() -> None:
    work = "from stages.hardware import cluster\nwith cluster.joined(None): print(*cluster.fan_out(abs, [-1, 2]))"
    code = f"import sys\n{work}\nprint('ray' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["1", "2", "False"]


def test_without_ray_the_command_to_install_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with refused("hardware.no-ray", cluster.INSTALL), cluster.joined("auto"):
        pass


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "ray://127.0.0.1:x"])
def test_an_address_without_a_cluster_is_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason=WITHOUT_RAY)
    monkeypatch.setattr(cluster, "REACH_SECONDS", 1.0)
    with refused("hardware.no-cluster", address), cluster.joined(address):
        pass


@pytest.mark.parametrize("place", ["core", "machine"])
def test_results_come_in_order_and_few_are_under_way(joined: str, place: cluster.Place) -> None:
    taken, limit = list[int](), cluster.at_once(place)

    def items() -> Iterator[int]:
        for item in range(40 * limit):
            taken.append(item)
            yield item

    results = list[int]()
    for result in cluster.fan_out(partial(cluster_work.power, 2), items(), place=place):
        results.append(result)
        assert len(taken) <= len(results) + (cluster.MAX_WAITING + 1) * limit
    assert results == [item**2 for item in range(40 * limit)]


def test_without_a_cluster_items_are_taken_one_by_one() -> None:
    taken = iter(range(3))
    assert next(cluster.fan_out(partial(cluster_work.power, 2), taken)) == 0
    assert next(taken) == 1


def test_an_error_of_the_work_is_raised_as_it_was(joined: str) -> None:
    with refused("tests.failed", "item", "it always does", "Try nothing."):
        list(cluster.fan_out(cluster_work.fail, range(3)))
    assert list(cluster.fan_out(abs, [-1])) == [1], "the cluster goes on"


def test_a_killed_process_costs_no_result(joined: str, tmp_path: Path) -> None:
    assert list(cluster.fan_out(partial(cluster_work.die_once, tmp_path), range(5))) == [*range(5)]
    assert (tmp_path / "died").exists()


def test_work_that_always_kills_its_process_is_given_up(joined: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "MAX_RETRIES", 1)
    cluster._task.cache_clear()
    with refused("hardware.cluster-work-lost"):
        list(cluster.fan_out(cluster_work.die, range(2)))
    cluster._task.cache_clear()


def test_a_folder_that_a_machine_does_not_see_is_named(ray_cluster: str, tmp_path: Path) -> None:
    with (
        refused("hardware.not-shared", missing := tmp_path / "missing"),
        cluster.joined(ray_cluster, [tmp_path, missing]),
    ):
        pass
    assert not list(tmp_path.iterdir()), "the probe is gone"


def test_another_folder_of_the_same_name_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "probe").write_text("another token")
    assert cluster._probe(str(tmp_path / "probe"), "token", [str(tmp_path)]).missing == [str(tmp_path)]
    assert cluster._probe(str(tmp_path / "probe"), "another token", [str(tmp_path)]).missing == []


def test_other_versions_on_a_machine_are_refused(
    ray_cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = dict.fromkeys(cluster.COMPARED, "0.0")
    monkeypatch.setattr(cluster, "_versions", lambda: other)
    with refused("hardware.cluster-versions", "0.0"), cluster.joined(ray_cluster, [tmp_path]):
        pass


def test_a_cluster_that_is_gone_ends_the_wait(joined: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LOST_SECONDS", 0.1)
    waits = cluster.fan_out(cluster_work.wait, [600.0])
    ends = threading.Timer(1.0, monkeypatch.setattr, (cluster, "_answers", lambda *_: False))
    ends.start()
    with refused("hardware.cluster-lost", joined, cluster.RESUME_HINT):
        next(waits)
    ends.join()


def test_a_cluster_that_went_unnoticed_is_not_asked(joined: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_answers", lambda *_: False)
    with refused("hardware.cluster-lost", joined, cluster.RESUME_HINT):
        list(cluster.fan_out(abs, [-1]))


def test_an_interrupt_ends_the_work_on_all_machines(ray_cluster: str, tmp_path: Path) -> None:
    code = (
        "import sys, functools, pathlib\n"
        "from stages.hardware import cluster\nfrom tests.stages.hardware import cluster_work\n"
        "work = functools.partial(cluster_work.stay, pathlib.Path(sys.argv[2]))\n"
        "with cluster.joined(sys.argv[1]): list(cluster.fan_out(work, [0]))"
    )
    interruptible = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        [sys.executable, "-c", code, ray_cluster, str(tmp_path)], stderr=subprocess.PIPE, preexec_fn=interruptible
    ) as child:
        wait_for(lambda: (tmp_path / "0.pid").exists())
        worker = psutil.Process(int((tmp_path / "0.pid").read_text()))
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=120)
    assert b"KeyboardInterrupt" in said
    worker.wait(60)


def wait_for(condition: Callable[[], bool], seconds: float = 300) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.2)
