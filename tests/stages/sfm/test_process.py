"""The children of stage sfm, seen from outside."""

import subprocess
import sys
from pathlib import Path

import pytest

from stages.sfm import process as sfm_process
from stages.sfm.pairs import matching_plan


@pytest.mark.parametrize("child", [sfm_process.CHILD, matching_plan.CHILD])
def test_what_lies_in_the_current_folder_is_no_module_of_a_child(tmp_path: Path, child: list[str]) -> None:
    for name in ("nerf/__init__.py", "stages/__init__.py", "random.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('a stranger')")
    command, ours = [sys.executable, *child], sfm_process.environment()
    ended = subprocess.run(command, input=b"", cwd=tmp_path, env=ours, capture_output=True)
    assert b"JSONDecodeError" in ended.stderr  # it is ours, and misses its job
