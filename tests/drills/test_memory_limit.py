"""Too little memory is said before the work begins, with what would fit; with that the run goes on."""

import resource
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from pipeline.engine.stage_list import STAGES
from tests.drills.campaigns import Chain
from tests.drills.drill import Program, copy_workspace, results


@dataclass
class LimitedTo:
    """In the program: ``ulimit -d`` at what it has taken already and so many bytes more."""

    more: int

    def __call__(self) -> None:
        taken = psutil.Process().memory_info().data
        resource.setrlimit(resource.RLIMIT_DATA, (taken + self.more, taken + self.more))


@pytest.mark.parametrize(
    "stage, options, hint",
    [
        (
            "train",
            "--train.grid.log2-hashmap-size 24 --train.grid.num-levels 16 --train.grid.max-res 4096",
            "--train.grid.log2-hashmap-size",
        ),
        ("render", "--render.width 8192", "--render.width 4096"),
        ("mesh", "--mesh.resolution 1024", "--mesh.resolution "),
    ],
)
def test_what_does_not_fit_is_refused_beforehand(chain: Chain, tmp_path: Path, stage: str, options: str, hint: str):
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    words = [stage, str(workspace), "--json", *options.split()]
    program = Program(words, tmp_path / "says", LimitedTo(3 << 28))
    assert program.wait() == STAGES[stage].exit_code, program.said + program.complaints
    (error,) = [event for event in program.events() if event["event"] == "error"]
    assert error["what"].startswith("not enough memory for ") and hint in error["hint"]
    assert error["why"].count(" GB") == 2
    kept = {name: digest for name, digest in chain.expected.items() if name != stage}
    assert kept == {name: digest for name, digest in results(workspace).items() if name != stage}


def test_a_limit_that_is_enough_changes_nothing(chain: Chain, tmp_path: Path):
    workspace = chain.before("train", tmp_path / "w.nerf")
    program = chain.start(workspace, "--until", "train", prepare=LimitedTo(3 << 30)).finish()
    assert not program.complaints
    assert results(workspace)["train"] == chain.expected["train"]
