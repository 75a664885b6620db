"""A run on a cluster leaves the same results, digest for digest, as on one machine, whatever is killed meanwhile."""

from pathlib import Path

from benchmarks.cluster import killing
from pipeline.cli.commands import run_command
from pipeline.engine import manifest_file
from pipeline.engine.workspace import Workspace
from tests.synthetic_photos import SyntheticPhotos

STAGES = ("ingest", "sfm")
SMALL = ("--until", "sfm", "--sfm.max-features", "1000")


def made(photos: Path, workspace: Path, *words: str) -> dict[str, str]:
    """The digest of every stage's outputs after a run."""
    assert run_command(["run", str(photos), "-o", str(workspace), *SMALL, *words]) == 0
    keys = Workspace(workspace).read_run().keys
    return {name: manifest_file.read(workspace / name / keys[name][:16]).outputs_digest for name in STAGES}


def test_killed_processes_change_no_digest(ray_cluster: str, synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    here = made(synthetic_photos.folder, tmp_path / "here.nerf")
    with killing(1.0, 4.0) as killed:
        there = made(synthetic_photos.folder, tmp_path / "there.nerf", "--cluster", ray_cluster)
    assert killed and there == here
