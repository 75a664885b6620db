"""`--cluster` on the command line: the same keys and digests, and an error where there is no cluster."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cli import exit_codes
from pipeline.cli.commands import run_command
from pipeline.engine.workspace import Workspace
from tests.ray_cluster import WITHOUT_RAY


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(noise).save(folder / f"{index}.png")
    return folder


def test_a_cluster_changes_no_key(photos: Path, tmp_path: Path, ray_cluster: str) -> None:
    keys = []
    for name, words in (("here", []), ("there", ["--cluster", ray_cluster])):
        assert run_command(["run", str(photos), "-o", str(tmp_path / name), "--until", "ingest", *words]) == 0
        keys.append(Workspace(tmp_path / name).read_run().keys)
    assert keys[0] == keys[1]
    assert not list((tmp_path / "there").glob(".cluster-*")), "the probe is gone"


def test_no_cluster_at_an_address_ends_the_run(photos: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason=WITHOUT_RAY)
    words = ["run", str(photos), "-o", str(tmp_path / "w"), "--until", "ingest", "--cluster", "127.0.0.1:1"]
    assert run_command(words) == exit_codes.WORKSPACE
