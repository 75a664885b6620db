"""The worker processes of stage sfm, seen from outside."""

import json
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stages.contract import StageError
from stages.sfm import Config, worker_process
from stages.sfm.job import worker_lock
from stages.sfm.pairs import quality_level
from stages.sfm.reconstruction import _wait_for_worker
from stages.sfm.retry_strategies import read_kept
from stages.sfm.worker_process import Ending


@pytest.mark.parametrize("command_line", [worker_process.COMMAND, quality_level.COMMAND])
def test_a_worker_takes_no_module_from_the_current_folder(tmp_path: Path, command_line: list[str]) -> None:
    for name in ("nerf/__init__.py", "stages/__init__.py", "random.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('a stranger')")
    command, ours = [sys.executable, *command_line], worker_process.environment()
    ended = subprocess.run(command, input=b"", cwd=tmp_path, env=ours, capture_output=True)
    assert b"JSONDecodeError" in ended.stderr  # it is ours, and misses its job


PARENT = (
    "import subprocess, sys, time; p = subprocess.Popen([sys.executable, '-c', sys.argv[1]], stdin=-1); time.sleep(60)"
)
HELD = """
import ctypes, os, threading, time
from stages.sfm.job import end_with_parent
threading.Thread(target=end_with_parent, daemon=True).start()
time.sleep(0.2)
print(os.getpid(), flush=True)
ctypes.PyDLL(None).sleep(30)  # native code that holds the interpreter
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a worker is waited for")
def test_native_code_does_not_outlive_the_parent() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, HELD], stdout=subprocess.PIPE, env=worker_process.environment()
    )
    assert parent.stdout
    stat, killed = Path(f"/proc/{int(parent.stdout.readline())}/stat"), time.monotonic()
    parent.kill()
    parent.wait()
    while stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < killed + 10
        time.sleep(0.01)


WORKER = "import sys, stages.sfm.worker as w; w.reconstruct = lambda *_: 1; print('here', file=sys.stderr); w.main()"


def test_a_worker_waits_for_the_one_before(tmp_path: Path) -> None:
    job = dict.fromkeys("images database photos seed max_image_size max_features camera_model camera_params".split())
    job |= dict.fromkeys("matcher neighbours max_strategies seconds max_seconds".split()) | {"folder": str(tmp_path)}
    pipes, command = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE), [sys.executable, "-c", WORKER]
    with worker_lock(tmp_path):
        worker = subprocess.Popen(command, env=worker_process.environment(), **pipes)
        assert worker.stdin and worker.stdout and worker.stderr
        worker.stdin.write(json.dumps(job).encode() + b"\n")
        worker.stdin.flush()
        assert worker.stderr.readline() == b"here\n"
        assert not select.select([worker.stdout], [], [], 1.0)[0], "it is at work"
    assert json.loads(worker.stdout.readline()) == {"result": 1}
    assert worker.wait(10) == 0


def test_the_program_waits_for_an_orphaned_worker(tmp_path: Path, progress) -> None:
    held, began = threading.Event(), time.monotonic()

    def orphan() -> None:
        with worker_lock(tmp_path):
            held.set()
            time.sleep(0.5)

    threading.Thread(target=orphan).start()
    held.wait()
    _wait_for_worker(tmp_path, progress)
    assert time.monotonic() - began > 0.5 and len(progress.updates) == 1
    _wait_for_worker(tmp_path, progress)
    assert len(progress.updates) == 1, "there is none any more"


@pytest.mark.parametrize("late", [False, True])
def test_only_the_strategy_at_work_is_abandoned(
    late: bool, tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    endings = [("fisheye", "mapping", late), ("missing photos", "matching", False), ("other seed", "refining", False)]
    limits: list[float] = []

    def killed(command: object, log: Path, job: object, seconds: float, hear: Callable[..., None]) -> Ending:
        log.touch()
        limits.append(seconds)
        strategy, phase, late = endings.pop(0)
        hear({"strategy": strategy})
        hear({"phase": phase, "done": 0})
        return Ending(-signal.SIGKILL, late)

    monkeypatch.setattr(worker_process, "run_child", killed)
    with pytest.raises(StageError) as caught:
        worker_process.run_worker(Config(), [], tmp_path, tmp_path, tmp_path / "database.db", progress)
    assert caught.value.code == ("sfm.timeout" if late else "sfm.worker-killed")
    abandoned = dict(read_kept(tmp_path / "strategies" / "abandoned.json"))
    assert sorted(abandoned) == (["fisheye"] if late else ["fisheye", "missing photos"])
    assert progress.codes == ([] if late else ["sfm.strategy-crashed"] * 2)
    assert limits == sorted(limits, reverse=True) and limits[-1] < Config().max_seconds


def test_the_live_line_groups_large_numbers(tmp_path: Path) -> None:
    latest = {
        "phase": "matching",
        "pairs": 6600,
        "done": 0,
        "strategy": "default",
        "database": str(tmp_path / "none.db"),
    }
    message, _ = worker_process._describe(latest, 400)
    assert "6,600" in message
