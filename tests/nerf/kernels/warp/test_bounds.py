"""Compiled kernels do not check indices, except in Warp's debug mode: there, one beyond its array ends the program.

By hand: python -c "import warp, pytest; warp.config.mode = 'debug'; pytest.main(['tests/nerf/kernels/warp'])"
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]
TESTS = [
    *(f"tests/nerf/kernels/warp/test_{name}.py" for name in ("warp", "marching", "compositing", "threads")),
    *(f"tests/nerf/kernels/test_{name}.py" for name in ("early_termination", "colour_sampling")),
]
OPTIONS = ["-n", "0", "-k", "not first_use", "-p", "no:cacheprovider"]  # workers would not be in debug mode
TESTED = f"import pytest; raise SystemExit(pytest.main({TESTS + OPTIONS}))"
BEYOND = """
import torch
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.mlp import _relu_backward_gpu
launch(_relu_backward_gpu, 32, torch.ones(2, 64), torch.ones(1, 64))
"""
NO_SUCH_RAY = """
import torch
from nerf.kernels import Layers, warp
layers = Layers(torch.ones(4, 64), torch.ones(3, 64))
warp.mlp_forward(layers, torch.ones(5, 4), torch.tensor([0, 1, 2, 1, 0], dtype=torch.int32), torch.ones(2, 64))
"""


@pytest.mark.slow
def test_no_kernel_reads_or_writes_beyond_its_arrays(tmp_path: Path) -> None:
    """All other tests of these kernels once more, on one and on several threads."""

    def in_debug_mode(code: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", f"import warp; warp.config.mode = 'debug'\n{code}"]
        environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)

    beyond = in_debug_mode(BEYOND)
    assert beyond.returncode != 0 and "Assertion failed: 'i >= -arr.shape[0] && i < arr.shape[0]'" in beyond.stderr
    no_such_ray = in_debug_mode(NO_SUCH_RAY)
    assert no_such_ray.returncode != 0 and "Assertion failed: 'rays.data[first + s] >= 0" in no_such_ray.stderr
    everything = in_debug_mode(TESTED)
    assert everything.returncode == 0, everything.stdout[-3000:] + everything.stderr[-3000:]
    assert " passed" in everything.stdout
