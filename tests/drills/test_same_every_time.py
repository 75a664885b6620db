"""The same command gives the same bits with any number of threads, any hashing, language, time zone and folder."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from tests.drills.campaigns import Chain
from tests.drills.drill import Program, results, run_words

CHECKOUT = Path(__file__).parents[2]


@dataclass
class Threads:
    """In the program: so many of torch's threads and of cores that it may use."""

    count: int

    def __call__(self) -> None:
        torch.set_num_threads(self.count)
        if self.count == 1 and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@pytest.mark.parametrize("count", [1, 4])
def test_any_number_of_threads(chain: Chain, tmp_path: Path, count: int):
    chain.start(tmp_path / "w.nerf", prepare=Threads(count)).finish()
    assert results(tmp_path / "w.nerf") == chain.expected


TINY_GRID = (
    "--train.grid.num-levels 2 --train.grid.log2-hashmap-size 10 --train.grid.max-res 32"
    " --train.grid.target-samples 1024 --train.grid.micro-batches 2"
)
FIELDS = {
    "torch": "--train.grid.backend torch --train.steps 20",
    "vanilla": "--train.vanilla.width 32 --train.vanilla.depth 2 --train.vanilla.skip 1"
    " --train.vanilla.samples-coarse 8 --train.vanilla.samples-fine 8 --train.vanilla.batch-rays 512 --train.steps 20",
    "effects": "--effect background=on --effect exposure=on --effect pose_refinement=on --train.steps 20"
    " --train.grid.backend warp",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FIELDS)
def test_every_field_and_backend(chain: Chain, tmp_path: Path, kind: str):
    found = []
    for count in (1, 2, 4):
        workspace = chain.before("effects", tmp_path / f"{count}.nerf")
        sizes = "" if kind == "vanilla" else TINY_GRID
        words = f"run {chain.photos} -o {workspace} --until evaluate {sizes} {FIELDS[kind]}"
        words += " --train.downscale 1 --evaluate.fraction 1"
        Program(words.split(), tmp_path / "says", Threads(count)).finish()
        found.append(results(workspace))
    assert found[0] == found[1] == found[2] and {"train", "evaluate"} <= found[0].keys()


@pytest.mark.slow
def test_hashing_language_time_zone_and_folder(chain: Chain, tmp_path: Path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = os.environ | {
        "PYTHONPATH": str(CHECKOUT),
        "PYTHONHASHSEED": "4711",
        "LC_ALL": "tr_TR.UTF-8",
        "TZ": "Pacific/Chatham",
        "OMP_NUM_THREADS": "3",
        "COLUMNS": "40",
    }
    words = [
        sys.executable,
        "-m",
        "pipeline",
        *run_words(Path(os.path.relpath(chain.photos, elsewhere)), Path("w.nerf")),
    ]
    answer = subprocess.run(words, cwd=elsewhere, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert results(elsewhere / "w.nerf") == chain.expected
