"""docs/deploy: what the image copies and installs is what there is, and the Slurm scripts call what they should."""

import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "docs" / "deploy"
FAKE = """#!/bin/bash
echo "$(basename "$0") $*" >> "$CALLS"
[ "$(basename "$0")" != scontrol ] || printf 'node7\\nnode8\\n'
"""


def copied() -> set[str]:
    lines = re.findall(r"^COPY (.+) \S+$", (DEPLOY / "Dockerfile").read_text("utf-8"), re.MULTILINE)
    return {name for line in lines for name in line.split()}


def test_the_image_has_all_that_it_installs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    packages = {name.rstrip("*") for name in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    texts = {project["project"]["readme"], *project["project"]["license-files"]}
    assert copied() == packages | texts | {"pyproject.toml", "constraints.txt"}
    assert all((ROOT / name).exists() for name in copied())


def test_the_context_of_the_image_is_what_it_copies() -> None:
    ignored = (DEPLOY / "Dockerfile.dockerignore").read_text("utf-8").split()
    assert ignored[0] == "*" and {line[1:] for line in ignored if line[0] == "!"} == copied()


def test_the_image_takes_the_pinned_torch() -> None:
    pins = [line for line in (ROOT / "constraints.txt").read_text("utf-8").split("\n") if line.startswith("torch==")]
    assert len(pins) == 1 and "grep '^torch==' constraints.txt" in (DEPLOY / "Dockerfile").read_text("utf-8")


def calls(script: str, arguments: list[Path], folder: Path, **variables: str) -> list[str]:
    """What a script calls, the programs of Slurm and ours replaced."""
    programs, made = folder / "bin", folder / "calls"
    programs.mkdir()
    for name in ("pipeline", "srun", "scontrol"):
        (programs / name).write_text(FAKE)
        (programs / name).chmod(0o755)
    environment = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "CALLS": str(made), **variables}
    subprocess.run(["bash", DEPLOY / script, *arguments], env=environment, check=True, timeout=60)
    return made.read_text().splitlines()


@pytest.mark.skipif(os.name != "posix", reason="Slurm runs on Linux")
def test_each_task_runs_its_scene(tmp_path: Path) -> None:
    for name in ("a", "b c"):
        (tmp_path / "scenes" / name).mkdir(parents=True)
    made = calls("scenes.sbatch", [tmp_path / "scenes", tmp_path / "results"], tmp_path, SLURM_ARRAY_TASK_ID="1")
    assert made == [f"pipeline run {tmp_path}/scenes/b c -o {tmp_path}/results/b c.nerf --budget 50m"]
    assert (tmp_path / "results").is_dir()


@pytest.mark.skipif(os.name != "posix", reason="Slurm runs on Linux")
def test_all_machines_train_one_field(tmp_path: Path) -> None:
    variables = {"SLURM_JOB_NODELIST": "node[7-8]", "SLURM_JOB_NUM_NODES": "2", "SLURM_JOB_ID": "31"}
    made = calls("train.sbatch", [Path("photos"), Path("w.nerf")], tmp_path, **variables)
    launch = "--rdzv-id 31 --rdzv-backend c10d --rdzv-endpoint node7:29500 -m pipeline train w.nerf"
    assert made == [
        "scontrol show hostnames node[7-8]",
        "pipeline run photos -o w.nerf --until effects",
        f"srun torchrun --nnodes 2 --nproc-per-node 4 {launch}",
        "pipeline run photos -o w.nerf",
    ]
