"""Facts about this machine, for the header, the manifests and doctor; cheap, imports nothing heavy."""

import importlib.metadata
import platform
import shutil
from pathlib import Path
from typing import Any

import psutil

from stages.hardware.device import processors
from stages.io.amounts import counted


def gpu_name() -> str | None:
    """The first NVIDIA GPU's name as the driver reports it, without importing torch."""
    information = sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
    for path in information:
        for line in path.read_text().splitlines():
            if line.startswith("Model:"):
                return line.split(":", 1)[1].strip()
    return None


def versions(names: tuple[str, ...]) -> dict[str, str]:
    """Installed versions; "missing" for what is not installed."""
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def existing_parent(path: Path) -> Path:
    """``path`` itself or the nearest folder above it that exists."""
    return next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())


def free_bytes(folder: Path) -> int:
    """Free disk space where ``folder`` is or will be."""
    return shutil.disk_usage(existing_parent(folder)).free


def facts() -> dict[str, Any]:
    """What a manifest records about the machine (never part of a key)."""
    return {
        "system": platform.platform(),
        "cores": processors(),
        "gpu": gpu_name(),
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "python": platform.python_version(),
        **versions(("torch", "pycolmap", "warp-lang")),
    }


def headline(workspace: Path) -> str:
    """One line for the start of a run."""
    machine = f"{counted(processors(), 'core')}, {gpu_name() or 'no GPU'}"
    return f"{machine}, {free_bytes(workspace) / 2**30:.0f} GB free · workspace {workspace}"
