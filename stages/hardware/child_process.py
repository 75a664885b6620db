"""What a process of ours needs that another of ours starts."""

import os
from pathlib import Path


def child_environment() -> dict[str, str]:
    """In which `python -P -m` finds our modules, installed or not, and takes nothing in the current folder for one."""
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}
