"""The worker processes of stage sfm, seen from outside."""

import subprocess
import sys
from pathlib import Path

import pytest

from stages.sfm import worker_process
from stages.sfm.pairs import quality_level


@pytest.mark.parametrize("command_line", [worker_process.COMMAND, quality_level.COMMAND])
def test_a_worker_takes_no_module_from_the_current_folder(tmp_path: Path, command_line: list[str]) -> None:
    for name in ("nerf/__init__.py", "stages/__init__.py", "random.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('a stranger')")
    command, ours = [sys.executable, *command_line], worker_process.environment()
    ended = subprocess.run(command, input=b"", cwd=tmp_path, env=ours, capture_output=True)
    assert b"JSONDecodeError" in ended.stderr  # it is ours, and misses its job
