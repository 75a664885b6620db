"""``pipeline doctor``: what this machine has, and whether its arithmetic can be trusted, in about five seconds; with
``--selftest``, formula by formula (pipeline/doctor/selftest.py); with ``--bench``, how fast it is
(pipeline/doctor/bench.py)."""

import platform
from pathlib import Path

import torch

from pipeline.doctor.bench import bench_lines
from pipeline.doctor.selftest import numerical_matrix, self_test
from pipeline.engine import machine
from stages.hardware.backend import why_not_warp
from stages.hardware.device import processors

PACKAGES = (
    "torch", "pycolmap", "warp-lang", "kornia", "opencv-contrib-python-headless", "trimesh", "numpy", "scikit-image",
    "pillow", "safetensors", "imageio-ffmpeg",
)  # fmt: skip
LOW_DISK_GB = 2.0


def examine(folder: Path, selftest: bool, bench: bool) -> int:
    """Print versions, device, threads, free disk, the hash-grid field's kernels and the self-test, the long one and the
    machine's rates if asked for. 0 if all is well, 1 otherwise."""
    print(f"python {platform.python_version()} on {platform.platform()}")
    found = machine.versions(PACKAGES)
    print("\n".join(f"  {name:<32} {version}" for name, version in found.items()))
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none usable by torch"
    free_gb = machine.free_bytes(folder) / 2**30
    print(f"cores {processors()} · torch threads {torch.get_num_threads()} · GPU {gpu} · {free_gb:.1f} GB free")
    problems = [f"{name} is not installed" for name, version in found.items() if version == "missing"]
    if free_gb < LOW_DISK_GB:
        problems.append(f"only {free_gb:.1f} GB free: a run needs about {LOW_DISK_GB:.0f} GB")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    print(_grid_field_line(device.type))
    problems += [f"self-test: {name}: {error}" for name, error in self_test(device) if error]
    if selftest:
        problems += numerical_matrix(device.type)
    if bench:
        print("\n".join(bench_lines(device)))
    print("\n".join(f"problem: {problem}" for problem in problems) or "no problem found")
    return 1 if problems else 0


def _grid_field_line(device: str) -> str:
    """Which kernels stage train would choose for the hash-grid field, and why not Warp's."""
    why = why_not_warp(device)
    return f"hash-grid field: torch, because {why}" if why else "hash-grid field: warp"
