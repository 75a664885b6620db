"""Ctrl-C and SIGTERM in every stage, and what becomes of the programs that a stage started."""

import os
import signal
import threading
from functools import partial
from pathlib import Path

import pytest

from tests.drills.campaigns import Chain, kills, reached, unclean
from tests.drills.drill import Program
from tests.synthetic_photos import SyntheticPhotos

PATIENT = 10.0  # seconds; on a machine that does nothing else it takes a tenth of one (docs/results.md)
SOON = 0.05  # seconds after a stage has begun


def test_stopped_in_every_stage_in_turn(chain: Chain, tmp_path: Path):
    workspace, struck = tmp_path / "w.nerf", []
    for index, stage in enumerate(chain.seconds):
        number = (signal.SIGINT, signal.SIGTERM)[index % 2]
        program = chain.start(workspace)
        program.wait_until(
            lambda events, stage=stage: any(e["event"] == "begin" and e["stage"] == stage for e in events)
        )
        program.process.join(SOON)
        assert program.strike(number) < PATIENT
        if program.wait() != 0:
            assert unclean(program, number, workspace) == [], stage
            struck.append(stage)
    assert len(struck) >= 5, f"most signals must come before the end, not only those in {struck}"
    assert chain.lost(workspace) == []


def test_two_of_them_are_not_worse_than_one(chain: Chain, tmp_path: Path):
    program = chain.start(chain.before("train", tmp_path / "w.nerf"))
    program.wait_until(lambda events: any("step" in event.get("message", "") for event in events))
    for _ in range(3):
        os.killpg(program.process.pid, signal.SIGINT)
    assert program.strike(signal.SIGINT) < PATIENT
    assert unclean(program, signal.SIGINT, tmp_path / "w.nerf") == []


def leave_a_thread_behind() -> None:
    threading.Thread(target=threading.Event().wait).start()


def test_a_thread_that_never_ends_does_not_keep_it(chain: Chain, tmp_path: Path):
    program = chain.start(chain.before("train", tmp_path / "w.nerf"), prepare=leave_a_thread_behind)
    program.wait_until(lambda events: any("step" in event.get("message", "") for event in events))
    assert program.strike(signal.SIGINT) < PATIENT
    assert unclean(program, signal.SIGINT, tmp_path / "w.nerf") == []


@pytest.mark.parametrize(
    "instant, number",
    [("features", signal.SIGINT), ("matching", signal.SIGKILL), ("final bundle adjustment", signal.SIGTERM)],
)
def test_colmap_ends_with_the_program(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, instant: str, number: signal.Signals
):
    command = f"run {synthetic_photos.folder} -o {tmp_path / 'w.nerf'} --json --until sfm --sfm.max-features 500"
    program = Program(command.split(), tmp_path / "says")
    assert program.wait_until(partial(reached, instant))
    assert program.strike(number) < PATIENT
    assert program.orphans() == []
    if number != signal.SIGKILL:
        assert unclean(program, number, tmp_path / "w.nerf") == []


def test_killed_at_random_instants(chain: Chain, tmp_path: Path):
    tally = kills(chain, ["train", "mesh"], 2, seed=1, folder=tmp_path)
    assert tally.struck.total() >= 1, str(tally)
    assert not tally.lost and not tally.faults, str(tally)
